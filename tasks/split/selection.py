"""Which masks of a view show which label."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from ss_flow.tasks.artifacts import Bool, Float64, Int32, MaskSet, Visibility
from ss_flow.tasks.geometry.zbuffer import paint
from ss_flow.tasks.ranges import Fraction
from ss_flow.tasks.split.erosion import ErosionParams, interiors
from ss_flow.tasks.split.mask_pool import canonical_order, large_pieces

_CRUMB = 0.1
"""Pieces of a drawn mask below this share of its largest one are no part of it."""
_BACKED = 0.3
"""A mask joins another one of its label only with points of the label this dense in what it adds, as a share of how
dense they are in the other: few points say nothing about a large area."""


@dataclass(frozen=True)
class SelectionParams:
    """How the labels of points pick the masks of a view."""

    masks: Literal["best", "all"] = "best"
    """The masks that together agree best with a label's points, or, as in the paper, all that overlap it most."""
    min_iou: Fraction = 0.3
    """IoU with a label's painted points below which no mask shows the label (only with "best")."""
    unlabelled: Fraction = 0.5
    """How much a point without a label counts against a mask that holds it (only with "best")."""
    erosion: ErosionParams = field(default_factory=ErosionParams)
    """How far a mask's border is taken off before its majority is counted (only with "all")."""


@dataclass(frozen=True)
class PaintedView:
    """The labels of the points in front, by pixel."""

    pixel: Int32
    """[P] flat indices of the pixels where a point falls, ascending."""
    label: Int32
    """[P] label of the point in front, 0 = unlabelled."""


def paint_labels(view: Visibility, label: Int32) -> PaintedView:
    """Paint the labels [N] of all dense points into a view; nearest depth wins a pixel."""
    image = paint(label[view.point_index] + 1, view.pixel, view.depth, view.height * view.width)
    pixel = np.flatnonzero(image).astype(np.int32)
    return PaintedView(pixel, image[pixel] - 1)


def labels_in_front(painted: PaintedView, min_points: int) -> list[int]:
    """The labels that at least so many points in front carry, ascending."""
    names, counts = np.unique(painted.label, return_counts=True)
    found: list[int] = names[(names > 0) & (counts >= min_points)].tolist()
    return found


def select_masks(painted: PaintedView, pool: MaskSet, params: SelectionParams) -> dict[int, Bool]:
    """For each label that a view's masks show, its mask [H, W]; the masks of two labels may overlap (spec S5)."""
    dense = pool.dense()
    if not len(dense) or not (painted.label > 0).any():
        return {}
    if params.masks == "all":
        return _by_majority(painted, pool, dense, params)
    return _by_agreement(painted, pool, dense, params)


def _by_majority(painted: PaintedView, pool: MaskSet, dense: Bool, params: SelectionParams) -> dict[int, Bool]:
    """Every mask goes to the label that most painted pixels of its interior carry; masks of one label are united."""
    label = np.zeros(pool.height * pool.width, np.int32)
    label[painted.pixel] = painted.label
    shown: dict[int, Bool] = {}
    for interior in interiors(pool, params.erosion, nested=True):
        counts = np.bincount(label[interior.pixels])
        counts[0] = 0
        if counts.any():
            best = int(counts.argmax())
            shown[best] = shown[best] | dense[interior.mask] if best in shown else dense[interior.mask]
    return shown


