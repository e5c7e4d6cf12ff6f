"""Mask propagation: one label per object over all views (Split&Splat, Sec. 3.1.3)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from ss_flow.running import warn
from ss_flow.task import Resources, task
from ss_flow.tasks.artifacts import (
    BORDER,
    INSIDE,
    Bool,
    Float32,
    Float64,
    Int32,
    Observation,
    PointCloud,
    PointLabels,
    Visibility,
)
from ss_flow.tasks.geometry.clustering import dbscan, rows_by_label
from ss_flow.tasks.ranges import Count, Fraction, Natural
from ss_flow.tasks.split.observe import ClusterParams
from ss_flow.tasks.split.votes.at_once import (
    MaskClusteringParams,
    cluster_masks,
    vote_at_once,
    words_of,
)
from ss_flow.tasks.split.votes.in_turn import Matches, SequentialParams, vote_in_turn
from ss_flow.tasks.split.votes.smoothing import smooth
from ss_flow.tasks.split.votes.touching import TouchingParams, merge_touching
from ss_flow.tasks.split.votes.votes import Votes

MOST_LABELS = np.iinfo(np.uint16).max // 2
"""Label maps have 16 bits: above this id, those that no point carries are left out, and the others move up. Half of the
numbers are left to the nodes of the tree over the labels, which are fewer than these."""


@dataclass(frozen=True)
class PropagateParams:
    """How masks of single views become labels of points."""

    views: Literal["at_once", "in_turn"] = "at_once"
    """Whether the masks of all views are clustered at once, or matched to labels view after view, as in the paper."""
    at_once: MaskClusteringParams = field(default_factory=MaskClusteringParams)
    """How masks are clustered (only with views=at_once)."""
    in_turn: SequentialParams = field(default_factory=SequentialParams)
    """How masks are matched (only with views=in_turn)."""
    tau_label: Fraction = 0.7
    """Share of its votes that a point's label needs."""
    smoothing: Natural = 3
    """How often a point without a sure label takes the one that most of its neighbours carry; 0 = never."""
    touching_merge: bool = True
    """Whether labels that go on into each other, alike in colour, are united in the end."""
    touching: TouchingParams = field(default_factory=TouchingParams)
    """When they are (only with touching_merge)."""
    label_clusters: ClusterParams = field(default_factory=lambda: ClusterParams(eps=2.5, keep_share=0.05))
    """Which points of a label are kept in the end."""
    tau_piece: Fraction = 0.55
    """What label_clusters leaves out of a label is kept all the same, piece by piece, where its points lie inside masks
    of the label in more than this share of the views that see them; under a mask's border counts a third. A leg apart
    from its seat stays so; what a mask covers beyond a thing's outline goes. 1 = never."""
    min_label_points: Natural = 10
    """Points below which a label is dropped in the end."""
    min_label_views: Count = 2
    """Views that must show a label by a mask, where as many see at least a tenth of it; else it is dropped in the end.
    1 keeps all."""
    min_label_share: Fraction = 1 / 3
    """A label that this share of the views that see it show is kept all the same: where two or three views look, one of
    them is a third or more."""

    def in_use(self) -> PropagateParams:
        """With the groups that are not read as by default, so that they do not enter the key."""
        touching = self.touching if self.touching_merge else TouchingParams()
        read = replace(self, touching=touching, label_clusters=self.label_clusters.in_use())
        if self.views == "at_once":
            return replace(read, in_turn=SequentialParams())
        return replace(read, at_once=MaskClusteringParams())


@task(resources=Resources(cores=1, most_cores=8))
def propagate(
    points: PointCloud,
    visibility: Sequence[Visibility],
    observations: Sequence[Observation],
    *,
    params: PropagateParams,
) -> PointLabels:
    """Label the dense points so that each object has one label in all views (Algorithm 1, or better; spec S4).

    visibility, observations: one of each per view, in the order of the views. The masks vote for the labels of the
    points under them; in the end a point keeps the label that got a share of tau_label of its votes. The order of the
    masks of a view does not matter, nor does the scale of the world; nor, with views=at_once, the order of the views,
    up to `at_once.max_views` of them. Ids that are dropped stay unused, unless the highest is above `MOST_LABELS`.
    """
    if params.views == "in_turn":
        votes, matched = vote_in_turn(len(points.points), visibility, observations, params.tau_label, params.in_turn)
        against = np.zeros(len(points.points), np.float32)
    else:
        votes, against, matched = _at_once(len(points.points), visibility, observations, params)
    leader, share = votes.leaders()
    covered = votes.weight() > against
    sure = covered & (share >= params.tau_label)
    label = np.where(sure, leader, 0).astype(np.int32)
    if params.smoothing:
        label = smooth(label, covered & ~sure, points.points, points.spacing, params.smoothing)
    settled = _settle(label, points, _sightings(label, observations, matched), params)
    num_labels = max(matched.label, default=0)
    renamed = _renaming(label, settled, num_labels)
    if params.min_label_views > 1:
        dropped = _unconfirmed(settled, observations, matched, renamed, params)
        settled, renamed = np.where(dropped[settled], 0, settled), np.where(dropped[renamed], 0, renamed)
    match_label = renamed[np.array(matched.label, np.int32)]
    if num_labels > MOST_LABELS:
        given = np.unique(np.concatenate([[0], settled, match_label]))
        settled, match_label = (np.searchsorted(given, ids).astype(np.int32) for ids in (settled, match_label))
        num_labels = len(given) - 1
    return PointLabels(
        label=settled,
        confidence=share.astype(np.float32),
        num_labels=num_labels,
        match_view=np.array(matched.view, np.int32),
        match_mask=np.array(matched.mask, np.int32),
        match_label=match_label,
    )


