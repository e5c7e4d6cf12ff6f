"""Which groups of points belong to one object, by the consensus of the views.

The criterion of MaskClustering (Yan et al., CVPR 2024): two groups of points belong together when most of the views
that see both hold both inside one mask. No order of views enters.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ss_flow.tasks.artifacts import Int32, Observation
from ss_flow.tasks.ranges import Count, Fraction
from ss_flow.tasks.split.observe import membership

if TYPE_CHECKING:
    from scipy.sparse import csr_array


@dataclass(frozen=True)
class ConsensusParams:
    """When groups of points belong together (spec S4, global merge)."""

    visible: Fraction = 0.3
    """Share of a group's points that a view must see to have a say about it."""
    contained: Fraction = 0.8
    """Share of a group's seen points that one mask must hold to hold the group."""
    rate: Fraction = 0.9
    """Share of the views with a say about two groups that must hold both in one mask."""
    min_views: Count = 3
    """How many views must have a say about two labels before these are merged."""


@dataclass(frozen=True)
class Opinions:
    """What the views say about groups of points."""

    say: csr_array
    """[G, K] in which views each group has a say."""
    held: csr_array
    """[G, T] by which masks, numbered over all views, each group is held."""

    def agree(self, rate: float, min_views: int) -> csr_array:
        """[G, G] which pairs have a say in at least `min_views` views, of which a share of `rate` holds both."""
        from scipy.sparse import csr_array

        together = (self.held @ self.held.T).tocoo()
        common = (self.say @ self.say.T).toarray()[together.row, together.col]
        agreed = (common >= min_views) & (together.data >= rate * common)
        return csr_array((agreed[agreed], (together.row[agreed], together.col[agreed])), shape=together.shape)


def opinions(
    groups: list[Int32],
    views: Sequence[Observation],
    num_points: int,
    params: ConsensusParams,
) -> Opinions:
    """Ask every view about groups of points.

    groups: rows of the point cloud, each. views: one observation of each. A view has a say about a group when it sees
    enough of it under its masks; a mask holds the group when it has nearly all that is seen.
    """
    from scipy.sparse import csr_array

    members = membership(groups, num_points)
    size = np.array([len(group) for group in groups])
    say, group_held, mask_held = [], [], []
    first_mask = 0
    for view in views:
        masks = [view.inside(j) for j in range(len(view.mask))]
        # Points outside every mask say nothing for or against a union.
        under = np.unique(np.concatenate([np.zeros(0, np.int32), *masks]))
        mark = np.zeros(num_points, np.float32)
        mark[under] = 1
        seen = members @ mark
        has_say = (seen > 0) & (seen >= params.visible * size)
        say.append(has_say)
        if masks:
            inside = (members @ membership(masks, num_points).T).toarray()
            best = inside.argmax(axis=1)
            holds = has_say & (inside.max(axis=1) >= params.contained * seen)
            group_held.append(np.flatnonzero(holds))
            mask_held.append(first_mask + best[holds])
        first_mask += len(masks)
    group, mask = np.concatenate(group_held), np.concatenate(mask_held)
    return Opinions(
        csr_array(np.stack(say, axis=1).astype(np.float32)),
        csr_array((np.ones(len(group), np.float32), (group, mask)), shape=(len(groups), first_mask)),
    )


def merge_labels(labels: Int32, views: Sequence[Observation], params: ConsensusParams) -> Int32:
    """Unite the labels of points that the views hold together (spec S4, global merge).

    labels: [N], 0 = none. A union takes its lowest label.
    """
    names = np.unique(labels[labels > 0])
    if len(names) < 2:
        return labels
    order = np.argsort(labels, kind="stable").astype(np.int32)
    groups = np.split(order, np.searchsorted(labels[order], names))[1:]
    asked = opinions(groups, views, len(labels), params)
    united = _components(asked.agree(params.rate, params.min_views))
    lowest = np.full(united.max() + 1, np.iinfo(np.int32).max, np.int32)
    np.minimum.at(lowest, united, names)
    renamed = np.zeros(int(names.max()) + 1, np.int32)
    renamed[names] = lowest[united]
    return renamed[labels]


def _components(links: csr_array) -> Int32:
    """Connected components of a symmetric graph, numbered by their first member: [G]."""
    from scipy.sparse.csgraph import connected_components

    return connected_components(links, directed=False)[1].astype(np.int32)
