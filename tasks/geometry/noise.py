"""Noise of photos: how much of it there is, and the photo without it."""

from __future__ import annotations

import numpy as np

from ss_flow.tasks.artifacts import Float32, UInt8

_PLAIN = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32) / 6
"""No plane and no straight edge along an axis answers; white noise does, with its own standard deviation (J. Immerkaer,
Fast Noise Variance Estimation, 1996)."""
_BLOCK = 16
"""Pixels of the side of a block."""
_SMOOTHEST = 0.1
"""Share of the blocks that is taken to show noise alone, and no texture."""
_STRENGTH = 10.0
"""How far patches of noise may be apart that are averaged, of 255."""
_PATCH, _REACH = 5, 15
"""Pixels of the sides of a patch, and of the square that like ones are looked for in."""


def noise_of(rgb: UInt8) -> float:
    """Standard deviation of the noise from pixel to pixel of a photo [H, W, 3], of 255 grey values.

    That of its smoothest blocks, so that texture does not count; those with black or white in them say nothing. JPEG
    takes much noise away. 0 where no block counts.
    """
    import cv2

    gray = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
    fine, level = (_blocks(image) for image in (np.abs(cv2.filter2D(gray.astype(np.float32), -1, _PLAIN)), gray))
    told = fine[(level.min(axis=1) > 0) & (level.max(axis=1) < 255)].mean(axis=1)
    return float(np.sqrt(np.pi / 2) * np.quantile(told, _SMOOTHEST)) if len(told) else 0.0


def without_noise(rgb: UInt8) -> UInt8:
    """A photo [H, W, 3] by non-local means (A. Buades, B. Coll, J.-M. Morel, 2005), which keep edges, and texture that
    repeats."""
    import cv2

    return np.asarray(cv2.fastNlMeansDenoisingColored(rgb, None, _STRENGTH, _STRENGTH, _PATCH, _REACH))


def _blocks(image: UInt8 | Float32) -> UInt8 | Float32:
    """[N, B^2] the pixels of the whole blocks of an image [H, W]."""
    rows, columns = (side // _BLOCK for side in image.shape)
    cut = image[: rows * _BLOCK, : columns * _BLOCK].reshape(rows, _BLOCK, columns, _BLOCK)
    return cut.swapaxes(1, 2).reshape(rows * columns, _BLOCK**2)
