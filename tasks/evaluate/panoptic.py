"""One-to-one measures of a segmentation: panoptic quality, Hungarian mIoU, over- and under-segmentation, whole
instances.

All take the contingency table of instances only (label 0 taken out with `Contingency.without`).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ss_flow.tasks.evaluate.contingency import Contingency, Counts

_MATCH = 0.5
_PARTS = 10
"""A prediction that has a tenth of an instance covers it, and is made up of one that has a tenth of it (a whole number,
since 0.1 * 30 > 3 in floating point)."""


class PanopticQuality(NamedTuple):
    """Panoptic quality and its two factors, pq = sq * rq."""

    pq: float
    sq: float
    """Segmentation quality: mean IoU of the matched pairs; 0 without any."""
    rq: float
    """Recognition quality: F1 of the matches."""
    matched: int
    false_positives: int
    false_negatives: int


def panoptic_quality(table: Contingency, ignored: NDArray[np.bool_] | None = None) -> PanopticQuality:
    """Class-agnostic PQ (Kirillov et al., "Panoptic Segmentation", CVPR 2019, Eq. 1): pairs match when IoU > 0.5.

    With non-overlapping segments at most one prediction can match each instance, so the matching is unique. On a
    table pooled over all views of a scene this is the video panoptic quality over its whole length.
    ignored: [P] predictions that are not false positives when unmatched (they lie mostly on void elements).
    """
    iou = table.iou
    match = iou > _MATCH
    tp = int(match.sum())
    unmatched = ~match.any(axis=0)
    if ignored is not None:
        unmatched &= ~ignored
    fp = int(unmatched.sum())
    fn = len(table.truth_ids) - tp
    sq = float(iou[match].mean()) if tp else 0.0
    weight = tp + 0.5 * fp + 0.5 * fn
    rq = tp / weight if weight else 0.0
    return PanopticQuality(sq * rq, sq, rq, tp, fp, fn)


def hungarian_miou(table: Contingency) -> float:
    """Mean over the instances of their IoU under the best one-to-one assignment; an instance left over scores 0."""
    from scipy.optimize import linear_sum_assignment

    if not len(table.truth_ids):
        return 0.0
    iou = table.iou
    return float(iou[linear_sum_assignment(iou, maximize=True)].sum() / len(iou))


def over_segmentation(table: Contingency) -> float:
    """Share of the instances in more than one of the `pieces`."""
    return float((pieces(table) > 1).mean()) if len(table.truth_ids) else 0.0


def under_segmentation(table: Contingency) -> float:
    """Share of the predictions of which more than one instance makes up at least 10 % each."""
    made_of = table.intersection >= table.predicted_area[None, :] / _PARTS
    return float((made_of.sum(axis=0) > 1).mean()) if made_of.size else 0.0


def pieces(table: Contingency) -> Counts:
    """[G] of how many predictions each covers at least a tenth of the instance."""
    return (table.intersection >= table.truth_area[:, None] / _PARTS).sum(axis=1)


def whole(table: Contingency) -> NDArray[np.bool_]:
    """[G] which instances are exactly one prediction: one has an IoU of at least 0.5, and no second covers a tenth
    of the instance."""
    return (table.best_iou() >= _MATCH) & (pieces(table) == 1)
