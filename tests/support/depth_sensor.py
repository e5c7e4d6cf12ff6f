"""What a depth camera measures of exact depth maps."""

from __future__ import annotations

from dataclasses import replace
from typing import TypeVar

import numpy as np

from ss_flow.flows.generated.room import Views
from ss_flow.tasks.artifacts import Float32, Float64

V = TypeVar("V", bound=Views)

_CORRELATED = 1.5
"""Pixels over which noise is correlated."""
_STEP = 0.04
"""Change of depth within three pixels, as a share of it, that is an edge."""
_LOST = 0.6, 0.015
"""Share of the pixels without depth: at edges, and elsewhere."""
_DEVIATION, _DISPARITY = 1.425e-3, 2.85e-3
"""Of a structured-light camera, times the squared depth in metres: the standard deviation, and how far two depths lie
apart that it tells from each other (Khoshelham and Elberink, Sensors 12(2), 2012)."""
_NEAR = 0.0025
"""Standard deviation near by, as a share of the depth."""
_RANGE = 0.5, 5.0
"""Depths that it measures, metres."""


def noisy(depth: Float32, share: float | Float64, rng: np.random.Generator) -> Float64:
    """A depth map [H, W] with correlated noise, whose standard deviation is this share of the depth."""
    from scipy.ndimage import gaussian_filter

    noise = gaussian_filter(rng.normal(size=depth.shape), _CORRELATED)
    return np.asarray(depth * (1 + share * noise / noise.std()))


def with_holes(measured: Float64, depth: Float32, rng: np.random.Generator) -> Float64:
    """What was measured of a depth map, both [H, W], without most pixels at its edges and a few others: 0 there."""
    from scipy.ndimage import maximum_filter, minimum_filter

    edge = maximum_filter(depth, 3) - minimum_filter(depth, 3) > _STEP * depth
    lost = edge & (rng.random(depth.shape) < _LOST[0])
    return np.where(lost | (rng.random(depth.shape) < _LOST[1]), 0, measured)


def seen_near(depth: Float32, rng: np.random.Generator) -> Float32:
    """What a depth camera measures of a map [H, W] of near things; 0 where nothing."""
    return with_holes(noisy(depth, _NEAR, rng), depth, rng).astype(np.float32)


def structured_light(depth: Float32, rng: np.random.Generator) -> Float32:
    """What a camera as the first Kinect measures of a depth map [H, W], metres; 0 where nothing.

    At 3 m its noise has a standard deviation of 13 mm, and depths come in steps of 26 mm.
    """
    measured = noisy(depth, _DEVIATION * depth.astype(np.float64), rng)
    inverse = np.round(1 / (_DISPARITY * np.maximum(measured, 0.1))) * _DISPARITY  # whole steps of disparity
    measured = with_holes(1 / np.maximum(inverse, _DISPARITY), depth, rng)
    in_range = (depth >= _RANGE[0]) & (depth <= _RANGE[1])
    return np.where(in_range, measured, 0).astype(np.float32)


def sensed(views: V, seed: int) -> V:
    """The views, of a room whose depth is exact, with what such a camera measures of it in place of that."""
    rng = np.random.default_rng(seed)
    return replace(views, depth=np.stack([structured_light(depth, rng) for depth in views.depth]))
