"""Open-vocabulary evaluation on labelled frames, as LERF-OVS labels them (spec 2.2)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ss_flow.errors import InputError
from ss_flow.tasks.artifacts import Bool, Float64
from ss_flow.tasks.evaluate.contingency import Labels
from ss_flow.tasks.evaluate.instances import summary
from ss_flow.tasks.masks.overlap import iou


@dataclass(frozen=True)
class LabelledFrame:
    """The polygons drawn on one photo, in the order of the file."""

    name: str
    width: int
    height: int
    polygons: tuple[tuple[str, Float64], ...]
    """Category, and corners [n, 2] as x, y in pixels."""


def labelled_frame(document: Mapping[str, Any], where: str) -> LabelledFrame:
    """Read a label document (`info: {name, width, height}`, `objects: [{category, segmentation: [[x, y], ...]}]`).

    where: the file's name, for messages. Raises InputError when the document lacks any of these.
    """
    try:
        info = document["info"]
        polygons = tuple((str(o["category"]), np.array(o["segmentation"], float)) for o in document["objects"])
        frame = LabelledFrame(str(info["name"]), int(info["width"]), int(info["height"]), polygons)
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"{where} is no label file ({error}); info (name, width, height) and objects, each with category and "
            "segmentation, are expected."
        ) from error
    for category, corners in frame.polygons:
        if corners.ndim != 2 or corners.shape[1] != 2 or len(corners) < 3:
            raise InputError(
                f"{where} draws '{category}' with no proper polygon; a list of 3 or more [x, y] is expected."
            )
    return frame


def oracle_targets(frame: LabelledFrame) -> list[tuple[str, Bool]]:
    """Every polygon as a target of its own, in the order of the file: category, [H, W]."""
    return [(category, _filled(frame, corners)) for category, corners in frame.polygons]


def strict_targets(frame: LabelledFrame) -> dict[str, Bool]:
    """One target a category: the union of its polygons, [H, W]; in order of first appearance."""
    targets: dict[str, Bool] = {}
    for category, mask in oracle_targets(frame):
        targets[category] = targets[category] | mask if category in targets else mask
    return targets


def strict_ious(frame: LabelledFrame, predicted: Mapping[str, Bool]) -> dict[str, float]:
    """IoU of each (frame, category) pair; a category without a predicted mask scores 0 (spec 2.2, strict, step 5).

    predicted: binary silhouette [H, W] of what was selected for each category, by text alone.
    """
    return {
        category: iou(predicted[category], target) if category in predicted else 0.0
        for category, target in strict_targets(frame).items()
    }


def strict_scores(frames: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """A scene's miou, macc25 and macc50 over all (frame, category) pairs, each pair counting once; IoU > 0.25 is a hit.

    frames: the result of `strict_ious` for each frame. Raises InputError when no frame has a label.
    """
    ious = np.array([iou for frame in frames for iou in frame.values()])
    if not ious.size:
        raise InputError("The label files hold no polygon; at least one is needed to evaluate.")
    return summary(ious)


def oracle_ious(frame: LabelledFrame, ids: Labels, candidates: Mapping[str, frozenset[int]]) -> list[float]:
    """IoU of every polygon when ground truth picks among the candidates (spec 2.2, oracle, step c).

    ids: [H, W] one instance id a pixel. candidates: instance ids that the text admits for each category. In file
    order each polygon takes the unused candidate with the highest IoU (the lowest id of equals); none left scores 0.
    """
    present = {int(i) for i in np.unique(ids)}
    scores = []
    for category, target in oracle_targets(frame):
        free = sorted(candidates.get(category, frozenset()) & present)
        fit = {i: iou(ids == i, target) for i in free}
        chosen = max(free, key=fit.__getitem__, default=None)
        scores.append(0.0 if chosen is None else fit[chosen])
        present.discard(-1 if chosen is None else chosen)
    return scores


def oracle_scores(frames: Sequence[Sequence[float]]) -> dict[str, float]:
    """A scene's miou, macc25 and macc50 as the mean of the frames' means; IoU >= 0.25 is a hit (spec 2.2, oracle, e).

    frames: the result of `oracle_ious` for each frame. Raises InputError when no frame has a label.
    """
    kept = [np.array(frame) for frame in frames if len(frame)]
    if not kept:
        raise InputError("The label files hold no polygon; at least one is needed to evaluate.")
    return {
        "miou": float(np.mean([f.mean() for f in kept])),
        "macc25": float(np.mean([(f >= 0.25).mean() for f in kept])),
        "macc50": float(np.mean([(f >= 0.50).mean() for f in kept])),
    }


def _filled(frame: LabelledFrame, corners: Float64) -> Bool:
    import cv2

    mask = np.zeros((frame.height, frame.width), np.uint8)
    cv2.fillPoly(mask, [corners.astype(np.int32)], 1)
    return mask.astype(bool)
