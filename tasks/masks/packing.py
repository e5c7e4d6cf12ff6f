"""Masks as bits, grown by some pixels, and the box that holds one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ss_flow.tasks.artifacts import Bool, InstanceMasks, Int32, UInt8


def pack_masks(masks: Bool) -> UInt8:
    """[N, H, W] booleans as [N, ceil(H * W / 8)] bits, the form of `MaskSet.packed`."""
    return np.packbits(masks.reshape(len(masks), masks.shape[1] * masks.shape[2]), axis=1)


def joined(sizes: Sequence[tuple[int, int]] | Int32, masks: Sequence[UInt8]) -> tuple[Int32, UInt8]:
    """Width and height of each view, and its mask by `np.packbits`, as `sizes` and `packed` of `ViewMasks`."""
    return np.array(sizes, np.int32).reshape(-1, 2), np.concatenate([np.zeros(0, np.uint8), *masks])


def dilated(instance: InstanceMasks, pixels: int) -> InstanceMasks:
    """The same with masks that reach so many pixels farther on all sides."""
    if not pixels:
        return instance
    masks = [np.packbits(grown(instance.mask(row), pixels)) for row in range(len(instance.views))]
    return replace(instance, packed=joined(instance.sizes, masks)[1])


def grown(mask: Bool, pixels: int) -> Bool:
    """A mask [H, W] with all within so many pixels of it, diagonals included."""
    import cv2

    return cv2.dilate(mask.astype(np.uint8), np.ones((2 * pixels + 1,) * 2, np.uint8)) > 0


def bounds(mask: Bool) -> tuple[int, int, int, int]:
    """Columns and rows that hold a mask [H, W], not empty: x0, y0, x1, y1, the last two exclusive."""
    columns, rows = np.flatnonzero(mask.any(axis=0)), np.flatnonzero(mask.any(axis=1))
    return int(columns[0]), int(rows[0]), int(columns[-1]) + 1, int(rows[-1]) + 1
