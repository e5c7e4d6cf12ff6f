"""Class-agnostic instance segmentation against annotated points, as ScanNet is evaluated (spec 2.1).

Two labellings are scored: the dense points after Split (P_labeled), and the Gaussians of the finished scene, by their
centres. Each annotated point takes the label of the nearest of them. Values are fractions; a match at 25 or 50 means an
IoU strictly above 0.25 or 0.50.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ss_flow.errors import InputError
from ss_flow.task import task
from ss_flow.tasks.artifacts import (
    Float32,
    Float64,
    Gaussians,
    InstanceMasks,
    Int32,
    LabelMap,
    Metrics,
    PointCloud,
    PointLabels,
    Visibility,
)
from ss_flow.tasks.evaluate.contingency import Labels, contingency
from ss_flow.tasks.evaluate.instances import segmentation_metrics, summary
from ss_flow.tasks.evaluate.panoptic import panoptic_quality
from ss_flow.tasks.evaluate.scannet_ap import scannet_ap

_OVERLAPS = tuple(np.arange(50, 95, 5) / 100)
"""IoU thresholds whose mean is AP in ScanNet's evaluation: 0.50 to 0.90."""

_NOTHING_ANNOTATED = "The ground truth holds no annotated point; at least one instance is needed to evaluate."


@dataclass(frozen=True)
class TruePoints:
    """Annotated points of a scene."""

    points: Float32
    """[N, 3] world."""
    instance: Int32
    """[N] the instance of each, negative = not annotated."""
    names: tuple[str, ...] = ()
    """What the annotation calls instances 0, 1, ...; none where it does not say."""
    stuff: Int32 = field(default_factory=lambda: np.zeros(0, np.int32))
    """The instances that are walls, floors or the like."""
    first_id: int = 0
    """The id that the annotation begins with: 1 where its 0 means "nothing"."""


@dataclass(frozen=True)
class InstanceIoUs:
    """How well each true instance is covered, by the protocol of ScanNet's instances (spec 2.1)."""

    instance: Int32
    """[G] the true instances that occur, ascending."""
    best: Int32
    """[G] the predicted label with the highest IoU; 0 = the unlabelled points are."""
    iou: Float64
    """[G] the IoU with that label."""
    names: tuple[str, ...]
    """[G] what the annotation calls them; "" where it does not say."""


@task(name="evaluate.lifted")
def lifted(points: PointCloud, seen: Sequence[Visibility], truth: Sequence[LabelMap]) -> TruePoints:
    """The ground truth of the views carried to the dense points: each view that sees a point votes for the id there.

    seen: of every view. truth: ids of the annotated views, 0 = none. The most frequent id wins, the lowest of equals;
    a point that no annotated view sees on an instance is not annotated. No mesh is needed, and so the points are those
    of the capture, not of a scan.
    """
    by_name = {ids.name: ids for ids in truth}
    pairs = [np.zeros((0, 2), np.int64)]
    for view in range(len(seen)):
        ids = by_name.get(seen[view].name)
        if ids is not None:
            at = ids.ids.ravel()[seen[view].pixel]
            pairs.append(np.stack([seen[view].point_index, at], axis=1)[at > 0])
    instance = most_frequent(np.concatenate(pairs), len(points.points))
    return TruePoints(points.points, instance, first_id=1)


def most_frequent(votes: NDArray[np.int64], count: int) -> Int32:
    """[count] the id that each point has the most votes for, the lowest of equals, -1 without any.

    votes: [V, 2] the row of a point, and an id.
    """
    voted, times = np.unique(votes, axis=0, return_counts=True)
    instance = np.full(count, -1, np.int32)
    order = np.lexsort((-voted[:, 1], times))  # the last one that is written stays
    instance[voted[order, 0]] = voted[order, 1]
    return instance


@task(name="evaluate.points")
def evaluate_points(
    points: PointCloud,
    labels: PointLabels,
    instances: Sequence[InstanceMasks],
    truth: TruePoints,
    *,
    transfer_radius: float = 0.0,
    compat_gap_bug: bool = False,
) -> Metrics:
    """Score the labelled points after Split on annotated ones; see `point_metrics`.

    transfer_radius: see `transfer_nearest`. Raises InputError when nothing is annotated, or there is no point.
    """
    predicted = transfer_nearest(points.points, labels.label, truth.points, radius=transfer_radius)
    return Metrics(_all_metrics(truth, predicted, instances, compat_gap_bug=compat_gap_bug))


@task(name="evaluate.gaussians")
def evaluate_gaussians(
    scene: Gaussians,
    instances: Sequence[InstanceMasks],
    truth: TruePoints,
    *,
    transfer_radius: float = 0.0,
    compat_gap_bug: bool = False,
) -> Metrics:
    """Score labelled Gaussians, by their centres, as `evaluate_points` does points; no opacity counts (spec 2.1)."""
    predicted = transfer_nearest(scene.means, scene.instance_id, truth.points, radius=transfer_radius)
    return Metrics(_all_metrics(truth, predicted, instances, compat_gap_bug=compat_gap_bug))


@task(name="evaluate.instance_ious")
def instance_ious(scene: Gaussians, truth: TruePoints) -> InstanceIoUs:
    """The best IoU of each true instance with the labelled Gaussians, whose mean is the miou of `ig_metrics`.

    Raises InputError when nothing is annotated, or there is no Gaussian.
    """
    predicted = transfer_nearest(scene.means, scene.instance_id, truth.points)
    annotated = truth.instance >= 0
    table = contingency(truth.instance[annotated], predicted[annotated])
    if not len(table.truth_ids):
        raise InputError(_NOTHING_ANNOTATED)
    names = tuple(truth.names[i] if i < len(truth.names) else "" for i in table.truth_ids.tolist())
    best = table.predicted_ids[table.iou.argmax(axis=1)]
    return InstanceIoUs(table.truth_ids.astype(np.int32), best.astype(np.int32), table.best_iou(), names)


