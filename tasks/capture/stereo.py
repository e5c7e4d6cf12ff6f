"""Depth without a sensor, the second look: PatchMatch in every view from what all views found together before.

What one view cannot tell, since its photo is blurred or its surfaces are plain there, another may: depth that views
agree on is carried into all others as the first guess, and holds planes to what the others found (Xu & Tao 2019, ACMM).
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from ss_flow.task import task
from ss_flow.tasks.artifacts import Bool, DepthMap, Float32, Frame
from ss_flow.tasks.capture.depth import photo_at_size, source_views
from ss_flow.tasks.capture.patchmatch import PatchMatchParams, Source, patchmatch, stereo_identity
from ss_flow.tasks.geometry.cameras import Camera, backproject, pixels_in_view
from ss_flow.tasks.geometry.holes import close_holes
from ss_flow.tasks.geometry.images import resampled
from ss_flow.tasks.ranges import Count, Fraction, Natural


@dataclass(frozen=True)
class StereoParams:
    """How the depth that a sweep found is refined."""

    rounds: Natural = 1
    """How often depth is refined and compared between views; 0 leaves it as swept, and 2 finds more that is right, at
    the price of more that is wrong."""
    max_side: Count = 320
    """Longer side of the depth map, in pixels; on blurred photos larger maps know less."""
    sources: Count = 8
    """Other photos that each photo is compared with."""
    max_cost: Fraction = 0.45
    """Pixels that match worse are unknown; 0.45 is a correlation of 0.1."""
    patchmatch: PatchMatchParams = field(default_factory=PatchMatchParams)


@task(name="capture.stereo", environment=stereo_identity)
def stereo(
    frames: tuple[Frame, ...],
    cameras: tuple[Camera, ...],
    found: DepthMap,
    agreed: tuple[DepthMap, ...],
    *,
    params: StereoParams = StereoParams(),
) -> DepthMap:
    """The depth of a view by PatchMatch, from what it and its neighbours found so far; `agree` must see it again.

    frames, cameras: of the view, then of its neighbours. found: the view's depth by itself; agreed: what other views
        confirm, of the view and its neighbours. Where the view has agreed depth, it starts from that, or else from its
        neighbours', or else from its own.
    Depth stays unknown throughout where the view has none yet.
    """
    reference = photo_at_size(frames[0], cameras[0], params.max_side)
    guess = resampled(agreed[0].depth, *reference.gray.shape)
    if not found.depth.any():
        return DepthMap(frames[0].name, np.zeros_like(reference.gray), "mvs")
    typical = float(np.median(found.depth[found.depth > 0]))
    lent = zip(agreed[1:], cameras[1:], strict=True)
    for other in (
        carried([(lender.depth, camera) for lender, camera in lent], reference.camera),
        resampled(found.depth, *reference.gray.shape),
        np.full_like(guess, typical),
    ):
        guess = np.where(guess > 0, guess, other)
    near, far = np.quantile(guess, (0.005, 0.995))
    guess = np.clip(guess, 0.8 * near, 1.25 * far)
    sources = [
        Source(other, resampled(agreed[k].depth, *other.gray.shape))
        for k in source_views(cameras, guess, params.sources)
        for other in (photo_at_size(frames[k], cameras[k], params.max_side),)
    ]
    if not sources:
        return DepthMap(frames[0].name, np.zeros_like(reference.gray), "mvs")
    depth, cost = patchmatch(reference, sources, guess, 0, params.patchmatch)
    keep = (cost <= params.max_cost) & reference.valid
    return DepthMap(frames[0].name, np.where(keep, depth, 0).astype(np.float32), "mvs")


def carried(maps: list[tuple[Float32, Camera]], camera: Camera) -> Float32:
    """The depth that other views' maps show to a camera, the nearest at each pixel; 0 where they show none.

    maps: [h, w] z-depth in world units, 0 where unknown, each with its view's camera. Returns [H, W].
    """
    front = np.full(camera.height * camera.width, np.inf, np.float32)
    for depth, other in maps:
        points = backproject(depth, other.scaled(depth.shape[1], depth.shape[0]))[depth.ravel() > 0]
        _, column, row, z = pixels_in_view(points, camera)
        np.minimum.at(front, row * camera.width + column, z.astype(np.float32))
    seen: Bool = np.isfinite(front)
    return close_holes(np.where(seen, front, 0).astype(np.float32).reshape(camera.height, camera.width))
