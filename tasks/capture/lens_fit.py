"""Another lens than the one that came with a capture, where the given poses are right and the lens is not.

Poses that are wrong, each in its own way, leave matched points off their epipolar lines under any lens. A wrong lens
puts all photos wrong in the same way, so one factor on the focal lengths and one distortion take away what is off: the
search ends near the noise of the matches, or it ends far from it and proves nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ss_flow.tasks.artifacts import Cameras, Float64
from ss_flow.tasks.capture.epipolar import fundamental_matrix, sampson_distance
from ss_flow.tasks.capture.lens import found_lens, undistorted

DOUBTFUL_GAIN = 0.1
"""The share of what is off that another lens takes away where the given one may be wrong; of a right one that is a
hundredth."""
LEAST_PAIRS = 3
"""Of fewer pairs of photos that tell something nothing is said."""
_SCALE = 0.001
"""Points farther from their epipolar lines, as a share of the photo's longer side, count ever less, as wrong matches
(the scale of Cauchy's loss)."""
_FAR = 1.0
"""The same of a point that a lens cannot have seen."""
_AS_GOOD = 1.1
"""So much worse, at most, is nearly as well."""
_LEAST, _MOST = np.array([0.3, -1.0]), np.array([3.0, 1.0])
"""Between which the factor on the focal lengths and the radial coefficient are looked for."""
_UNCHANGED = np.array([1.0, 0.0])
_STEP = 1e-3
"""By which both are changed to see what it does; a smaller step sees the rounding of `undistorted`."""


@dataclass(frozen=True)
class CommonPoints:
    """Points that two views have in common."""

    views: tuple[int, int]
    points: tuple[Float64, Float64]
    """[N, 2] of each, pixels."""


@dataclass(frozen=True)
class OtherLens:
    """The lens under which the common points of photos fit their poses best."""

    focal: float
    """A factor on the given focal lengths."""
    radial: float
    """The first radial distortion coefficient of the photos."""
    distance: float
    """`epipolar_distance` under it."""
    gain: float
    """The share of the search's loss under the given lens that it takes away."""


def epipolar_distance(cameras: Cameras, common: Sequence[CommonPoints]) -> float:
    """How far common points lie from their epipolar lines, as a share of the photo's longer side: the median of the
    pairs' medians; nan of too few pairs."""
    medians = [np.median(_off_lines(cameras, one)) for one in common]
    return float(np.median(medians)) if len(medians) >= LEAST_PAIRS else np.nan


def _off_lines(cameras: Cameras, common: CommonPoints) -> Float64:
    """[N] how far common points lie from their epipolar lines, as a share of the photo's longer side; _FAR where they
    lie nowhere."""
    distance = sampson_distance(fundamental_matrix(cameras, *common.views), *common.points)
    return np.nan_to_num(distance / cameras.sizes[common.views[0]].max(), nan=_FAR)


def other_lens(cameras: Cameras, common: Sequence[CommonPoints]) -> OtherLens:
    """The lens under which common points lie nearest to their epipolar lines; where it is clearly better than the given
    one, one of its numbers stays as given if that fits nearly as well."""
    both = _search(cameras, common, np.array([True, True]))
    if both.gain < DOUBTFUL_GAIN:
        return both
    found = [_search(cameras, common, np.array(free)) for free in ([True, False], [False, True])] + [both]
    least = min(lens.distance for lens in found)
    return next(lens for lens in found if lens.distance <= _AS_GOOD * least)


def _search(cameras: Cameras, common: Sequence[CommonPoints], free: NDArray[np.bool_]) -> OtherLens:
    """free: [2] whether the focal lengths and the radial coefficient may change."""
    from scipy.optimize import least_squares

    def lens(numbers: Float64) -> tuple[float, float]:
        changed = _UNCHANGED.copy()
        changed[free] += numbers - 1  # of about 1, as the search's steps are a share of its numbers
        return float(changed[0]), float(changed[1])

    def off(numbers: Float64) -> Float64:
        seen = _through(cameras, common, *lens(numbers))
        return np.concatenate([_off_lines(seen[0], one) for one in seen[1]]) / _SCALE

    start = np.ones(free.sum())
    bounds = [1 + (end - _UNCHANGED)[free] for end in (_LEAST, _MOST)]
    found = least_squares(off, start, bounds=bounds, loss="cauchy", diff_step=_STEP)
    focal, radial = lens(found.x)
    distance = epipolar_distance(*_through(cameras, common, focal, radial))
    before = 0.5 * np.log1p(off(start) ** 2).sum()  # as `cost` is defined
    return OtherLens(focal, radial, distance, gain=float(1 - found.cost / max(before, 1e-12)))


def _through(
    cameras: Cameras, common: Sequence[CommonPoints], focal: float, radial: float
) -> tuple[Cameras, Sequence[CommonPoints]]:
    """The cameras with another lens, and the common points where a pinhole would have seen them."""
    cameras = with_focal(cameras, focal)
    if not radial:
        return cameras, common
    bent = replace(cameras, radial=np.full(len(cameras), radial))

    def straight(common: CommonPoints) -> CommonPoints:
        (a, b), (first, second) = common.views, common.points
        return replace(
            common, points=(undistorted(first, found_lens(bent, a)), undistorted(second, found_lens(bent, b)))
        )

    return cameras, [straight(one) for one in common]


def with_focal(cameras: Cameras, factor: float) -> Cameras:
    """Cameras with focal lengths so many times as long."""
    return replace(cameras, intrinsics=cameras.intrinsics * (factor, factor, 1, 1))
