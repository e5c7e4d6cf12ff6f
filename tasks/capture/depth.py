"""Depth without a sensor: a plane sweep for each view, then agreement between views (spec row 10, "mvs")."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from ss_flow.errors import InputError
from ss_flow.task import task
from ss_flow.tasks.artifacts import DepthMap, Float32, Frame
from ss_flow.tasks.geometry.cameras import Camera
from ss_flow.tasks.geometry.images import averaged_valid, shared_rgb, shared_valid, size_within
from ss_flow.tasks.geometry.plane_sweep import (
    SweepView,
    agreeing_depth,
    best_views,
    cheapest_depth,
    inverse_depth_planes,
    matching_cost,
    smooth_cost,
    typical_depth,
)
from ss_flow.tasks.ranges import Count, Fraction, NonNegative, Positive, Range

_COARSE_SIDE = 120
_COARSE_PLANES = 96
_CLEAR_COST = 0.25
_CLEAR_MARGIN = 0.03


@dataclass(frozen=True)
class SweepParams:
    """How the depth of a view is swept."""

    max_side: Count = 320
    """Longer side of the depth map, in pixels."""
    planes: Annotated[int, Range(3, float("inf"))] = 96
    """Depths that are tried, evenly spaced in inverse depth."""
    sources: Count = 6
    """Other views that each view is compared with."""
    best: Count = 3
    """Out of those, so many that match a pixel best decide."""
    window: Count = 9
    """Side of the window that is compared, in pixels; an even number counts as the odd one above it."""
    small_step: NonNegative = 0.04
    """Price of a step by one plane between neighbouring pixels (costs lie in 0..1)."""
    large_step: NonNegative = 0.3
    """Price of a larger jump."""
    max_cost: Fraction = 0.45
    """Pixels whose best match is dearer are unknown; 0.45 is a correlation of 0.1. Loose, since `agree` sorts out what
    is wrong far better than a view can alone, and needs what is right."""


@dataclass(frozen=True)
class AgreementParams:
    """Which swept depth is believed."""

    neighbors: Count = 8
    """Other views that are asked."""
    min_views: Count = 2
    """So many of them must agree."""
    max_pixels: Positive = 1.5
    """How far a pixel may come back from where it started, in pixels of the depth map."""
    max_relative: Positive = 0.02
    """How far the depths may be apart, as a share of the depth."""

    def __post_init__(self) -> None:
        if self.min_views > self.neighbors:
            raise InputError(
                f"min_views is {self.min_views} but only {self.neighbors} neighbors are asked; it must be at most that."
            )


@task(name="capture.sweep")
def sweep(
    frames: tuple[Frame, ...],
    cameras: tuple[Camera, ...],
    *,
    span: tuple[float, float] | None = None,
    params: SweepParams = SweepParams(),
) -> DepthMap:
    """The depth of a view by plane sweep. Much of it is wrong until `agree` has compared it with its neighbours'.

    frames, cameras: of the view, then of its neighbours. span: the nearest and the farthest depth that are tried, world
    units; None = as a coarse sweep finds them. The depth of a view that no other overlaps is unknown throughout.
    """
    near, far = span or _coarse_span(frames, cameras, params)
    sources = source_views(cameras, 2 / (1 / near + 1 / far), params.sources)
    reference = photo_at_size(frames[0], cameras[0], params.max_side)
    if not sources:
        return DepthMap(frames[0].name, np.zeros_like(reference.gray), "mvs")
    others = [photo_at_size(frames[k], cameras[k], params.max_side) for k in sources]
    planes = inverse_depth_planes(near, far, params.planes)
    cost = matching_cost(reference, others, planes, params.window | 1, params.best)
    smooth = smooth_cost(cost, reference.gray, params.small_step, params.large_step)
    depth, _ = cheapest_depth(smooth, planes)
    best = smooth.argmin(axis=2)
    matched = np.take_along_axis(cost, best[..., None], axis=2)[..., 0] <= params.max_cost
    inner = (best > 0) & (best < params.planes - 1)
    keep = matched & inner & reference.valid
    return DepthMap(frames[0].name, np.where(keep, depth, 0).astype(np.float32), "mvs")


@task(name="capture.agree")
def agree(
    maps: tuple[DepthMap, ...], cameras: tuple[Camera, ...], *, params: AgreementParams = AgreementParams()
) -> DepthMap:
    """A view's depth where enough neighbours found the same, averaged over them; elsewhere unknown.

    maps, cameras: of the view, then of its neighbours.
    """
    own, *others = ((m.depth, c.scaled(m.depth.shape[1], m.depth.shape[0])) for m, c in zip(maps, cameras, strict=True))
    known = own[0][own[0] > 0]
    if not known.size:
        return maps[0]
    asked = source_views(cameras, float(np.median(known)), params.neighbors)
    depth = agreeing_depth(
        *own,
        [others[k - 1] for k in asked],
        params.max_pixels,
        params.max_relative,
        min(params.min_views, max(1, len(others))),
    )
    return DepthMap(maps[0].name, depth, maps[0].source)


def photo_at_size(frame: Frame, camera: Camera, max_side: int) -> SweepView:
    """The gray photo of a view, scaled down to a longer side of `max_side` pixels, with its camera."""
    import cv2

    size = size_within(max_side, camera.width, camera.height)
    gray = cv2.cvtColor(shared_rgb(frame), cv2.COLOR_RGB2GRAY).astype(np.float32)
    valid = shared_valid(frame)
    if size != (camera.width, camera.height):
        gray = cv2.resize(gray, size, interpolation=cv2.INTER_AREA)
        valid = averaged_valid(valid, *size)
    return SweepView(gray, valid, camera.scaled(*size))


def source_views(cameras: Sequence[Camera], depth: float | Float32, count: int) -> list[int]:
    """Those of the others that tell most of the first view's depth, best first.

    depth: typical of the view, or [h, w], world units. Returns places among the cameras.
    """
    return [1 + k for k in best_views(cameras[0], cameras[1:], depth, count)]


def _coarse_span(frames: Sequence[Frame], cameras: Sequence[Camera], params: SweepParams) -> tuple[float, float]:
    """The nearest and the farthest depth of the first view, world units, by a coarse sweep."""
    camera = cameras[0]
    guess = typical_depth(cameras)
    sources = source_views(cameras, guess, params.sources)
    if not sources:
        return guess / 4, guess * 4
    baseline = float(np.median([np.linalg.norm(cameras[k].center - camera.center) for k in sources]))
    baseline = max(baseline, 1e-6 * guess)
    reference = photo_at_size(frames[0], camera, _COARSE_SIDE)
    others = [photo_at_size(frames[k], cameras[k], _COARSE_SIDE) for k in sources]
    planes = inverse_depth_planes(1.5 * baseline, 60 * baseline, _COARSE_PLANES)
    cost = matching_cost(reference, others, planes, 7, params.best)
    smooth = smooth_cost(cost, reference.gray, params.small_step, params.large_step)
    depth, margin = cheapest_depth(smooth, planes)
    clear = depth[(cost.min(axis=2) <= _CLEAR_COST) & (margin >= _CLEAR_MARGIN) & reference.valid]
    if clear.size < 50:
        return 2 * baseline, 50 * baseline
    low, high = 1 / np.quantile(1 / clear, (0.98, 0.02))
    return float(low) * 0.8, float(high) * 1.5
