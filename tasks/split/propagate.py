"""Mask propagation: one label per object over all views (Split&Splat, Sec. 3.1.3 and Algorithm 1)."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Literal

import numpy as np

from ss_flow.running import progress
from ss_flow.task import task
from ss_flow.tasks.artifacts import Float64, Int32, MaskSet, PointCloud, PointLabels, Visibility
from ss_flow.tasks.geometry.clustering import main_clusters
from ss_flow.tasks.geometry.zbuffer import paint
from ss_flow.tasks.ranges import Count, Fraction, Natural, Range
from ss_flow.tasks.split.consensus import ConsensusParams, cluster_masks, merge_labels
from ss_flow.tasks.split.erosion import ErosionParams
from ss_flow.tasks.split.observation import ClusterParams, MaskPoints, observe
from ss_flow.tasks.split.voting import Votes


@dataclass(frozen=True)
class PropagateParams:
    """How masks of single views become labels of points."""

    start: Literal["empty", "consensus"] = "consensus"
    """Labels that the first pass starts from: none, as in the paper, or those that the consensus of all views gives."""
    passes: Count = 1
    """How often all views vote; each further pass matches every view against the labels of the pass before."""
    nested: bool = False
    """Whether a point inside two masks of a view votes for both; if not, for the smaller one."""
    lambda_init: Annotated[float, Range(0.0, 1.0, open_below=True, open_above=True)] = 0.25
    """What the first vote of a point weighs more than later ones, between 0 and 1."""
    contested_vote: Fraction = 0.0
    """Weight of a vote from a mask that touched several labels; 0 = the share of the label it went to."""
    tau_label: Fraction = 0.7
    """Share of its votes that a point's label needs."""
    min_overlap: Natural = 3
    """Painted pixels under a mask below which it is a new object."""
    min_overlap_share: Fraction = 0.1
    """The same as a share of the pixels under the mask where points fall; the larger of the two counts."""
    min_new_points: Natural = 10
    """Points under a mask below which it founds no object."""
    min_label_points: Natural = 10
    """Points below which a label is dropped in the end."""
    global_merge: bool = True
    """Whether labels that the views hold together in one mask are united in the end."""
    consensus: ConsensusParams = field(default_factory=ConsensusParams)
    """When masks or labels belong together."""
    erosion: ErosionParams = field(default_factory=ErosionParams)
    """How far a mask's border is taken off before it votes."""
    mask_clusters: ClusterParams = field(default_factory=ClusterParams)
    """Which points under a mask are kept."""
    label_clusters: ClusterParams = field(default_factory=lambda: ClusterParams(keep_share=0.05))
    """Which points of a label are kept in the end."""


@dataclass(frozen=True)
class Match:
    """The label that a mask votes for."""

    masked: MaskPoints
    label: int
    """0 when the mask founds a new object."""
    purity: float
    """Share of the painted pixels under the mask that carry the label."""


@task(uses=("opencv-contrib-python-headless", "scipy"))
def propagate(
    points: PointCloud, visibility: tuple[Visibility, ...], masks: tuple[MaskSet, ...], *, params: PropagateParams
) -> PointLabels:
    """Label the dense points so that each object has one label in all views (Algorithm 1, repaired; spec S4).

    visibility, masks: one of each per view, in the order of the views. View by view, the labels so far are painted
    into the view; every mask takes the label it overlaps most, or founds a new one; then its points vote for it. In
    the end a point keeps the label that got a share of tau_label of its votes. The order of the masks of a view does
    not matter, nor does the scale of the world.
    """
    num_points = len(points.points)
    views = [
        observe(view, pool, points.points, points.spacing, params.erosion, params.mask_clusters, nested=params.nested)
        for view, pool in zip(visibility, masks, strict=True)
    ]
    given = np.zeros(num_points, np.int32)
    num_labels = 0
    if params.start == "consensus":
        given, num_labels = _label_by_consensus(views, num_points, params)

    for turn in range(params.passes):
        votes = Votes(num_points)
        matched: list[tuple[int, Match]] = []
        for k, (view, masked) in enumerate(zip(visibility, views, strict=True)):
            progress(turn * len(views) + k, params.passes * len(views), view.name)
            virtual = _virtual_labels(view, given, votes, params.tau_label)
            # Two phases: no mask of a view sees the votes of another mask of the same view (spec A5).
            matches = [_match(m, virtual, num_labels, params) for m in masked]
            for match in matches:
                chosen = match.label
                if not chosen:
                    if len(match.masked.points) < params.min_new_points:
                        continue
                    num_labels += 1
                    chosen = num_labels
                _vote(votes, match, chosen, params)
                matched.append((k, Match(match.masked, chosen, match.purity)))
        given = _sure(votes, params.tau_label)

    label = _settle(given, points, views, params)
    renamed = _renaming(given, label, num_labels)
    _, share = votes.leaders()
    return PointLabels(
        label=label,
        confidence=share.astype(np.float32),
        num_labels=num_labels,
        match_view=np.array([k for k, _ in matched], np.int32),
        match_mask=np.array([m.masked.mask for _, m in matched], np.int32),
        match_label=renamed[np.array([m.label for _, m in matched], np.int32)],
        match_purity=np.array([m.purity for _, m in matched], np.float32),
    )


