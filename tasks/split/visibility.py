"""Which dense points each view really sees (Split&Splat, Eq. 1-2)."""

from __future__ import annotations

import numpy as np

from ss_flow.task import task
from ss_flow.tasks.artifacts import DepthMap, PointCloud, Visibility
from ss_flow.tasks.geometry.cameras import Camera
from ss_flow.tasks.geometry.visibility import VisibilityParams, surface_points


@task()
def visibility(points: PointCloud, camera: Camera, depth: DepthMap, *, params: VisibilityParams) -> Visibility:
    """The surface-consistent points of one view (Split&Splat, P_k), by `surface_points`.

    camera, depth: of this view.
    """
    rows, column, row, z = surface_points(points.points, camera, depth, params, points.unit, points.noise)
    return Visibility(
        name=depth.name,
        point_index=rows,
        pixel=(row * camera.width + column).astype(np.int32),
        depth=z.astype(np.float32),
        height=camera.height,
        width=camera.width,
    )
