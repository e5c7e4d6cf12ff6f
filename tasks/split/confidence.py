"""How likely an instance is to be one whole thing."""

from __future__ import annotations

import numpy as np

from ss_flow.tasks.artifacts import DRAWN, FOUND, Float64, Hierarchy, UInt8
from ss_flow.tasks.packed import Masks

_ENOUGH = 8
"""Views with a mask of an instance from which more say nothing new."""
_WEIGHTS = (2.1, -2.1, -2.9, -1.2)
_CONSTANT = -2.4
"""Of `evidence`, by a logistic regression on what `bench_confidence.py` collects."""


def evidence(masks: Masks, origin: UInt8, *, piece: bool) -> Float64:
    """What tells a whole thing from a fragment, a patch of wall, or two things in one: [4].

    masks: of an instance, one in each view that shows it, at least one. origin: as in `InstanceMasks`. piece: see
    `pieces`. In turn: the logarithm of one more than the number of views in which the segmenter found it by itself, up
    to eight; the share of its masks that the border of the photo cuts off; the share that its points alone drew; and 1
    for a piece, else 0.
    """
    found = min(int((origin == FOUND).sum()), _ENOUGH)
    cut_off = (masks.boxes[:, :2] == 0).any(axis=1) | (masks.boxes[:, 2:] == masks.sizes).any(axis=1)
    return np.array([np.log1p(found), cut_off.mean(), (origin == DRAWN).mean(), float(piece)])


def confidence(told: Float64) -> float:
    """The probability that an instance has an IoU of one half or more with one thing, by its `evidence` [4].

    A share of votes does not tell: what is drawn wrongly is drawn wrongly in all views alike.
    """
    return float(1 / (1 + np.exp(-(_WEIGHTS @ told + _CONSTANT))))


def pieces(tree: Hierarchy) -> frozenset[int]:
    """The labels that were not put together from others, and that some views show as one with others."""
    of_more = (tree.parent > 0) & ~np.isin(tree.node, tree.parent)
    return frozenset(tree.node[of_more].tolist())
