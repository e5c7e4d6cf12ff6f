"""Labels of points, painted into a view."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ss_flow.tasks.artifacts import Bool, Float32, Float64, Int32, Visibility
from ss_flow.tasks.geometry.images import at_diagonal
from ss_flow.tasks.geometry.zbuffer import paint
from ss_flow.tasks.masks.overlap import weighted_iou

_REACH = 5.0
"""How far a painted pixel stands for those around it, in pixels of an image with a diagonal of 800."""


@dataclass(frozen=True)
class PaintedView:
    """The labels of the points in front, by pixel."""

    pixel: Int32
    """[P] flat indices of the pixels where a point falls, ascending."""
    label: Int32
    """[P] label of the point in front, 0 = unlabelled."""
    area: Float32
    """[P] pixels that each stands for."""

    @staticmethod
    def of(pixel: Int32, label: Int32) -> PaintedView:
        """Each painted pixel stands for itself."""
        return PaintedView(pixel, label, np.ones(len(pixel), np.float32))


def paint_labels(view: Visibility, label: Int32) -> PaintedView:
    """Paint the labels [N] of all dense points into a view; nearest depth wins a pixel, and stands for itself."""
    image = paint(label[view.point_index] + 1, view.pixel, view.depth, view.height * view.width)
    pixel = np.flatnonzero(image).astype(np.int32)
    return PaintedView.of(pixel, image[pixel] - 1)


def by_area(painted: PaintedView, height: int, width: int) -> PaintedView:
    """The same, where each painted pixel stands for all those that it is the nearest to, as far as `_REACH`.

    Points lie evenly in the world, not in a view: a wall far behind a table has more of them on fewer pixels.
    """
    if not len(painted.pixel):
        return painted
    number = np.arange(1, len(painted.pixel) + 1, dtype=np.int32)
    reach = at_diagonal(_REACH, height, width)
    nearest = nearest_labels(replace(painted, label=number), height, width, reach)
    area = np.bincount(nearest.ravel(), minlength=len(number) + 1)[1:]
    return replace(painted, area=area.astype(np.float32))


def labels_in_front(painted: PaintedView, min_points: int) -> list[int]:
    """The labels that at least so many points in front carry, ascending."""
    labels, counts = np.unique(painted.label, return_counts=True)
    found: list[int] = labels[(labels > 0) & (counts >= min_points)].tolist()
    return found


def nearest_painted(painted: PaintedView, height: int, width: int) -> tuple[Int32, Float32]:
    """The label of the painted pixel nearest to each pixel, and how far away that is, in pixels: [H, W] each."""
    import cv2

    empty = np.ones(height * width, np.uint8)
    empty[painted.pixel] = 0
    distance, nearest = cv2.distanceTransformWithLabels(
        empty.reshape(height, width), cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL
    )
    table = np.zeros(int(nearest.max()) + 1, np.int32)
    table[nearest.ravel()[painted.pixel]] = painted.label
    return table[nearest], distance


def nearest_labels(painted: PaintedView, height: int, width: int, reach: float) -> Int32:
    """The label of the nearest painted pixel, at most `reach` pixels away: [H, W], 0 = unlabelled or none so near."""
    label, distance = nearest_painted(painted, height, width)
    return np.where(distance <= reach, label, 0)


def agreement(painted: PaintedView, mask: Bool, label: int) -> float:
    """IoU of a mask [H, W] with the points of a label, on the pixels where points fall, each by its area."""
    return weighted_iou(mask.ravel()[painted.pixel], painted.label == label, painted.area)


def agreements(painted: PaintedView, ids: Int32, labels: Int32) -> Float64:
    """The same of some labels [L] at once, whose masks do not overlap: [L]. ids: [H, W] the label whose mask holds each
    pixel."""
    under = ids.ravel()[painted.pixel]
    count = int(max(under.max(initial=0), painted.label.max(initial=0), labels.max(initial=0))) + 1
    same = under == painted.label
    both, held, own = (
        np.bincount(of, areas, count)
        for of, areas in (
            (under[same], painted.area[same]),
            (under, painted.area),
            (painted.label, painted.area),
        )
    )
    return (both / np.maximum(held + own - both, 1))[labels]


def stack_exclusive(shown: dict[int, Bool], height: int, width: int) -> Int32:
    """One label a pixel, smaller masks on top, equal ones by the lower label: [H, W], 0 = none."""
    ids = np.zeros((height, width), np.int32)
    for label in sorted(shown, key=lambda label: (-int(np.count_nonzero(shown[label])), -label)):
        ids[shown[label]] = label
    return ids
