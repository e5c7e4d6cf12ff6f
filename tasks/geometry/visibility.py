"""Which points of a surface a view sees (Split&Splat, Eq. 1-2)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ss_flow.tasks.artifacts import DepthMap, Float32, Float64, Int32
from ss_flow.tasks.geometry.cameras import Camera, pixels_in_view
from ss_flow.tasks.geometry.fusion import depth_at
from ss_flow.tasks.ranges import NonNegative, Positive
from ss_flow.tasks.unread import by_default


@dataclass(frozen=True)
class VisibilityParams:
    """Which dense points a view sees."""

    tau_depth: Positive = 0.02
    """How far a point may lie from the view's depth, in scene units (metres where the scale is known)."""
    share_of_depth: NonNegative = 0.25
    """Share of the depth that counts as the scene unit where it is more than one, since sensors and comparisons of
    photos err by a share of what they measure; 0 in `paper`."""
    deviations: NonNegative = 100.0
    """Standard deviations of the depth that count as the scene unit where they are more than it: at a tau_depth of 0.02
    a point may lie two of them away; 0 in `paper`. Read by Split only."""

    def of_splat(self) -> VisibilityParams:
        """For the steps of Splat: what only Split reads is as by default, so that it does not enter the key."""
        return by_default(self, "deviations")

    def tolerance(self, depth: Float32 | Float64, unit: float, noise: float = 0.0) -> Float32 | Float64:
        """How far two depths of one surface may differ, world units; unit: length of a scene unit in these; noise:
        standard deviation of the depth, as a share of it."""
        share = max(self.share_of_depth, self.deviations * noise)
        return np.maximum(self.tau_depth * unit, self.tau_depth * share * depth)


def surface_points(
    points: Float32, camera: Camera, depth: DepthMap, params: VisibilityParams, unit: float, noise: float = 0.0
) -> tuple[Int32, Int32, Int32, Float64]:
    """The points that a view sees: rows of `points`, pixel columns, pixel rows, and z-depths (Eq. 1-2; spec S3).

    A point in front of the camera and inside its image (Eq. 1) counts when the view's depth at its pixel is known and
    differs from the point's own by less than the tolerance (Eq. 2). Where depth is unknown (0) no point counts (spec
    A39). Several points may share a pixel.

    points: [N, 3] world. depth: the view's. unit: length of a scene unit, world units. noise: standard deviation of
    the depth, as a share of it.
    """
    rows, column, row, z = pixels_in_view(points, camera)
    measured = depth_at(depth, column, row, camera.width, camera.height)
    seen = (measured > 0) & (np.abs(measured - z) < params.tolerance(z, unit, noise))
    return rows[seen], column[seen], row[seen], z[seen]
