"""What a capture comes to: views with one camera each, and a unit of length."""

from __future__ import annotations

import numpy as np

from ss_flow.errors import InputError
from ss_flow.task import task
from ss_flow.tasks.artifacts import Cameras, DepthMap, SceneUnit
from ss_flow.tasks.gaussians.native_pass import NEAR_PLANE
from ss_flow.tasks.geometry.cameras import Camera, cameras_by_view
from ss_flow.tasks.geometry.fusion import with_sparse_points

_LEAST_DEPTHS = 2
"""How many times as far as the near plane views must look."""


@task(name="capture.by_view")
def by_view(cameras: Cameras) -> tuple[Camera, ...]:
    """The cameras one by one, so that a step for some views does not depend on the others."""
    return cameras_by_view(cameras)


@task(name="capture.unit")
def unit(cameras: Cameras, depths: tuple[DepthMap, ...]) -> SceneUnit:
    """The length that plays the part of one metre: 1.0 where the scale is known (spec 3.0).

    Otherwise half the median, over the views, of the median known depth; where none is known, of the depth of the
    sparse points. Raises InputError when there are none either, when views were compared without any result, or when
    that depth is so small that what is near would be cut off.
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
    typical = float(np.median(medians))
    if typical < _LEAST_DEPTHS * NEAR_PLANE:
        larger = 10 ** -np.floor(np.log10(typical))
        raise InputError(
            f"what the views show is {typical:.2g} units away from them (median), and renderers leave out what is "
            f"nearer than {NEAR_PLANE:g}; multiply the places of the poses, and the depth, by {larger:g}."
        )
    return SceneUnit(1.0 if cameras.metric else typical / 2)
