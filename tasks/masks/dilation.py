"""Masks grown by some pixels."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ss_flow.tasks.artifacts import Bool, InstanceMasks
from ss_flow.tasks.packed import Masks


def dilated(instance: InstanceMasks, pixels: int) -> InstanceMasks:
    """The same with masks that reach so many pixels farther on all sides."""
    if not pixels:
        return instance
    return replace(instance, **vars(Masks.of(grown(instance.mask(row), pixels) for row in range(len(instance.views)))))


def grown(mask: Bool, pixels: int) -> Bool:
    """A mask [H, W] with all within so many pixels of it, diagonals included."""
    import cv2

    pixels = min(pixels, max(mask.shape))  # more reach no farther
    return cv2.dilate(mask.astype(np.uint8), np.ones((2 * pixels + 1,) * 2, np.uint8)) > 0