def _at_once(
    num_points: int, visibility: Sequence[Visibility], observations: Sequence[Observation], params: PropagateParams
) -> tuple[Votes, Float32, Matches]:
    """Votes for labels, votes against any [N], and the label of each mask, from the masks of all views at once."""
    words = words_of(visibility, num_points)
    labels = cluster_masks(observations, num_points, params.at_once, words)
    votes, against = vote_at_once(num_points, observations, labels, params.at_once, words)
    matched = Matches([], [], [])
    for k, (seen, shown) in enumerate(zip(observations, labels, strict=True)):
        for j in np.flatnonzero(shown).tolist():
            matched.view.append(k)
            matched.mask.append(int(seen.mask[j]))
            matched.label.append(int(shown[j]))
    return votes, against, matched


def _sightings(label: Int32, observations: Sequence[Observation], matched: Matches) -> tuple[Int32, Float64]:
    """How many views see each point [N], and how many of them under a mask of its label [N]; at its border a third."""
    worth = np.zeros(3)
    worth[[BORDER, INSIDE]] = 1 / 3, 1.0
    seen, shown = np.zeros(len(label), np.int32), np.zeros(len(label))
    label_of = {(k, mask): given for k, mask, given in zip(matched.view, matched.mask, matched.label, strict=True)}
    for k, observation in enumerate(observations):
        seen[observation.point_index] += 1
        best = np.zeros(len(label))
        for j, mask in enumerate(observation.mask.tolist()):
            row, standing = observation.under(j)
            under = observation.point_index[row]
            own = label[under] == label_of.get((k, mask), -1)
            best[under[own]] = np.maximum(best[under[own]], worth[standing[own]])
        shown += best
    return seen, shown


def _settle(label: Int32, points: PointCloud, sightings: tuple[Int32, Float64], params: PropagateParams) -> Int32:
    """The final labels: united where surfaces say so, without stray points, without tiny labels."""
    if params.touching_merge:
        label = merge_touching(label, points, params.touching)
    label = label.copy()
    reach = params.label_clusters.eps * points.spacing
    for label_id, rows in rows_by_label(label).items():
        if label_id:
            rest = rows[~params.label_clusters.kept(points.points[rows], points.spacing[rows])]
            piece = dbscan(points.points[rest], reach[rest], min_samples=1)
            seen, shown = (np.bincount(piece, of[rest]) for of in sightings)
            label[rest[(shown <= params.tau_piece * seen)[piece]]] = 0
    size = np.bincount(label)
    label[size[label] < params.min_label_points] = 0
    return label


def _renaming(before: Int32, after: Int32, num_labels: int) -> Int32:
    """Which label each label became by merging: [num_labels + 1]; 0 where none of its points is left."""
    renamed = np.zeros(num_labels + 1, np.int32)
    kept = after > 0
    renamed[before[kept]] = after[kept]
    return renamed


def _unconfirmed(
    label: Int32, observations: Sequence[Observation], matched: Matches, renamed: Int32, params: PropagateParams
) -> Bool:
    """Which labels masks of too few views show, though enough see at least a tenth of their points: [L + 1].

    Where no other view looks, there is nothing that could have confirmed them.
    """
    size = np.bincount(label)
    seen, support = np.zeros(len(size), np.int32), np.zeros(len(size), np.int32)
    shown = np.unique(np.stack([np.array(matched.view, np.int32), renamed[matched.label]]), axis=1)
    known: set[tuple[bytes, bytes]] = set()
    for k, observation in enumerate(observations):
        content = observation.point_index.tobytes(), observation.row.tobytes()
        if content not in known:  # a second copy of a view confirms nothing
            known.add(content)
            seen += 10 * np.bincount(label[observation.point_index], minlength=len(size)) >= np.maximum(size, 1)
            support[shown[1, shown[0] == k]] += 1
    few = (support < params.min_label_views) & (support < params.min_label_share * seen)
    dropped = few & (seen >= params.min_label_views)
    dropped[0] = False
    if dropped.any():
        warn(
            f"{dropped.sum()} of {np.count_nonzero(size[1:])} labels, with {size[dropped].sum()} of {len(label)} "
            f"points, go to the background, since masks of fewer than {params.min_label_views} views show them "
            f"though others see them too."
        )
    return dropped
