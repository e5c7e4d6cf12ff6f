"""Whether a depth sensor measures in the unit of the poses: by which factor its depth fits them best.

Sensors are off by some per cent, and poses that come from elsewhere have a scale of their own. A view's depth, carried
to another one, is met there only when both have one scale, since the step between the cameras keeps its length.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ss_flow.running import warn
from ss_flow.task import task
from ss_flow.tasks.artifacts import Cameras, DepthMap, Float32, Float64
from ss_flow.tasks.capture.pose_fit import depth_differences
from ss_flow.tasks.geometry.cameras import Camera, backproject, camera_of, nearest_views

_FACTORS = np.exp(0.0025 * np.arange(-40, 41))
_VIEWS, _NEIGHBOURS = 24, 2
"""So many views, evenly chosen, are compared with so many neighbours each."""
_MOST_PIXELS, _LEAST_PIXELS = 4000, 200
"""So many pixels of a view are carried, evenly chosen, and so many must be met in the other."""
_LEAST_PAIRS = 3
_GAIN = 0.08
"""Share of the difference that a factor must take away to count. Where depth and poses have one scale, at most .06
goes, and .02 if poses and lenses are right; where depth is off by 2 %, .12 and more."""


@dataclass(frozen=True)
class DepthScale:
    """The factor on depth, and how far neighbours' depth differs (median, relative) without and with it."""

    factor: float
    before: float
    after: float

    @property
    def counts(self) -> bool:
        """Whether depth fits clearly better with the factor."""
        return self.after < (1 - _GAIN) * self.before


@task(name="capture.depth_scale")
def depth_scale(cameras: Cameras, depths: Sequence[DepthMap]) -> DepthScale:
    """The factor on all depth maps by which neighbours' depth differs least, within a tenth; 1 where nothing tells, or
    where it lies farther off: that is another unit, and no error. Says so where it counts.
    """
    errors = []
    for view in np.unique(np.linspace(0, len(cameras) - 1, min(_VIEWS, len(cameras))).astype(int)).tolist():
        for other in nearest_views(cameras, view, _NEIGHBOURS):
            off = _differences(*_seen(cameras, depths, view), *_seen(cameras, depths, other))
            if np.isfinite(off).all():
                errors.append(off)
    if len(errors) < _LEAST_PAIRS:
        return DepthScale(1.0, np.nan, np.nan)
    curve = np.median(errors, axis=0)
    best = int(curve.argmin())
    if best in (0, len(curve) - 1):
        return DepthScale(1.0, np.nan, np.nan)
    result = DepthScale(float(_FACTORS[best]), float(curve[len(curve) // 2]), float(curve[best]))
    if result.counts:
        warn(
            f"The depth was multiplied by {result.factor:.3f}, so that it fits the poses: depth carried from view to "
            f"view differs by {result.after:.2%} instead of {result.before:.2%} (medians). "
            "capture.calibrate=none keeps it as it is."
        )
    return result


@task(name="capture.rescaled")
def rescaled(depth: DepthMap, *, factor: float) -> DepthMap:
    """A depth map times a factor."""
    return replace(depth, depth=depth.depth * np.float32(factor))


def _seen(cameras: Cameras, depths: Sequence[DepthMap], row: int) -> tuple[Camera, Float32]:
    """A view's camera at the size of its depth, and that."""
    depth = depths[row].depth
    return camera_of(cameras, row).scaled(*depth.shape[::-1]), depth


def _differences(first: Camera, depth: Float32, second: Camera, measured: Float32) -> Float64:
    """[S] the median relative difference of the first view's depth, carried to the second, and what was measured there,
    for each factor on both; NaN where they share too little."""
    known = np.flatnonzero(depth > 0)
    known = known[:: -(-len(known) // _MOST_PIXELS) or 1]
    local = backproject(depth, replace(first, world_to_camera=np.eye(4)))[known]
    ahead = replace(second, world_to_camera=second.world_to_camera @ np.linalg.inv(first.world_to_camera))
    result = np.full(len(_FACTORS), np.nan)
    for row, factor in enumerate(_FACTORS):
        off = depth_differences(local * factor, ahead, measured, factor)
        if len(off) >= _LEAST_PIXELS:
            result[row] = np.median(off)
    return result
