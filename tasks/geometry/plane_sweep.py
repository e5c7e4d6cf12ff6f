"""Multi-view plane sweep: how well each pixel's surroundings match other views at each depth, and the best depth.

Fronto-parallel planes of the reference camera, evenly spaced in inverse depth, induce a homography into each source
view (Collins 1996). Similarity is the zero-mean normalised cross-correlation of windows. Each pixel keeps its best
source views only, since the others may not see it (Kang, Szeliski & Chai 2001). Costs are smoothed along eight
directions (Hirschmueller 2008, Eq. 13), and depths kept where other views agree (Schoenberger et al. 2016).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ss_flow.tasks.artifacts import Bool, Float32, Float64
from ss_flow.tasks.geometry.cameras import Camera, backproject, project

_IDEAL_ANGLE = 6.0
_NOISE_VARIANCE = 4.0
"""Of a window, in squared gray levels: flat windows correlate by their noise alone, and must not count as a match."""


@dataclass(frozen=True)
class SweepView:
    """A gray photo and its camera."""

    gray: Float32
    """[H, W] 0..255."""
    valid: Bool
    """[H, W]."""
    camera: Camera
    """Of the photo's size."""


def view_scores(camera: Camera, others: Sequence[Camera], depth: float | Float32) -> Float64:
    """How useful each other view is for the depth of one: the share of its pixels that it sees, if at `depth`, times
    how near their parallax is to 6 degrees (less cannot be measured, more cannot be matched).

    depth: in world units, of all pixels or a map, [h, w]. Returns [len(others)], 0..1.
    """
    wide = np.atleast_2d(np.asarray(depth, np.float32))
    rows, columns = ((np.arange(n) + 0.5) / n for n in (6, 8))
    sampled = wide[(rows * wide.shape[0]).astype(int)][:, (columns * wide.shape[1]).astype(int)]
    points = backproject(sampled, camera.scaled(8, 6))
    scores = np.zeros(len(others))
    if not others:
        return scores
    poses = np.array([other.world_to_camera for other in others])
    lenses = np.array([(c.fx, c.fy, c.cx, c.cy, c.width, c.height) for c in others])[:, None]
    local = points @ poses[:, :3, :3].transpose(0, 2, 1) + poses[:, None, :3, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        uv = local[..., :2] / local[..., 2:] * lenses[..., :2] + lenses[..., 2:4]
        seen = (local[..., 2] > 0) & ((uv >= 0) & (uv < lenses[..., 4:])).all(axis=-1)
    useful = np.flatnonzero(seen.any(axis=1))
    to_reference = points - camera.center
    centers = -poses[:, None, :3, 3] @ poses[:, :3, :3]
    to_other = points - centers[useful]
    cosine = (to_reference * to_other).sum(axis=-1)
    cosine /= np.linalg.norm(to_reference, axis=-1) * np.linalg.norm(to_other, axis=-1)
    middle = np.nanmedian(np.where(seen[useful], cosine, np.nan), axis=1)
    angle = np.degrees(np.arccos(np.clip(middle, -1, 1)))
    width = np.where(angle < _IDEAL_ANGLE, 3.0, 10.0)
    scores[useful] = seen[useful].mean(axis=1) * np.exp(-0.5 * ((angle - _IDEAL_ANGLE) / width) ** 2)
    return scores


def best_views(camera: Camera, others: Sequence[Camera], depth: float | Float32, count: int) -> list[int]:
    """Indices of the most useful other views, best first; those that see nothing of it are left out."""
    scores = view_scores(camera, others, depth)
    order = np.argsort(-scores, kind="stable")[:count]
    return [int(i) for i in order if scores[i] > 1e-3]


def typical_depth(cameras: Sequence[Camera]) -> float:
    """A first guess at how far the scene is, from the cameras alone, in world units.

    The median distance at which optical axes come closest to one another in front of both cameras (for captures that
    go round something), or else the extent of the camera path (for those that look outwards).
    """
    centers = np.array([c.center for c in cameras])
    axes = np.array([c.world_to_camera[2, :3] for c in cameras])
    offset = centers[None] - centers[:, None]
    cosine = axes @ axes.T
    along = np.einsum("ijk,ik->ij", offset, axes)
    along_other = np.einsum("ijk,jk->ij", offset, axes)
    determinant = 1 - cosine**2
    with np.errstate(divide="ignore", invalid="ignore"):
        near = (along - cosine * along_other) / determinant
        far = (cosine * along - along_other) / determinant
    crossing = near[(determinant > np.sin(np.radians(10)) ** 2) & (near > 0) & (far > 0)]
    if len(crossing) >= len(cameras):
        return float(np.median(crossing))
    return float(np.linalg.norm(centers.max(axis=0) - centers.min(axis=0))) or 1.0


def inverse_depth_planes(near: float, far: float, count: int) -> Float64:
    """[count] inverse depths from far to near, evenly spaced."""
    return np.linspace(1 / far, 1 / near, count)


def matching_cost(
    reference: SweepView, sources: Sequence[SweepView], inverse_depths: Float64, window: int, best: int
) -> Float32:
    """Cost of each depth at each pixel: (1 - ZNCC) / 2, averaged over the pixel's `best` source views.

    window: side of the square window in pixels, odd.
    Returns [H, W, D], 0 = the same up to brightness and contrast, 0.5 = unrelated or not seen, 1 = opposite.
    """
    import cv2

    def mean(image: Float32) -> Float32:
        return cv2.boxFilter(image, cv2.CV_32F, (window, window), borderType=cv2.BORDER_REFLECT)

    height, width = reference.gray.shape
    centered = reference.gray - np.float32(reference.gray.mean())
    reference_mean = mean(centered)
    reference_deviation = np.sqrt(mean(centered**2) - reference_mean**2 + np.float32(_NOISE_VARIANCE))
    prepared = [
        (s.gray - np.float32(s.gray.mean()), s.valid.astype(np.uint8), _transfer(reference.camera, s.camera))
        for s in sources
    ]
    cost = np.empty((height, width, len(inverse_depths)), np.float32)
    # Unseen windows must stay out of the best ones, so they start below any correlation.
    ranked = [np.empty((height, width), np.float32) for _ in range(min(best, len(sources)))]
    for d, inverse_depth in enumerate(inverse_depths):
        for layer in ranked:
            layer.fill(-2)
        for gray, valid, (at_infinity, parallax) in prepared:
            homography = at_infinity + inverse_depth * parallax
            flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
            warped = cv2.warpPerspective(gray, homography, (width, height), flags=flags)
            seen = cv2.warpPerspective(valid, homography, (width, height), flags=cv2.WARP_INVERSE_MAP)
            warped_mean = mean(warped)
            deviation = np.sqrt(mean(warped * warped) - warped_mean * warped_mean + np.float32(_NOISE_VARIANCE))
            score = (mean(centered * warped) - reference_mean * warped_mean) / (reference_deviation * deviation)
            inside = cv2.erode(seen, np.ones((window, window), np.uint8), borderType=cv2.BORDER_REFLECT)
            score[inside == 0] = -2
            _hide_behind(score, homography[2])
            for layer in ranked:
                higher = np.maximum(layer, score)
                np.minimum(layer, score, out=score)
                layer[...] = higher
        known = [layer > -1.5 for layer in ranked]
        total = sum(np.where(k, layer, np.float32(0)) for k, layer in zip(known, ranked, strict=True))
        count = np.maximum(sum(k.astype(np.float32) for k in known), 1)
        cost[:, :, d] = 0.5 - 0.5 * total / count
    np.clip(cost, 0, 1, out=cost)
    return cost


def _transfer(reference: Camera, source: Camera) -> tuple[Float64, Float64]:
    """A and B of the homographies H(w) = A + w B from reference to source pixels for the plane at inverse depth w. The
    sign that their third row gives tells what lies before the source camera."""
    at_infinity, shift = pixel_transfer(reference, source)
    return at_infinity, np.outer(shift, np.linalg.inv(_matrix(reference))[2])


def pixel_transfer(reference: Camera, source: Camera) -> tuple[Float64, Float64]:
    """[3, 3] A and [3] b: the pixel x of a point with inverse depth w lies at A x + w b in the source, in homogeneous
    coordinates, with integer pixel centres."""
    relative = source.world_to_camera @ np.linalg.inv(reference.world_to_camera)
    at_infinity = _matrix(source) @ relative[:3, :3] @ np.linalg.inv(_matrix(reference))
    return at_infinity, _matrix(source) @ relative[:3, 3]


def _matrix(camera: Camera) -> Float64:
    """Intrinsics with integer pixel centres, as OpenCV warps."""
    return np.array([[camera.fx, 0, camera.cx - 0.5], [0, camera.fy, camera.cy - 0.5], [0, 0, 1]])


def _hide_behind(score: Float32, row: Float64) -> None:
    height, width = score.shape
    corners = row @ np.array([[0, width, 0, width], [0, 0, height, height], [1, 1, 1, 1]], np.float64)
    if (corners <= 0).any():
        u, v = np.arange(width), np.arange(height)
        score[row[0] * u + (row[1] * v + row[2])[:, None] <= 0] = -2


def smooth_cost(cost: Float32, guide: Float32, small_step: float, large_step: float) -> Float32:
    """Semi-global smoothing: the sum over eight directions of the cheapest path to each pixel and depth.

    cost: [H, W, D]. guide: [H, W] gray levels; where it changes, jumps in depth are cheaper.
    small_step, large_step: price of moving by one plane, and by any number, between neighbouring pixels.
    Returns [H, W, D], the mean over the directions.
    """
    total = np.zeros_like(cost)
    for dv, du in ((0, 1), (0, -1), (1, 0), (-1, 0), (1, 1), (1, -1), (-1, 1), (-1, -1)):
        if dv == 0:
            _add_paths(cost.transpose(1, 0, 2), guide.T, total.transpose(1, 0, 2), du, 0, small_step, large_step)
        else:
            _add_paths(cost, guide, total, dv, du, small_step, large_step)
    return total / np.float32(8)


def _add_paths(
    cost: Float32, guide: Float32, total: Float32, step: int, shift: int, small_step: float, large_step: float
) -> None:
    """Add to `total` the path costs row by row in the direction `step`, from the pixel `shift` columns back."""
    rows = range(len(cost)) if step > 0 else range(len(cost) - 1, -1, -1)
    before: Float32 | None = None
    last_guide = guide[0]
    width, planes = cost.shape[1:]
    to, since = slice(max(shift, 0), width + min(shift, 0)), slice(max(-shift, 0), width - max(shift, 0))
    for y in rows:
        path = np.array(cost[y])
        if before is not None:
            previous = before[since]
            lowest = previous.min(axis=1, keepdims=True)
            edge = np.abs(guide[y][to] - last_guide[since])[:, None]
            jump = lowest + np.maximum(large_step / (1 + edge / 10), small_step).astype(np.float32)
            reach = np.minimum(previous, jump)
            near = previous + np.float32(small_step)
            np.minimum(reach[:, 1:], near[:, :-1], out=reach[:, 1:])
            np.minimum(reach[:, : planes - 1], near[:, 1:], out=reach[:, : planes - 1])
            path[to] += reach - lowest
        total[y] += path
        before, last_guide = path, guide[y]


def cheapest_depth(cost: Float32, inverse_depths: Float64) -> tuple[Float32, Float32]:
    """The depth of least cost at each pixel, refined between planes by a parabola through three costs.

    cost: [H, W, D]; inverse_depths: [D], evenly spaced.
    Returns depth [H, W], and [H, W] how much dearer the best depth elsewhere (more than two planes off) is, as a share.
    """
    planes = cost.shape[2]
    best = cost.argmin(axis=2)
    inner = np.clip(best, 1, planes - 2)

    def at(plane: np.ndarray) -> Float32:
        return np.take_along_axis(cost, plane[..., None], axis=2)[..., 0]

    left, middle, right = at(inner - 1), at(inner), at(inner + 1)
    bend = left - 2 * middle + right
    offset = np.where(bend > 1e-9, 0.5 * (left - right) / np.maximum(bend, 1e-9), 0)
    offset = np.where(best == inner, np.clip(offset, -0.5, 0.5), best - inner)
    step = (inverse_depths[-1] - inverse_depths[0]) / (planes - 1)
    depth = 1 / (inverse_depths[0] + (inner + offset) * step)
    elsewhere = np.full(best.shape, np.inf, np.float32)
    for d in range(planes):
        np.minimum(elsewhere, np.where(np.abs(best - d) > 2, cost[:, :, d], np.inf), out=elsewhere)
    whole: Float32 = np.maximum(elsewhere, np.float32(1e-6))
    return depth.astype(np.float32), (elsewhere - at(best)) / whole


def agreeing_depth(
    depth: Float32,
    camera: Camera,
    others: Sequence[tuple[Float32, Camera]],
    max_pixels: float,
    max_relative: float,
    min_views: int,
) -> Float32:
    """Keep a view's depth where other views' depth maps say the same, as the mean of what they say.

    A pixel goes into another view by its depth, and comes back by the depth found there; it must come back within
    `max_pixels` and `max_relative` of its depth, from at least `min_views` views.
    depth, others: [h, w] z-depth, 0 where unknown, with cameras of the maps' own sizes. Returns [h, w].
    """
    import cv2

    points = backproject(depth, camera)
    known = depth.ravel() > 0
    v, u = (np.mgrid[: camera.height, : camera.width] + 0.5).reshape(2, -1)
    count = np.zeros(depth.size, np.int32)
    total = depth.ravel().astype(np.float64)
    for other_depth, other in others:
        uv, z = project(points, other)
        uv = np.where((known & (z > 0))[:, None], uv, -10.0).astype(np.float32)
        with_gaps = np.where(other_depth > 0, other_depth, np.float32(np.nan))
        place = (uv - np.float32(0.5)).reshape(*depth.shape, 2)
        found = cv2.remap(with_gaps, place, None, cv2.INTER_LINEAR, borderValue=float("nan")).ravel()
        local = np.stack([(uv[:, 0] - other.cx) / other.fx, (uv[:, 1] - other.cy) / other.fy, np.ones(len(uv))], axis=1)
        world = (local * found[:, None] - other.world_to_camera[:3, 3]) @ other.world_to_camera[:3, :3]
        back, back_depth = project(world, camera)
        with np.errstate(invalid="ignore"):
            off = np.hypot(back[:, 0] - u, back[:, 1] - v)
            agrees = (off < max_pixels) & (np.abs(back_depth - depth.ravel()) < max_relative * depth.ravel())
        count += agrees
        total += np.where(agrees, back_depth, 0)
    return np.where(known & (count >= min_views), total / (1 + count), 0).reshape(depth.shape).astype(np.float32)
