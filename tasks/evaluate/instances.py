"""Class-agnostic instance segmentation against ground truth, on the masks of the views.

Values are fractions. A match at 25 or 50 means an IoU strictly above 0.25 or 0.50.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ss_flow.errors import InputError
from ss_flow.task import task
from ss_flow.tasks.artifacts import Float64, Frame, Hierarchy, Int32, LabelMap, Metrics
from ss_flow.tasks.evaluate.contingency import Contingency, added_up, contingency
from ss_flow.tasks.evaluate.panoptic import (
    hungarian_miou,
    over_segmentation,
    panoptic_quality,
    under_segmentation,
    whole,
)
from ss_flow.tasks.geometry.images import decode_valid


@task()
def evaluate_masks(
    predicted: tuple[LabelMap, ...],
    truth: tuple[LabelMap, ...],
    tree: Hierarchy | None = None,
    frames: Sequence[Frame] = (),
    *,
    zero_is_void: bool = False,
) -> Metrics:
    """Score instance masks over all annotated views at once: one predicted id stands for one instance in every view.

    predicted: the views' ids, 0 = nothing predicted; views without ground truth are left out.
    truth: the views' true ids. Where every pixel is annotated (a generated room: 0 = walls and floor), predicted
        pixels on 0 are false. Where 0 means "not annotated", set `zero_is_void`: such pixels are dropped on both
        sides, and a prediction most of which lies on them is no false positive.
    tree: tells which predicted ids are stuff.
    frames: the views; pixels that their `valid` masks exclude are dropped on both sides.
    Returns, on the pixels of all views pooled: miou, the mean over the true instances of the best IoU with any
    predicted id; macc25, macc50; pq, sq, rq (class-agnostic video panoptic quality over the whole scene);
    hungarian_miou (one-to-one); whole, the share of the true instances that are exactly one predicted id (IoU at
    least 0.5, and no second id on more than a tenth of it); pq_things, with a tree, where predicted stuff is no false
    positive as only things are annotated; over_segmentation, under_segmentation; and the counts
    num_truth, num_predicted.
    Raises InputError when a view lacks its prediction, sizes differ, or nothing is annotated.
    """
    stuff = tree.node[tree.stuff] if tree is not None else None
    return Metrics(segmentation_metrics(pooled(predicted, truth, frames), zero_is_void=zero_is_void, stuff=stuff))


def segmentation_metrics(
    everything: Contingency, *, zero_is_void: bool, stuff: Int32 | None = None
) -> dict[str, float]:
    """The measures of `evaluate_masks` on any elements.

    everything: how often true and predicted ids meet, 0 = none. stuff: predicted ids that are stuff. Raises InputError
    when nothing is annotated.
    """
    ignored = None
    if zero_is_void:
        table = everything.elements_of(everything.truth_ids > 0).without(predicted=0)
        # A prediction that lies on void alone is not in the table at all, hence it is no false positive either.
        kept = np.isin(everything.predicted_ids, table.predicted_ids)
        ignored = table.predicted_area < 0.5 * everything.predicted_area[kept]
    else:
        table = everything.without(truth=0, predicted=0)
    if not len(table.truth_ids):
        raise InputError("The ground truth holds no instance; at least one is needed to evaluate.")
    quality = panoptic_quality(table, ignored)
    of_things = {}
    if stuff is not None:
        is_stuff = np.isin(table.predicted_ids, stuff)
        of_things["pq_things"] = panoptic_quality(table, is_stuff if ignored is None else is_stuff | ignored).pq
    return {
        **summary(table.best_iou()),
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


def pooled(predicted: tuple[LabelMap, ...], truth: tuple[LabelMap, ...], frames: Sequence[Frame] = ()) -> Contingency:
    """How often true and predicted ids meet in the pixels of all annotated views, counted view by view: hundreds of
    views in one row would take several times their memory.

    frames: the views; pixels that their `valid` masks exclude are left out.
    Raises InputError when a view lacks its prediction, or the sizes differ.
    """
    by_name = {m.name: m for m in predicted}
    counted = {frame.name: decode_valid(frame) for frame in frames if frame.valid.size}

    def table(true_map: LabelMap) -> Contingency:
        if true_map.name not in by_name:
            raise InputError(f"View {true_map.name} has ground truth masks but no predicted ones; both are needed.")
        true_ids, ids = true_map.ids, by_name[true_map.name].ids
        if ids.shape != true_ids.shape:
            raise InputError(
                f"The predicted masks of view {true_map.name} have {ids.shape[1]} x {ids.shape[0]} pixels, its ground "
                f"truth has {true_ids.shape[1]} x {true_ids.shape[0]}; the sizes must agree."
            )
        inside = counted.get(true_map.name, np.True_)
        return contingency(true_ids[inside], ids[inside])

    return added_up(map(table, truth))


def summary(best: Float64) -> dict[str, float]:
    """miou, macc25 and macc50 of the best IoU of each true instance [G]."""
    return {
        "miou": float(best.mean()),
        "macc25": float((best > 0.25).mean()),
        "macc50": float((best > 0.50).mean()),
    }
