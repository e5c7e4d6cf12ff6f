"""Which masks of a view show which label."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from ss_flow.tasks.artifacts import Bool, Int32, MaskSet, Visibility
from ss_flow.tasks.masks.erosion import ErosionParams, interiors
from ss_flow.tasks.masks.overlap import weighted_iou
from ss_flow.tasks.masks.painting import PaintedView, by_area, paint_labels
from ss_flow.tasks.masks.pool import canonical_order
from ss_flow.tasks.ranges import Fraction

_BACKED = 0.3
"""A mask joins another one of its label only with points of the label this dense in what it adds, as a share of how
dense they are in the other: few points say nothing about a large area."""


@dataclass(frozen=True)
class SelectionParams:
    """How the labels of points pick the masks of a view."""

    masks: Literal["best", "all"] = "best"
    """The masks that together agree best with a label's points, or, as in the paper, all that overlap it most."""
    min_iou: Fraction = 0.3
    """IoU with a label's painted points below which a mask does not show the label: one that was prompted or drawn for
    it, or, with "best", one of the view's own."""
    unlabelled: Fraction = 0.5
    """How much a point without a label counts where masks are held against points (only with "best")."""
    erosion: ErosionParams = field(default_factory=ErosionParams)
    """How far a mask's border is taken off before its majority is counted (only with "all")."""


def paint_for_selection(view: Visibility, label: Int32, params: SelectionParams) -> PaintedView:
    """The labels [N] of all dense points as masks are picked by: by the area that they cover, where points without one
    count less (`unlabelled`), or, with "all", by their number."""
    painted = paint_labels(view, label)
    if params.masks == "all":
        return painted
    painted = by_area(painted, view.height, view.width)
    counts = np.where(painted.label == 0, np.float32(params.unlabelled), np.float32(1))
    return replace(painted, area=painted.area * counts)


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
    labels, index = np.unique(painted.label, return_inverse=True)
    row_at = np.full(pool.height * pool.width, -1, np.int32)
    row_at[painted.pixel] = np.arange(len(painted.pixel), dtype=np.int32)
    # The rows of `painted` that a mask holds: most masks are a small part of the picture.
    held = [rows[rows >= 0] for rows in (row_at[np.flatnonzero(mask)] for mask in dense)]
    count = np.stack([np.bincount(index[rows], painted.area[rows], len(labels)) for rows in held])
    total = np.bincount(index, painted.area, len(labels))
    fits = count / np.maximum(count.sum(axis=1, keepdims=True) + total - count, 1)
    fits[:, labels == 0] = 0
    rank = np.round(fits * pool.quality[order, None], 9)

    shown: dict[int, Bool] = {}
    pairs = sorted(
        zip(*np.nonzero((fits > 0) & (fits >= params.min_iou)), strict=True), key=lambda p: (-rank[p], p[::-1])
    )
    free = np.ones(len(dense), bool)
    for row, column in pairs:
        if free[row] and int(labels[column]) not in shown:
            free[row] = False
            shown[int(labels[column])] = dense[row]

    # An occluder may cut an object in two: what is left joins where it fits.
    most = labels[count.argmax(axis=1)]
    for label in sorted(shown):
        for row in np.flatnonzero(free & (most == label)):
            both = shown[label] | dense[row]
            if _is_better(painted, label, both, shown[label]):
                free[row] = False
                shown[label] = both
    return shown


def _is_better(painted: PaintedView, label: int, mask: Bool, part: Bool) -> bool:
    """Whether a mask [H, W] shows a label better than a part of it does, and what it adds is backed by points."""
    mine = painted.label == label
    after, before = (one.ravel()[painted.pixel] for one in (mask, part))
    backed = (mine & after & ~before).sum() / max(1, (mask & ~part).sum())
    if backed < _BACKED * (mine & before).sum() / part.sum():
        return False
    return weighted_iou(after, mine, painted.area) > weighted_iou(before, mine, painted.area)
