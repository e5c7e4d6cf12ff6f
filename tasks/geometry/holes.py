"""Holes of a depth map that are as thin as a warp leaves them."""

from __future__ import annotations

import numpy as np

from ss_flow.tasks.artifacts import Float32
from ss_flow.tasks.geometry.images import inverse_depth

_STEP = 0.05
"""Share by which depths on both sides of a hole may differ; an edge may run between others."""


def close_holes(depth: Float32) -> Float32:
    """A depth map without its unknown pixels and lines of at most two pixels across.

    depth: [H, W] float32, 0 where unknown. A map that was moved pixel by pixel into another camera has them wherever
    neighbours moved apart. A hole is closed by the mean inverse depth of the known pixels beside it, unless the largest
    and the smallest known depth within two pixels differ by more than a twentieth of the smaller: an edge may run
    through it. Wider holes stay as they are, and so does every known pixel.
    """
    import cv2

    known = depth > 0
    if known.all():
        return depth
    # Closing with 3 x 3 keeps unknown what holds a whole 3 x 3 block of unknown pixels.
    thin = cv2.morphologyEx(known.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8)) > 0
    near = np.ones((5, 5), np.uint8)  # reaches both sides of a line of two pixels
    largest = cv2.dilate(depth, near)
    smallest = cv2.erode(np.where(known, depth, np.float32(np.inf)), near)
    hole = thin & ~known & (largest / smallest <= 1 + _STEP)
    images = known.astype(np.float32), inverse_depth(depth)
    count, total = (cv2.boxFilter(image, -1, (3, 3), normalize=False) for image in images)
    return np.where(hole, count / np.where(hole, total, 1), depth).astype(np.float32)
