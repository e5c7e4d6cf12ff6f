"""Whether the poses that came with a capture fit what its photos have in common, and whether refined ones fit better.

A few pairs of neighbours are enough to tell. Matched points of two photos lie on each other's epipolar lines under the
right poses, and depth that a sensor measured in one view is met in the other.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from ss_flow.running import warn
from ss_flow.task import task
from ss_flow.tasks.artifacts import Bool, Cameras, DepthMap, Float32, Float64, Int32
from ss_flow.tasks.capture.features import Features
from ss_flow.tasks.capture.lens import found_lens, undistorted
from ss_flow.tasks.capture.matches import MAX_ERROR, Matches
from ss_flow.tasks.geometry.cameras import Camera, backproject, camera_of, nearest_views, pixels_in_view
from ss_flow.tasks.ranges import Fraction, NonNegative

_FEW_PAIRS, _MOST_PAIRS = 4, 12
"""Of so many views, evenly chosen, each is compared with its nearest neighbour: of few at first, and of more where
these leave a doubt."""
_CLEAR = 0.5
"""Few pairs leave none below this share of the distance from which poses are refined."""
_LEAST_PAIRS, _LEAST_MATCHES = 3, 15
"""With fewer pairs, of fewer matches each, photos tell nothing about poses."""
_OCCLUDED = 0.25
"""Relative difference of depth beyond which something else stands in front."""
_NEAR = 3
"""Refined poses that leave more than so many times the distance from which poses are refined are wrong, too: it is half
of that distance where refining succeeds, and forty times where photos and poses are of two captures in one."""
_NOT_WORSE = 1.05
"""Depth that fits so much less well after refining is within the noise of the sample."""


@dataclass(frozen=True)
class PoseFitParams:
    """When the poses of a capture are refined without being asked for."""

    least_distance: NonNegative = 0.001
    """Matched points lie so far from their epipolar lines, as a share of the photo's longer side (median), before poses
    are refined; under exact poses and under COLMAP's it is a third of that."""
    gain: Fraction = 0.25
    """Share of this distance that refined poses must take away to be used."""

    def certain(self, fit: PoseFit) -> bool:
        """Whether poses fit beyond doubt, so that no more pairs need to be looked at."""
        return fit.distance <= _CLEAR * self.least_distance


@dataclass(frozen=True)
class PosePairs:
    """Views that are compared."""

    view: Int32
    """[V] ascending rows of the views that take part."""
    pair: Int32
    """[P, 2] places in `view`."""


@dataclass(frozen=True)
class PoseFit:
    """How well poses fit; nan where nothing tells."""

    distance: float
    """Of matched points from their epipolar lines (Sampson's), as a share of the photo's longer side: the median of the
    pairs' medians."""
    depth: float
    """The same of the relative difference between one view's depth, carried into the other, and the depth there."""


@task(name="capture.pose_pairs")
def pose_pairs(cameras: Cameras) -> tuple[PosePairs, ...]:
    """A few views, evenly chosen, each with the nearest one that looks the same way, within 45 degrees; and the same of
    more views, unless these are no other pairs."""
    few, more = _pairs(cameras, _FEW_PAIRS), _pairs(cameras, _MOST_PAIRS)
    return (few,) if np.array_equal(few.view, more.view) and np.array_equal(few.pair, more.pair) else (few, more)


def _pairs(cameras: Cameras, count: int) -> PosePairs:
    pairs = set()
    for view in np.linspace(0, len(cameras) - 1, min(count, len(cameras))).astype(int).tolist():
        for other in nearest_views(cameras, view, 1):
            pairs.add((min(view, other), max(view, other)))
    chosen = np.array(sorted(pairs), np.int32).reshape(-1, 2)
    views, places = np.unique(chosen, return_inverse=True)
    return PosePairs(views.astype(np.int32), places.reshape(-1, 2).astype(np.int32))


@task(name="capture.pose_fit")
def pose_fit(
    cameras: Cameras,
    pairs: PosePairs,
    photos: Sequence[Features],
    matches: Sequence[Matches],
    depths: Sequence[DepthMap],
) -> PoseFit:
    """How well poses fit their photos and depth, in the pairs.

    photos, depths: of the views of `pairs`; no depths where no sensor measured any. matches: one for each pair, of its
    first photo with its second.
    """
    distances, differences = [], []
    for (a, b), found in zip(pairs.pair.tolist(), matches, strict=True):
        views = int(pairs.view[a]), int(pairs.view[b])
        if len(found.pair) >= _LEAST_MATCHES:
            first, second = photos[a], photos[b]
            points = first.points[found.pair[:, 0]], second.points[found.pair[:, 1]]
            off = sampson_distance(_fundamental(cameras, *views), *points)
            distances.append(np.median(off) / max(first.width, first.height))
        if len(depths):
            differences.append(_depth_difference(cameras, views, (depths[a], depths[b])))
    known = [d for d in differences if np.isfinite(d)]
    return PoseFit(
        float(np.median(distances)) if len(distances) >= _LEAST_PAIRS else np.nan,
        float(np.median(known)) if len(known) >= _LEAST_PAIRS else np.nan,
    )


