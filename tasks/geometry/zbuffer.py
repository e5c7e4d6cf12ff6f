"""Which of the points that fall on one pixel is in front."""

from __future__ import annotations

import numpy as np

from ss_flow.tasks.artifacts import Float32, Float64, Int32


def nearest_per_pixel(pixel: Int32, depth: Float32 | Float64, num_pixels: int) -> Int32:
    """For each pixel the point in front: [num_pixels] position in `pixel`, -1 where no point falls.

    pixel: [M] flat pixel index of each point; depth: [M] its z-depth. Equal depths: the first point wins.
    """
    front = np.full(num_pixels, -1, np.int32)
    # Of repeated indices NumPy keeps the last assignment, so the nearest comes last.
    far_to_near = np.argsort(depth, kind="stable")[::-1]
    front[pixel[far_to_near]] = far_to_near
    return front


def paint(value: Int32, pixel: Int32, depth: Float32 | Float64, num_pixels: int) -> Int32:
    """The values of the points in front, as a flat image: [num_pixels] int32, 0 where no point falls.

    value, pixel, depth: [M] of each point. Used for the virtual label images (Split&Splat, M*_k; spec S4.1).
    """
    front = nearest_per_pixel(pixel, depth, num_pixels)
    return np.append(value, 0)[front].astype(np.int32)  # -1, no point there, takes the 0
