"""Labels for contested points, from their neighbours (spec A12)."""

from __future__ import annotations

import numpy as np

from ss_flow.tasks.artifacts import Bool, Float32, Int32
from ss_flow.tasks.geometry.clustering import nearest_within

_NEIGHBOURS = 8
_REACH = 3.0
"""How far a neighbour may be, in spacings of the point."""


def smooth(label: Int32, contested: Bool, points: Float32, spacing: Float32, rounds: int) -> Int32:
    """Give contested points the label that most of their nearest neighbours carry; ties go to the lowest.

    label: [N], 0 = none. contested: [N] which points may change. points: [N, 3]. spacing: [N] theirs. rounds: how
    often; each round sees the labels of the one before. Points all of whose neighbours are unlabelled stay so.
    """
    from scipy.spatial import cKDTree

    rows = np.flatnonzero(contested)
    if not rows.size:
        return label
    count = min(_NEIGHBOURS + 1, len(points))
    tree = cKDTree(points)
    near = nearest_within(tree, points[rows], count, _REACH * spacing[rows])
    padded = np.append(label, np.int32(0))  # a neighbour out of reach has the number len(points)
    changed = np.ones(len(padded), bool)
    for _ in range(rounds):
        # Where no neighbour has changed, the answer has not.
        asked = np.flatnonzero(changed[near].any(axis=1))
        around = np.where(near[asked] == rows[asked, None], 0, padded[near[asked]])
        found, before = _most_frequent(around), padded[rows[asked]]
        padded[rows[asked]] = found
        changed[:] = False
        changed[rows[asked]] = found != before
    return padded[:-1]


def _most_frequent(labels: Int32) -> Int32:
    """The most frequent label above 0 in each row of [M, Q]; ties go to the lowest; 0 where there is none."""
    ordered = np.ascontiguousarray(np.sort(labels, axis=1).T)
    best, most = np.zeros_like(ordered[0]), np.zeros(len(labels), np.int32)
    length = np.zeros(len(labels), np.int32)
    for before, label in zip(ordered[[0, *range(len(ordered) - 1)]], ordered, strict=True):
        length = np.where(label == before, length + 1, 1)
        longer = (length > most) & (label > 0)
        best, most = np.where(longer, label, best), np.where(longer, length, most)
    return best
