"""Which dense points each view really sees (Split&Splat, Eq. 1-2)."""

from __future__ import annotations

import numpy as np

from ss_flow.task import task
from ss_flow.tasks.artifacts import Cameras, DepthMap, PointCloud, Visibility
from ss_flow.tasks.geometry.cameras import camera_of, pixels_in_view
from ss_flow.tasks.geometry.fusion import depth_at


@task()
def visibility(
    points: PointCloud, cameras: Cameras, depth: DepthMap, *, view: int, tau_depth: float, tau_relative: float = 0.0
) -> Visibility:
    """The surface-consistent points of one view (Split&Splat, Eq. 1-2; spec S3).

    A point in front of the camera and inside its image counts when the view's depth at its pixel is known and differs
    from the point's own by less than max(tau_depth, tau_relative * depth). Where depth is unknown (0) no point counts
    (spec A39). Several points may share a pixel.

    view: which of the cameras; depth: that view's. tau_depth: in units of `points.unit`, 0.02 in the paper;
    tau_relative: fraction of the point's depth, for sensors whose error grows with distance.
    """
    camera = camera_of(cameras, view)
    rows, column, row, z = pixels_in_view(points.points, camera)
    measured = depth_at(depth, column, row, camera.width, camera.height)
    tolerance = np.maximum(tau_depth * points.unit, tau_relative * z)
    kept = (measured > 0) & (np.abs(measured - z) < tolerance)
    return Visibility(
        name=cameras.names[view],
        point_index=rows[kept],
        pixel=(row * camera.width + column)[kept].astype(np.int32),
        depth=z[kept].astype(np.float32),
        height=camera.height,
        width=camera.width,
    )
