"""How alike the colours of sets of points are: smoothed histograms in CIELAB."""

from __future__ import annotations

import math

import numpy as np

from ss_flow.tasks.artifacts import Float32, Int32, UInt8

_EDGE = 8.0
"""Of a bin, in CIELAB units."""
_BINS = (13, 32, 32)
"""Bins of L* from 0 on, and of a* and b* from -128 on."""


def bins_of(colors: UInt8) -> Int32:
    """The bin of each RGB colour [N, 3], as a flat index: [N]."""
    import cv2

    lab = cv2.cvtColor(colors[None].astype(np.float32) / 255, cv2.COLOR_RGB2LAB)[0]
    bins = ((lab + np.array([0, 128, 128], np.float32)) / _EDGE).astype(np.int32)
    return np.ravel_multi_index(tuple(bins.T), _BINS).astype(np.int32)


def histogram(bins: Int32, spread: float) -> Float32:
    """How often each bin occurs, smoothed by a Gaussian of this standard deviation in CIELAB units: [B]."""
    from scipy.ndimage import gaussian_filter

    count = np.bincount(bins, minlength=math.prod(_BINS)).reshape(_BINS).astype(np.float32)
    return np.asarray(gaussian_filter(count, spread / _EDGE, mode="constant")).ravel()


def likeness(a: Float32, b: Float32) -> float:
    """The cosine of two histograms [B], 0..1."""
    return float(a @ b / np.sqrt((a @ a) * (b @ b)))
