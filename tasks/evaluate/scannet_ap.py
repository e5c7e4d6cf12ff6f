"""Average precision as ScanNet's evaluation of instances has it (`evaluate_semantic_instance.py`), for one class."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ss_flow.tasks.artifacts import Float64
from ss_flow.tasks.evaluate.contingency import Contingency

_LEAST_POINTS = 100
"""Instances and predictions with fewer points do not count."""


def scannet_ap(table: Contingency, score: Mapping[int, float], overlap: float) -> float:
    """Class-agnostic average precision by ScanNet's rules (spec 2.1 a).

    table: of all points, with the true label -1 where nothing is annotated, without predicted 0. score: how sure each
    prediction is. Instances and predictions of fewer than 100 points are left out.

    The instances choose in the order of their ids, among the predictions that meet them with an IoU above `overlap` and
    that no earlier instance has taken. The surest counts as right and all others as wrong, but only the first by id is
    taken: below an IoU of 0.5 a prediction may meet two instances. One that meets none is wrong, unless more than a
    share `overlap` of it lies on what is not annotated or left out.

    Returns the area under precision over recall, from (recall 0, precision 1) on through a point for every score that
    occurs, by the trapezoidal rule; 0 where no instance counts.
    """
    counted = (table.truth_ids >= 0) & (table.truth_area >= _LEAST_POINTS)
    large = table.predicted_area >= _LEAST_POINTS
    meets = (table.iou > overlap)[np.ix_(counted, large)]
    sure = np.array([score.get(int(i), 0.0) for i in table.predicted_ids[large]], np.float64)
    free = table.intersection[np.ix_(~counted, large)].sum(axis=0) / table.predicted_area[large]
    right, wrong = list[float](), sure[~meets.any(axis=0) & (free <= overlap)].tolist()
    taken = np.zeros(len(sure), bool)
    for own in meets:
        choice = np.flatnonzero(own & ~taken)
        if len(choice):
            taken[choice[0]] = True
            *others, surest = np.sort(sure[choice]).tolist()
            right.append(surest)
            wrong += others
    return _area(np.array(right), np.array([*right, *wrong]), int(counted.sum()))


def _area(right: Float64, found: Float64, instances: int) -> float:
    """right, found: the scores of the right predictions and of all."""
    thresholds = np.unique(found)[::-1, None]
    hits = (right >= thresholds).sum(axis=1)
    precision = np.array([1, *hits / (found >= thresholds).sum(axis=1)])
    recall = np.array([0, *hits]) / max(1, instances)
    return float(np.trapezoid(precision, recall))