def _virtual_labels(view: Visibility, given: Int32, votes: Votes, tau_label: float) -> Int32:
    """The labels so far, painted into a view: flat image, 0 = none (Split&Splat, M*_k; spec S4.1).

    Given labels go first; points without one show what they were voted into in this pass.
    """
    voted, share = votes.leaders(view.point_index)
    label = np.where(share >= tau_label, voted, 0)
    label = np.where(given[view.point_index] > 0, given[view.point_index], label)
    sure = label > 0
    return paint(label[sure], view.pixel[sure], view.depth[sure], view.height * view.width)


def _match(masked: MaskPoints, virtual: Int32, num_labels: int, params: PropagateParams) -> Match:
    """The label that a mask overlaps most, or none when it hardly overlaps any (spec S4.2)."""
    overlap = np.bincount(virtual[masked.pixels], minlength=num_labels + 1)[1:]
    total = int(overlap.sum())
    if total < max(params.min_overlap, params.min_overlap_share * masked.covered, 1):
        return Match(masked, 0, 1.0)
    best = int(overlap.argmax())
    return Match(masked, best + 1, float(overlap[best] / total))


def _vote(votes: Votes, match: Match, label: int, params: PropagateParams) -> None:
    """Let the points under a mask vote for its label (spec S4.3)."""
    points = match.masked.points
    weight: Float64 = np.where(votes.fresh(points), 1.0 + params.lambda_init, 1.0)
    if match.purity < 1:
        weight *= params.contested_vote or match.purity
    votes.add(points, label, weight)


def _label_by_consensus(views: list[list[MaskPoints]], num_points: int, params: PropagateParams) -> tuple[Int32, int]:
    """Labels of the points by the objects that the views' masks form, and how many there are."""
    votes = Votes(num_points)
    objects = cluster_masks(views, num_points, params.consensus)
    for masked, labels in zip(views, objects, strict=True):
        for m, label in zip(masked, labels, strict=True):
            if label:
                votes.add(m.points, int(label), np.ones(len(m.points)))
    num_labels = max((int(labels.max(initial=0)) for labels in objects), default=0)
    return _sure(votes, params.tau_label), num_labels


def _sure(votes: Votes, tau_label: float) -> Int32:
    """The label of each point that got a share of tau_label of its votes: [N], 0 = none."""
    leader, share = votes.leaders()
    return np.where(share >= tau_label, leader, 0).astype(np.int32)


def _settle(
    label: Int32,
    points: PointCloud,
    views: list[list[MaskPoints]],
    params: PropagateParams,
) -> Int32:
    """The final labels: united where the views agree, without stray points, without tiny labels."""
    if params.global_merge:
        label = merge_labels(label, views, params.consensus)
    label = label.copy()
    clusters = params.label_clusters
    if clusters.eps:
        for name in np.unique(label[label > 0]):
            rows = np.flatnonzero(label == name)
            kept = main_clusters(
                points.points[rows], clusters.eps * points.spacing, clusters.min_samples, clusters.keep_share
            )
            label[rows[~kept]] = 0
    size = np.bincount(label)
    label[size[label] < params.min_label_points] = 0
    return label


def _renaming(before: Int32, after: Int32, num_labels: int) -> Int32:
    """Which label each label became by merging: [num_labels + 1]; 0 where none of its points is left."""
    renamed = np.zeros(num_labels + 1, np.int32)
    kept = after > 0
    renamed[before[kept]] = after[kept]
    return renamed
