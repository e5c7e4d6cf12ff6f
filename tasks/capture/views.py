"""What a capture comes to: views with one camera each, and a unit of length."""

from __future__ import annotations

import numpy as np

from ss_flow.errors import InputError
from ss_flow.task import task
from ss_flow.tasks.artifacts import Cameras, DepthMap, SceneUnit
from ss_flow.tasks.geometry.cameras import Camera, cameras_by_view
from ss_flow.tasks.geometry.fusion import with_sparse_points


@task(name="capture.by_view")
def by_view(cameras: Cameras) -> tuple[Camera, ...]:
    """The cameras one by one, so that a step for some views does not depend on the others."""
    return cameras_by_view(cameras)


@task(name="capture.unit")
def unit(cameras: Cameras, depths: tuple[DepthMap, ...]) -> SceneUnit:
    """The length that plays the part of one metre: 1.0 where the scale is known (spec 3.0).

    Otherwise half the median, over the views, of the median known depth; where none is known, of the depth of the
    sparse points. Raises InputError when there are none either, or when views were compared without any result.
    """
    if all(depth.source == "mvs" and not depth.depth.any() for depth in depths):
        raise InputError(
            f"no depth is found in any of the {len(depths)} views by comparing them; photos that overlap by two thirds "
            "from different places are needed, or depth from a sensor."
        )
    if not any(depth.depth.any() for depth in depths):
        depths = with_sparse_points(cameras, depths)
    medians = [float(np.median(d.depth[d.depth > 0])) for d in depths if (d.depth > 0).any()]
    if not medians:
        raise InputError("None of the depth maps of this scene has a known depth; at least one view should.")
    return SceneUnit(1.0 if cameras.metric else float(np.median(medians)) / 2)
