"""Mask interiors: where a mask's label can be trusted."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ss_flow.tasks.artifacts import Bool, Int32, MaskSet, PromptedMasks
from ss_flow.tasks.masks.pool import canonical_order, exclusive
from ss_flow.tasks.packed import bounds
from ss_flow.tasks.ranges import Fraction, Natural, NonNegative


@dataclass(frozen=True)
class ErosionParams:
    """How far a mask's border is taken off before its pixels vote (spec row 13, A9)."""

    radius: NonNegative = 3.0
    """Chebyshev radius for small masks, in pixels of an image `diagonal` pixels across."""
    radius_large: NonNegative = 4.0
    """The same for large masks."""
    large_area: Fraction = 0.05
    """Share of the image from which a mask is large."""
    diagonal: NonNegative = 800.0
    """Image diagonal that the radii refer to, in pixels; 0 takes them as they are for every image."""
    keep_share: Fraction = 0.25
    """The radius shrinks until at least this share of the mask survives."""
    keep_pixels: Natural = 30
    """And until at least this many pixels do; a smaller mask is not eroded."""


@dataclass(frozen=True)
class Interior:
    """One mask and its interior, as flat pixel indices, ascending."""

    mask: int
    """Index in its set of masks."""
    pixels: Int32
    """[P] the eroded mask."""
    whole: Int32
    """[W] the mask itself."""


def interiors(masks: MaskSet | PromptedMasks, params: ErosionParams, *, nested: bool) -> list[Interior]:
    """The eroded masks of one view (Split&Splat, M_{k,j} of Eq. 3), in canonical order; empty ones are left out.

    nested: whether masks keep the pixels that smaller masks cover too. If not, each pixel belongs to the smallest mask
    on it, and the borders of the smaller masks are taken off the larger ones as well.
    """
    dense = masks.dense()
    if not len(dense):
        return []
    order = canonical_order(dense)
    on_top = None if nested else exclusive(dense, order)
    found = []
    for index in order:
        mask = dense[index] if on_top is None else on_top == index
        pixels = np.flatnonzero(erode(mask, params)).astype(np.int32)
        if pixels.size:
            found.append(Interior(int(index), pixels, np.flatnonzero(mask).astype(np.int32)))
    return found


def erode(mask: Bool, params: ErosionParams) -> Bool:
    """A mask [H, W] without its border; the image's own border takes nothing off (spec row 13)."""
    import cv2

    area = int(mask.sum())
    if not area:
        return mask
    height, width = mask.shape
    scale = float(np.hypot(height, width)) / params.diagonal if params.diagonal else 1.0
    large = area >= params.large_area * mask.size
    radius = round(min((params.radius_large if large else params.radius) * scale, max(mask.shape)))  # more is the same
    x0, y0, x1, y1 = bounds(mask)
    box = slice(max(y0 - radius, 0), y1 + radius), slice(max(x0 - radius, 0), x1 + radius)
    crop = mask[box].astype(np.uint8)
    for r in range(radius, 0, -1):
        inner = cv2.erode(crop, np.ones((2 * r + 1, 2 * r + 1), np.uint8))
        if inner.sum() >= max(params.keep_share * area, params.keep_pixels):
            eroded = np.zeros_like(mask)
            eroded[box] = inner.astype(bool)
            return eroded
    return mask