def _all_metrics(
    truth: TruePoints, predicted: Int32, instances: Sequence[InstanceMasks], *, compat_gap_bug: bool
) -> dict[str, float]:
    found = point_metrics(
        truth.instance, predicted, _scores(instances), first_id=truth.first_id, compat_gap_bug=compat_gap_bug
    )
    return found | (quality_by_kind(truth.instance, predicted, truth.stuff) if len(truth.stuff) else {})


def quality_by_kind(truth: Labels, predicted: Labels, stuff: Int32) -> dict[str, float]:
    """The panoptic quality of things and of stuff apart, each class-agnostic.

    truth: [N] instance of each point, negative = not annotated. predicted: [N], 0 = unlabelled. stuff: the true
    instances that are stuff. A prediction of which more than half lies on the other kind is no false positive here, but
    one there; one that lies mostly where nothing is annotated is none at all. Returns pq_things and pq_stuff, without
    the one that no instance is of.
    """
    annotated = truth >= 0
    table = contingency(truth[annotated], predicted[annotated]).without(predicted=0)
    _, everywhere = np.unique(predicted[np.isin(predicted, table.predicted_ids)], return_counts=True)
    on_void = 2 * table.predicted_area < everywhere
    is_stuff = np.isin(table.truth_ids, stuff)
    found = {}
    for name, own in (("pq_things", ~is_stuff), ("pq_stuff", is_stuff)):
        if own.any():
            of_other = 2 * table.intersection[~own].sum(axis=0) > table.predicted_area
            found[name] = panoptic_quality(table.of_truth(own), of_other | on_void).pq
    return found


def _scores(instances: Sequence[InstanceMasks]) -> dict[int, float]:
    """How sure each instance is, for the average precision."""
    return {one.instance_id: one.confidence for one in (instances[i] for i in range(len(instances)))}


def point_metrics(
    truth: Labels,
    predicted: Labels,
    score: Mapping[int, float],
    *,
    first_id: int = 0,
    compat_gap_bug: bool = False,
) -> dict[str, float]:
    """All measures on points.

    truth: [N] instance of each point, negative = not annotated. predicted: [N], 0 = unlabelled. score: how sure each
    predicted instance is. first_id: see `TruePoints`. compat_gap_bug: see `ig_metrics`.
    Returns those of `ig_metrics`, ap, ap50, ap25, those of `segmentation_metrics` on the annotated points, annotated
    (the share of the points that are), and id_gaps, 1 where the ids of the ground truth have gaps, from `first_id` on,
    and so the published script scores other instances. Raises InputError when no point is annotated.
    """
    together = ig_metrics(truth, predicted, compat_gap_bug=compat_gap_bug)
    table = contingency(truth, predicted).without(predicted=0)
    known = np.unique(truth[truth >= 0])
    return {
        **segmentation_metrics(contingency(np.maximum(truth + 1, 0), predicted), zero_is_void=True),
        **together,
        "ap": float(np.mean([scannet_ap(table, score, overlap) for overlap in _OVERLAPS])),
        "ap50": scannet_ap(table, score, 0.5),
        "ap25": scannet_ap(table, score, 0.25),
        "annotated": float((truth >= 0).mean()),
        "id_gaps": float(len(known) != known.max() + 1 - first_id),
    }


def ig_metrics(truth: Labels, predicted: Labels, *, compat_gap_bug: bool = False) -> dict[str, float]:
    """The "IG protocol" (InstanceGaussian's evaluation; spec 2.1): best IoU of each true instance, not one-to-one.

    truth: [N] instance of each point, negative = not annotated (such points are dropped for both sides).
    predicted: [N] any integers; an "unlabelled" value is one more segment, as in the protocol.
    compat_gap_bug: score the ids 0 .. (number of ids) - 1 instead of those that occur, as the published script does:
        where ids have gaps, a missing one scores 0 and the highest are never looked at.
    Returns miou, macc25, macc50. Raises InputError when no point is annotated.
    """
    annotated = truth >= 0
    if not annotated.any():
        raise InputError(_NOTHING_ANNOTATED)
    table = contingency(truth[annotated], predicted[annotated])
    best = table.best_iou()
    if compat_gap_bug:
        by_id = dict(zip(table.truth_ids.tolist(), best.tolist(), strict=True))
        best = np.array([by_id.get(i, 0.0) for i in range(len(best))])
    return summary(best)


def transfer_nearest(points: Float32, labels: Int32, targets: Float32, *, radius: float = 0.0) -> Int32:
    """Give every target the label of the point nearest to it (Euclidean).

    points: [N, 3]; labels: [N]; targets: [M, 3], all in world units. radius: with a positive value, targets farther
    than this from every point get 0; 0 = no limit, as in the protocol. Returns [M].
    Raises InputError when there is no point.
    """
    from scipy.spatial import cKDTree

    if not len(points):
        raise InputError("There is no labelled point to take labels from; a scene with at least one is needed.")
    distance, nearest = cKDTree(points).query(targets)
    result = labels[nearest].astype(np.int32)
    if radius > 0:
        result[distance > radius] = 0
    return result
