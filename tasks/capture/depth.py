"""Depth without a sensor: a plane sweep for each view, then agreement between views (spec row 10, "mvs")."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from ss_flow.errors import InputError
from ss_flow.running import progress
from ss_flow.task import task
from ss_flow.tasks.artifacts import Cameras, DepthMap, Float32, Frame
from ss_flow.tasks.geometry.cameras import Camera, camera_of, pixels_in_view
from ss_flow.tasks.geometry.images import decode_rgb, decode_valid
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


@task(name="capture.sweep")
def sweep(
    frames: tuple[Frame, ...],
    cameras: Cameras,
    *,
    view: int,
    params: SweepParams = SweepParams(),
) -> DepthMap:
    """The depth of one view by plane sweep. Much of it is wrong until `agree` has seen all views' depth.

    The range of depths comes from the sparse points that the view sees or, without them, from a coarse sweep. The
    depth of a view that no other overlaps is unknown throughout.
    """
    all_cameras = [camera_of(cameras, k) for k in range(len(cameras))]
    camera = all_cameras[view]
    near, far = _depth_range(frames, cameras, all_cameras, view, params)
    sources = source_views(all_cameras, view, 2 / (1 / near + 1 / far), params.sources)
    reference = photo_at_size(frames[view], camera, params.max_side)
    if not sources:
        return DepthMap(frames[view].name, np.zeros_like(reference.gray), "mvs")
    others = [photo_at_size(frames[k], all_cameras[k], params.max_side) for k in sources]
    planes = inverse_depth_planes(near, far, params.planes)
    cost = matching_cost(reference, others, planes, params.window | 1, params.best)
    smooth = smooth_cost(cost, reference.gray, params.small_step, params.large_step)
    depth, _ = cheapest_depth(smooth, planes)
    best = smooth.argmin(axis=2)
    matched = np.take_along_axis(cost, best[..., None], axis=2)[..., 0] <= params.max_cost
    inner = (best > 0) & (best < params.planes - 1)
    keep = matched & inner & reference.valid
    return DepthMap(frames[view].name, np.where(keep, depth, 0).astype(np.float32), "mvs")


@task(name="capture.agree")
def agree(
    maps: tuple[DepthMap, ...],
    cameras: Cameras,
    *,
    params: AgreementParams = AgreementParams(),
) -> tuple[DepthMap, ...]:
    """Swept depth where enough other views found the same, averaged over them; elsewhere unknown.

    maps: one a view, in the cameras' order.
    Raises InputError when nothing remains in any view.
    """
    all_cameras = [camera_of(cameras, k) for k in range(len(cameras))]
    sized = [c.scaled(m.depth.shape[1], m.depth.shape[0]) for m, c in zip(maps, all_cameras, strict=True)]
    result = []
    for k, own in enumerate(maps):
        known = own.depth[own.depth > 0]
        depth = own.depth
        if known.size:
            near = source_views(all_cameras, k, float(np.median(known)), params.neighbors)
            depth = agreeing_depth(
                depth,
                sized[k],
                [(maps[n].depth, sized[n]) for n in near],
                params.max_pixels,
                params.max_relative,
                min(params.min_views, max(1, len(maps) - 1)),
            )
        result.append(DepthMap(own.name, depth, own.source))
        progress(k + 1, len(maps), own.name)
    if not any(m.depth.any() for m in result):
        raise InputError(
            f"no depth is found in any of the {len(maps)} views by comparing them; photos that overlap by two thirds "
            "from different places are needed, or depth from a sensor."
        )
    return tuple(result)


def photo_at_size(frame: Frame, camera: Camera, max_side: int) -> SweepView:
    """The gray photo of a view, scaled down to a longer side of `max_side` pixels, with its camera."""
    import cv2

    scale = min(1.0, max_side / max(camera.width, camera.height))
    size = (round(camera.width * scale), round(camera.height * scale))
    gray = cv2.cvtColor(decode_rgb(frame), cv2.COLOR_RGB2GRAY).astype(np.float32)
    valid = decode_valid(frame).astype(np.float32)
    if scale < 1:
        gray = cv2.resize(gray, size, interpolation=cv2.INTER_AREA)
        valid = cv2.resize(valid, size, interpolation=cv2.INTER_AREA)
    return SweepView(gray, valid > 0.999, camera.scaled(*size))


def source_views(cameras: list[Camera], view: int, depth: float | Float32, count: int) -> list[int]:
    """The views that tell most of one view's depth, best first; depth: typical, or [h, w] of the view, world units."""
    others = [k for k in range(len(cameras)) if k != view]
    return [others[i] for i in best_views(cameras[view], [cameras[k] for k in others], depth, count)]


def _depth_range(
    frames: tuple[Frame, ...], cameras: Cameras, all_cameras: list[Camera], view: int, params: SweepParams
) -> tuple[float, float]:
    camera = all_cameras[view]
    *_, seen = pixels_in_view(cameras.sparse_points, camera)
    if len(seen) >= 50:
        low, high = np.quantile(seen, (0.01, 0.98))
        return float(low) * 0.8, float(high) * 1.25
    guess = typical_depth(all_cameras)
    sources = source_views(all_cameras, view, guess, params.sources)
    if not sources:
        return guess / 4, guess * 4
    baseline = float(np.median([np.linalg.norm(all_cameras[k].center - camera.center) for k in sources]))
    baseline = max(baseline, 1e-6 * guess)
    reference = photo_at_size(frames[view], camera, _COARSE_SIDE)
    others = [photo_at_size(frames[k], all_cameras[k], _COARSE_SIDE) for k in sources]
    planes = inverse_depth_planes(1.5 * baseline, 60 * baseline, _COARSE_PLANES)
    cost = matching_cost(reference, others, planes, 7, params.best)
    smooth = smooth_cost(cost, reference.gray, params.small_step, params.large_step)
    depth, margin = cheapest_depth(smooth, planes)
    clear = depth[(cost.min(axis=2) <= _CLEAR_COST) & (margin >= _CLEAR_MARGIN) & reference.valid]
    if clear.size < 50:
        return 2 * baseline, 50 * baseline
    low, high = 1 / np.quantile(1 / clear, (0.98, 0.02))
    return float(low) * 0.8, float(high) * 1.5
