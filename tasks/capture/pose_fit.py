"""Whether the poses that came with a capture fit what its photos have in common, and whether refined ones fit better.

A few pairs of neighbours are enough to tell. Matched points of two photos lie on each other's epipolar lines under the
right poses, and depth that a sensor measured in one view is met in the other.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from ss_flow.running import warn
from ss_flow.task import task
from ss_flow.tasks.artifacts import Bool, Cameras, DepthMap, Float32, Float64, Int32
from ss_flow.tasks.capture.epipolar import fundamental_matrix, sampson_distance
from ss_flow.tasks.capture.features import Features
from ss_flow.tasks.capture.lens import found_lens, undistorted
from ss_flow.tasks.capture.lens_fit import (
    DOUBTFUL_GAIN,
    LEAST_PAIRS,
    CommonPoints,
    epipolar_distance,
    other_lens,
    with_focal,
)
from ss_flow.tasks.capture.matches import MAX_ERROR, Matches
from ss_flow.tasks.geometry.cameras import Camera, backproject, camera_of, nearest_views, pixels_in_view
from ss_flow.tasks.ranges import Fraction, NonNegative

_FEW_PAIRS, _MOST_PAIRS = 4, 12
"""Of so many views, evenly chosen, each is compared with its nearest neighbour: of few at first, and of more where
these leave a doubt."""
_CLEAR = 0.5
"""Few pairs leave none below this share of the distance from which poses are refined."""
_LEAST_MATCHES = 15
"""A pair of fewer matches tells nothing about poses."""
_OCCLUDED = 0.25
"""Relative difference of depth beyond which something else stands in front."""
_NEAR = 3
"""Refined poses that leave more than so many times the distance from which poses are refined are wrong, too: it is half
of that distance where refining succeeds, and forty times where photos and poses are of two captures in one."""
_NOT_WORSE = 1.05
"""Depth that fits so much less well after refining is within the noise of the sample."""


FreeLens = Literal["focal", "all"]
"""What of a stated lens may be wrong: focal lengths; or also that lines are straight, where it says no more."""


@dataclass(frozen=True)
class PoseFitParams:
    """When the poses of a capture are refined without being asked for."""

    least_distance: NonNegative = 0.001
    """Matched points lie so far from their epipolar lines, as a share of the photo's longer side (median), before poses
    are refined; under exact poses and under COLMAP's it is a third of that."""
    gain: Fraction = 0.25
    """Share of this distance that refined poses, or another lens, must take away to be used."""

    def certain(self, fit: PoseFit) -> bool:
        """Whether poses and lens fit beyond doubt, so that no more pairs need to be looked at."""
        return fit.distance <= _CLEAR * self.least_distance and fit.lens_gain < DOUBTFUL_GAIN


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
    """The same of the relative difference between one view's depth, carried into the other, and the depth there; under
    the given lens."""
    focal: float = 1.0
    """A factor on the focal lengths of the capture, ..."""
    radial: float = 0.0
    """... and the first radial distortion coefficient of its photos, with which `distance` is so; ..."""
    as_given: float = np.nan
    """... and the distance without them; nan where no other lens is needed."""
    lens_gain: float = 0.0
    """The share of what is off under the given lens that the best one takes away (`OtherLens.gain`)."""

    @property
    def other_lens(self) -> bool:
        """Whether another lens than the given one fits."""
        return bool(np.isfinite(self.as_given))


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
    *,
    lens: FreeLens | None = None,
    params: PoseFitParams = PoseFitParams(),
) -> PoseFit:
    """How well poses fit their photos and depth, in the pairs; where photos fit beyond doubt, and clearly better, under
    another lens than the given one, how they fit under that.

    Depth has no say in the lens: from view to near view it differs less by a wrong one than by a sensor's noise.
    photos, depths: of the views of `pairs`; no depths where no sensor measured any. matches: one for each pair, of its
    first photo with its second. lens: what of the lens may be wrong, if anything.
    """
    common = list(_common_points(pairs, photos, matches))
    given = PoseFit(epipolar_distance(cameras, common), _depth_difference(cameras, pairs, depths))
    if lens is None or not np.isfinite(given.distance):
        return given
    best = other_lens(cameras, common)
    given = replace(given, lens_gain=best.gain)
    most = min(_CLEAR * params.least_distance, (1 - params.gain) * given.distance)
    if best.gain < DOUBTFUL_GAIN or best.distance > most or (best.radial and lens == "focal"):
        return given
    return replace(given, distance=best.distance, focal=best.focal, radial=best.radial, as_given=given.distance)


def _common_points(pairs: PosePairs, photos: Sequence[Features], matches: Sequence[Matches]) -> Iterator[CommonPoints]:
    """Those of the pairs that have enough of them. Arguments as of `pose_fit`."""
    for (a, b), found in zip(pairs.pair.tolist(), matches, strict=True):
        if len(found.pair) >= _LEAST_MATCHES:
            first, second = photos[a].points[found.pair[:, 0]], photos[b].points[found.pair[:, 1]]
            views = int(pairs.view[a]), int(pairs.view[b])
            yield CommonPoints(views, (first.astype(np.float64), second.astype(np.float64)))


def _depth_difference(cameras: Cameras, pairs: PosePairs, depths: Sequence[DepthMap]) -> float:
    """The median of the pairs' medians of the relative difference between the first view's depth, carried into the
    second, and what was measured there; nan of too few pairs that tell it."""
    known = []
    for a, b in pairs.pair.tolist() if len(depths) else ():
        first, second = depths[a].depth, depths[b].depth
        sized = camera_of(cameras, int(pairs.view[a])).scaled(*first.shape[::-1])
        other = camera_of(cameras, int(pairs.view[b])).scaled(*second.shape[::-1])
        off = depth_differences(backproject(first, sized)[first.ravel() > 0], other, second)
        if len(off):
            known.append(np.median(off))
    return float(np.median(known)) if len(known) >= LEAST_PAIRS else np.nan


@task(name="capture.with_lens")
def with_lens(cameras: Cameras, fit: PoseFit) -> Cameras:
    """The cameras with the lens that fits; says so. `registered` then takes out its distortion."""
    straight = f" and photos straightened by a first radial coefficient of {fit.radial:.3g}" if fit.radial else ""
    warn(
        "The lens that came with this capture does not fit its photos, so another is used: with focal lengths "
        f"{fit.focal:.3f} times as long{straight}, matched points lie {1000 * fit.distance:.2f} instead of "
        f"{1000 * fit.as_given:.2f} thousandths of the photo's longer side off their epipolar lines (medians). "
        "capture.refine_poses=never keeps the given one."
    )
    changed = with_focal(cameras, fit.focal)
    return replace(changed, radial=np.full(len(cameras), fit.radial)) if fit.radial else changed


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
            fundamental = fundamental_matrix(cameras, rows[own.name], rows[other])
            off = sampson_distance(fundamental, points[own.name][pair[:, 0]], points[other][pair[:, 1]])
            yield own.name, other, pair, off < MAX_ERROR


def depth_differences(points: Float64, camera: Camera, measured: Float32, factor: float = 1.0) -> Float64:
    """Relative differences between the depth of points [N, 3] in a view (their frame is that of its pose) and what was
    measured there, times a factor, where something was and nothing else stands in front."""
    _, column, row, z = pixels_in_view(points, camera)
    there = factor * measured[row, column]
    off = np.abs(z[there > 0] / there[there > 0] - 1)
    return off[off < _OCCLUDED]