@task(name="capture.better_poses")
def better_poses(
    given: Cameras, refined: Cameras, before: PoseFit, after: PoseFit, *, params: PoseFitParams = PoseFitParams()
) -> Cameras:
    """The refined cameras where photos fit them, clearly better, and depth no worse, else the given ones.

    before, after: how the given and the refined poses fit. Says which it is, and why.
    """
    if np.array_equal(
        given.world_to_camera, refined.world_to_camera
    ):  # and why, was told where they were to be refined
        warn(
            "The poses that came with this capture may not be exact: matched points lie "
            f"{1000 * before.distance:.2f} thousandths of the photo's longer side off their epipolar lines (median)."
        )
        return given
    side = f"{1000 * after.distance:.2f} instead of {1000 * before.distance:.2f} thousandths of the photo's longer side"
    depth = f"; depth carried from view to view differs by {after.depth:.2%} instead of {before.depth:.2%}"
    figures = f"matched points lie {side} off their epipolar lines{depth if np.isfinite(after.depth) else ''} (medians)"
    better = after.distance <= (1 - params.gain) * before.distance and not after.depth > _NOT_WORSE * before.depth
    if after.distance > _NEAR * params.least_distance:
        warn(
            "The poses that came with this capture do not fit its photos, nor do refined ones, so the given ones are "
            f"kept: {figures}. Are they several captures, each with a world of its own (give them one by one), is the "
            "lens of another kind, such as a fisheye, or do poses belong to other photos?"
        )
        return given
    if better:
        warn(
            f"The poses that came with this capture were not exact, so refined ones are used: {figures}. "
            "capture.refine_poses=never keeps the given ones."
        )
        return refined
    warn(
        "The poses that came with this capture may not be exact, but refined ones fit no better, so the given ones are "
        f"kept: {figures}."
    )
    return given


def matches_that_fit(cameras: Cameras, photos: Sequence[Features], matches: Sequence[Matches]) -> tuple[int, int]:
    """How many matches between photos with cameras lie near each other's epipolar lines, and how many there are.

    photos: all that the matches name; their lenses may bend lines as `Cameras.radial` says.
    """
    fits = [fit for *_, fit in pairs_that_fit(cameras, photos, matches)]
    return sum(int(fit.sum()) for fit in fits), sum(map(len, fits))


def pairs_that_fit(
    cameras: Cameras, photos: Sequence[Features], matches: Sequence[Matches]
) -> Iterator[tuple[str, str, Int32, Bool]]:
    """Of each pair of photos with cameras: both names, the matches [m, 2] as `Matches.pair`, and which of them [m] lie
    near each other's epipolar lines; photos as for `matches_that_fit`."""
    rows = cameras.row_of()
    points = {}
    for photo in photos:
        if photo.name in rows:
            lens, seen = found_lens(cameras, rows[photo.name]), photo.points.astype(np.float64)
            points[photo.name] = seen if lens.pinhole else undistorted(seen, lens)
    for own in matches:
        for i, other in enumerate(own.others):
            if own.name not in points or other not in points:
                continue
            pair = own.pairs_with(i)
            fundamental = _fundamental(cameras, rows[own.name], rows[other])
            off = sampson_distance(fundamental, points[own.name][pair[:, 0]], points[other][pair[:, 1]])
            yield own.name, other, pair, off < MAX_ERROR


def sampson_distance(fundamental: Float64, first: np.ndarray, second: np.ndarray) -> Float64:
    """[N] how far, in pixels, matched points lie from their epipolar lines (Hartley and Zisserman, Eq. 11.9, its root).

    fundamental: [3, 3] F in x_second^T F x_first = 0. first, second: [N, 2] pixels.
    """
    a, b = (np.column_stack([points, np.ones(len(points))]).astype(np.float64) for points in (first, second))
    lines_b, lines_a = a @ fundamental.T, b @ fundamental
    slope = (lines_b[:, :2] ** 2).sum(axis=1) + (lines_a[:, :2] ** 2).sum(axis=1)
    return np.asarray(np.abs((b * lines_b).sum(axis=1)) / np.sqrt(np.maximum(slope, 1e-300)))


def _fundamental(cameras: Cameras, first: int, second: int) -> Float64:
    """[3, 3] of two views, from their poses and lenses (Hartley and Zisserman, Sec. 9.6.1)."""

    def lens(view: int) -> Float64:
        fx, fy, cx, cy = cameras.intrinsics[view]
        return np.linalg.inv(np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], np.float64))

    relative = cameras.world_to_camera[second] @ np.linalg.inv(cameras.world_to_camera[first])
    x, y, z = relative[:3, 3]
    across = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.asarray(lens(second).T @ across @ relative[:3, :3] @ lens(first))


def _depth_difference(cameras: Cameras, views: tuple[int, int], depths: tuple[DepthMap, DepthMap]) -> float:
    """The median relative difference between the first view's depth in the second and what was measured there."""
    (first, second) = (depth.depth for depth in depths)
    points = backproject(first, camera_of(cameras, views[0]).scaled(*first.shape[::-1]))[first.ravel() > 0]
    off = depth_differences(points, camera_of(cameras, views[1]).scaled(*second.shape[::-1]), second)
    return float(np.median(off)) if len(off) else np.nan


def depth_differences(points: Float64, camera: Camera, measured: Float32, factor: float = 1.0) -> Float64:
    """Relative differences between the depth of points [N, 3] in a view (their frame is that of its pose) and what was
    measured there, times a factor, where something was and nothing else stands in front."""
    _, column, row, z = pixels_in_view(points, camera)
    there = factor * measured[row, column]
    off = np.abs(z[there > 0] / there[there > 0] - 1)
    return off[off < _OCCLUDED]