def _by_agreement(painted: PaintedView, pool: MaskSet, dense: Bool, params: SelectionParams) -> dict[int, Bool]:
    """Each label takes the mask that agrees best with its points, then those that make the agreement better still.

    A mask shows one label at most; the pairs that agree best choose first, where the segmenter's own estimate of a mask
    counts too; ties by label, then by mask.
    """
    order = canonical_order(dense)
    dense = dense[order]
    names, index = np.unique(painted.label, return_inverse=True)
    flat = dense.reshape(len(dense), -1)[:, painted.pixel]
    count = np.stack([np.bincount(index[mask], minlength=len(names)) for mask in flat])
    total = np.bincount(index, minlength=len(names))
    area = count @ np.where(names == 0, params.unlabelled, 1.0)
    iou = count / np.maximum(area[:, None] + total - count, 1)
    iou[:, names == 0] = 0
    fit = np.round(iou * pool.quality[order, None], 9)

    chosen: dict[int, Bool] = {}
    shown: dict[int, Bool] = {}
    pairs = sorted(zip(*np.nonzero((iou > 0) & (iou >= params.min_iou)), strict=True), key=lambda p: (-fit[p], p[::-1]))
    free = np.ones(len(dense), bool)
    for row, column in pairs:
        if free[row] and column not in chosen:
            free[row] = False
            chosen[column], shown[int(names[column])] = flat[row], dense[row]

    # An occluder may cut an object in two: what is left joins where it fits.
    for column in sorted(chosen):
        mine, label = index == column, int(names[column])
        for row in np.flatnonzero(free & (count.argmax(axis=1) == column)):
            both = chosen[column] | flat[row]
            added = dense[row] & ~shown[label]
            backed = (mine & both & ~chosen[column]).sum() / max(1, added.sum())
            dense_enough = backed >= _BACKED * (mine & chosen[column]).sum() / shown[label].sum()
            if dense_enough and _iou(both, mine) > _iou(chosen[column], mine):
                free[row] = False
                chosen[column] = both
                shown[label] = shown[label] | dense[row]
    return shown


def _iou(a: Bool, b: Bool) -> float:
    union = int((a | b).sum())
    return float((a & b).sum() / union) if union else 0.0


def nearest_labels(painted: PaintedView, height: int, width: int, reach: float) -> Int32:
    """The label of the nearest painted pixel, at most `reach` pixels away: [H, W], 0 = unlabelled or none so near."""
    import cv2

    empty = np.ones(height * width, np.uint8)
    empty[painted.pixel] = 0
    distance, nearest = cv2.distanceTransformWithLabels(
        empty.reshape(height, width), cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL
    )
    table = np.zeros(int(nearest.max()) + 1, np.int32)
    table[nearest.ravel()[painted.pixel]] = painted.label
    return np.where(distance <= reach, table[nearest], 0)


def smoothed(mask: Bool, radius: int) -> Bool:
    """A mask [H, W] with smooth borders and without crumbs.

    A pixel belongs to it when most of the square of this radius round it does; pieces of less than a tenth of the
    largest one are dropped.
    """
    import cv2

    side = 2 * radius + 1
    most = cv2.boxFilter(mask.astype(np.float32), -1, (side, side), borderType=cv2.BORDER_REPLICATE) > 0.5
    return large_pieces(most, _CRUMB)[0]


def agreement(painted: PaintedView, mask: Bool, label: int) -> float:
    """IoU of a mask [H, W] with the points of a label, on the pixels where points fall."""
    return _iou(mask.ravel()[painted.pixel], painted.label == label)


def stack_exclusive(shown: dict[int, Bool], height: int, width: int) -> Int32:
    """One label a pixel, smaller masks on top, equal ones by the lower label: [H, W], 0 = none."""
    ids = np.zeros((height, width), np.int32)
    for label in sorted(shown, key=lambda label: (-int(shown[label].sum()), -label)):
        ids[shown[label]] = label
    return ids


def contradicted(painted: PaintedView, ids: Int32, num_labels: int) -> tuple[Float64, Float64]:
    """For each label the painted pixels that its mask holds, and those of them with another label: [L + 1] each."""
    under = ids.ravel()[painted.pixel]
    held = np.bincount(under, minlength=num_labels + 1).astype(np.float64)
    other = (painted.label > 0) & (painted.label != under)
    return held, np.bincount(under[other], minlength=num_labels + 1).astype(np.float64)
