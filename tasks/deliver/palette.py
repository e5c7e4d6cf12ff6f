"""Colours for instances and for depth, the same in every picture and file."""

from __future__ import annotations

import functools

import numpy as np
from numpy.typing import NDArray

from ss_flow.tasks.artifacts import Bool, Float32, UInt8

BACKGROUND = (58, 60, 66)
"""The colour of id 0."""

_GOLDEN_ANGLE = np.pi * (3 - np.sqrt(5))
_LIGHTNESS = (0.72, 0.58, 0.84, 0.65, 0.50)
_CHROMA = (0.17, 0.15, 0.12)
_CONES_FROM_LAB = np.array([[1, 0.39633778, 0.21580376], [1, -0.10556135, -0.06385417], [1, -0.08948418, -1.29148555]])
_RGB_FROM_CONES = np.array(
    [
        [4.07674166, -3.30771159, 0.23096993],
        [-1.26843800, 2.60975740, -0.34131940],
        [-0.00419609, -0.70341861, 1.70761470],
    ]
)


def instance_colors(count: int) -> UInt8:
    """The colours of the ids 0..count - 1: [count, 3] RGB. The colour of an id never depends on the others.

    Neighbouring ids are a golden angle of hue apart in OKLCh (Ottosson, "A perceptual color space for image
    processing"); lightness and chroma take turns, so that ids of similar hue differ in these.
    """
    ids = np.arange(count)
    hue = (ids + 0.3) * _GOLDEN_ANGLE
    chroma = np.take(_CHROMA, ids % len(_CHROMA))
    lab = np.stack([np.take(_LIGHTNESS, ids % len(_LIGHTNESS)), chroma * np.cos(hue), chroma * np.sin(hue)], axis=1)
    linear = (lab @ _CONES_FROM_LAB.T) ** 3 @ _RGB_FROM_CONES.T
    linear = linear.clip(0, 1)
    srgb = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    colors = np.rint(255 * srgb).astype(np.uint8)
    colors[:1] = BACKGROUND
    return colors


def instance_color(instance_id: int) -> tuple[int, int, int]:
    """The colour of one id, RGB."""
    r, g, b = (int(c) for c in instance_colors(instance_id + 1)[instance_id])
    return r, g, b


def paint_ids(ids: NDArray[np.integer], photo: UInt8 | None = None, strength: float = 0.55) -> UInt8:
    """An id map as colours with white borders: [H, W, 3].

    ids: [H, W], 0 = background. photo: [H, W, 3]; with it, instances are tinted and the background stays as it is.
    """
    colors = instance_colors(int(ids.max(initial=0)) + 1)[ids]
    if photo is None:
        painted = colors
    else:
        tinted = photo * (1 - strength) + colors * strength
        painted = np.where((ids > 0)[..., None], tinted, photo * 0.8).astype(np.uint8)
    return np.where(_borders(ids)[..., None], np.uint8(245), painted)


def _borders(ids: NDArray[np.integer]) -> Bool:
    edge = np.zeros(ids.shape, bool)
    edge[:, 1:] |= ids[:, 1:] != ids[:, :-1]
    edge[1:] |= ids[1:] != ids[:-1]
    return edge


def depth_colors(depth: Float32) -> tuple[UInt8, float, float]:
    """Depth as the turbo colour map, near = red, unknown (0) = dark: [..., 3], and the depths at its two ends.

    The ends are the 1st and 99th percentile of the known depths, so that a few wild values do not flatten the rest.
    """
    known = depth > 0
    low, high = (float(x) for x in np.percentile(depth[known], (1, 99))) if known.any() else (0.0, 1.0)
    place = ((depth - low) / max(high - low, 1e-9)).clip(0, 1)
    colors = turbo()[np.rint(255 * (1 - place)).astype(np.intp)]
    return np.where(known[..., None], colors, np.uint8(34)), low, high


@functools.cache
def turbo() -> UInt8:
    """The turbo colour map: [256, 3]."""
    from matplotlib import colormaps

    return np.rint(255 * colormaps["turbo"](np.arange(256))[:, :3]).astype(np.uint8)
