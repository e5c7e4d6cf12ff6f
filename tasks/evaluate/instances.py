"""Class-agnostic instance segmentation against ground truth: on the views' masks, and on points (spec 2.1).

Values are fractions. A match at 25 or 50 means an IoU strictly above 0.25 or 0.50.
"""

from __future__ import annotations

import numpy as np

from ss_flow.errors import InputError
from ss_flow.task import task
from ss_flow.tasks.artifacts import (
    Float32,
    Float64,
    Gaussians,
    Hierarchy,
    Int32,
    LabelMap,
    Metrics,
    PointCloud,
    PointLabels,
)
from ss_flow.tasks.evaluate.contingency import Labels, contingency
from ss_flow.tasks.evaluate.panoptic import (
    hungarian_miou,
    over_segmentation,
    panoptic_quality,
    under_segmentation,
    whole,
)


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
        raise InputError("The ground truth holds no annotated point; at least one instance is needed to evaluate.")
    table = contingency(truth[annotated], predicted[annotated])
    best = table.best_iou()
    if compat_gap_bug:
        by_id = dict(zip(table.truth_ids.tolist(), best.tolist(), strict=True))
        best = np.array([by_id.get(i, 0.0) for i in range(len(best))])
    return _summary(best)


def transfer_nearest(
    points: Float32, labels: Int32, targets: Float32, *, radius: float = 0.0, unlabelled: int = 0
) -> Int32:
    """Give every target the label of the point nearest to it (Euclidean).

    points: [N, 3]; labels: [N]; targets: [M, 3], all in world units. radius: with a positive value, targets farther
    than this from every point become `unlabelled`; 0 = no limit, as in the protocol. Returns [M].
    Raises InputError when there is no point.
    """
    from scipy.spatial import cKDTree

    if not len(points):
        raise InputError("There is no labelled point to take labels from; a scene with at least one is needed.")
    distance, nearest = cKDTree(points).query(targets)
    result = labels[nearest].astype(np.int32)
    if radius > 0:
        result[distance > radius] = unlabelled
    return result


@task()
def evaluate_points(
    points: PointCloud,
    labels: PointLabels,
    truth_points: PointCloud,
    truth: PointLabels,
    *,
    transfer_radius: float = 0.0,
    compat_gap_bug: bool = False,
) -> Metrics:
    """Score labelled points (P_labeled) on the points of the ground truth, IG protocol (spec 2.1).

    truth: label 0 = not annotated; the protocol's id i is label i + 1. transfer_radius: see `transfer_nearest`.
    Returns miou, macc25, macc50. Raises InputError when nothing is annotated, or there is no point.
    """
    predicted = transfer_nearest(points.points, labels.label, truth_points.points, radius=transfer_radius)
    return Metrics(ig_metrics(truth.label - 1, predicted, compat_gap_bug=compat_gap_bug))


@task()
def evaluate_gaussians(
    scene: Gaussians,
    truth_points: PointCloud,
    truth: PointLabels,
    *,
    transfer_radius: float = 0.0,
    compat_gap_bug: bool = False,
) -> Metrics:
    """Score labelled Gaussians, by their centres, as `evaluate_points` does points; no opacity counts (spec 2.1)."""
    predicted = transfer_nearest(scene.means, scene.instance_id, truth_points.points, radius=transfer_radius)
    return Metrics(ig_metrics(truth.label - 1, predicted, compat_gap_bug=compat_gap_bug))


@task()
def evaluate_masks(
    predicted: tuple[LabelMap, ...],
    truth: tuple[LabelMap, ...],
    tree: Hierarchy | None = None,
    *,
    zero_is_void: bool = False,
) -> Metrics:
    """Score instance masks over all annotated views at once: one predicted id stands for one instance in every view.

    predicted: the views' ids, 0 = nothing predicted; views without ground truth are left out.
    truth: the views' true ids. Where every pixel is annotated (a generated room: 0 = walls and floor), predicted
        pixels on 0 are false. Where 0 means "not annotated", set `zero_is_void`: such pixels are dropped on both
        sides, and a prediction most of which lies on them is no false positive.
    tree: tells which predicted ids are stuff.
    Returns, on the pixels of all views pooled: miou, the mean over the true instances of the best IoU with any
    predicted id; macc25, macc50; pq, sq, rq (class-agnostic video panoptic quality over the whole scene);
    hungarian_miou (one-to-one); whole, the share of the true instances that are exactly one predicted id (IoU at
    least 0.5, and no second id on more than a tenth of it); pq_things, with a tree, where predicted stuff is no false
    positive as only things are annotated; over_segmentation, under_segmentation; and the counts
    num_truth, num_predicted.
    Raises InputError when a view lacks its prediction, sizes differ, or nothing is annotated.
    """
    true_ids, ids = pooled(predicted, truth)
    everything = contingency(true_ids, ids)
    ignored = None
    if zero_is_void:
        annotated = true_ids > 0
        table = contingency(true_ids[annotated], ids[annotated]).without(predicted=0)
        # A prediction that lies on void alone is not in the table at all, hence it is no false positive either.
        kept = np.isin(everything.predicted_ids, table.predicted_ids)
        ignored = table.predicted_area < 0.5 * everything.predicted_area[kept]
    else:
        table = everything.without(truth=0, predicted=0)
    if not len(table.truth_ids):
        raise InputError("The ground truth masks hold no instance; at least one view with one is needed to evaluate.")
    quality = panoptic_quality(table, ignored)
    of_things = {}
    if tree is not None:
        stuff = np.isin(table.predicted_ids, tree.node[tree.stuff])
        of_things["pq_things"] = panoptic_quality(table, stuff if ignored is None else stuff | ignored).pq
    return Metrics(
        {
            **_summary(table.best_iou()),
            "pq": quality.pq,
            "sq": quality.sq,
            "rq": quality.rq,
            **of_things,
            "hungarian_miou": hungarian_miou(table),
            "whole": float(whole(table).mean()),
            "over_segmentation": over_segmentation(table),
            "under_segmentation": under_segmentation(table),
            "num_truth": float(len(table.truth_ids)),
            "num_predicted": float((everything.predicted_ids > 0).sum()),
        }
    )


def pooled(predicted: tuple[LabelMap, ...], truth: tuple[LabelMap, ...]) -> tuple[Labels, Labels]:
    """The pixels of all annotated views in one row: true ids [N], predicted ids [N].

    Raises InputError when a view lacks its prediction, or the sizes differ.
    """
    by_name = {m.name: m for m in predicted}
    for true_map in truth:
        if true_map.name not in by_name:
            raise InputError(f"View {true_map.name} has ground truth masks but no predicted ones; both are needed.")
        shape = by_name[true_map.name].ids.shape
        if shape != true_map.ids.shape:
            raise InputError(
                f"The predicted masks of view {true_map.name} have {shape[1]} x {shape[0]} pixels, its ground truth "
                f"has {true_map.ids.shape[1]} x {true_map.ids.shape[0]}; the sizes must agree."
            )
    empty = np.zeros(0, np.uint16)
    true_ids = np.concatenate([empty, *(m.ids.ravel() for m in truth)])
    return true_ids, np.concatenate([empty, *(by_name[m.name].ids.ravel() for m in truth)])


def _summary(best: Float64) -> dict[str, float]:
    return {
        "miou": float(best.mean()),
        "macc25": float((best > 0.25).mean()),
        "macc50": float((best > 0.50).mean()),
    }
