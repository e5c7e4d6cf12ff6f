"""The length that plays the part of one metre."""

from __future__ import annotations

import numpy as np

from ss_flow.errors import InputError
from ss_flow.tasks.artifacts import Cameras, DepthMap


def scene_unit(cameras: Cameras, depths: tuple[DepthMap, ...]) -> float:
    """The length, in world units, that plays the part of one metre: 1.0 when the scale is known (spec 3.0).

    Otherwise half the median, over the views, of the median known depth. Raises InputError when no depth is known.
    """
    medians = [float(np.median(d.depth[d.depth > 0])) for d in depths if (d.depth > 0).any()]
    if not medians:
        raise InputError("None of the depth maps of this scene has a known depth; at least one view should.")
    return 1.0 if cameras.metric else float(np.median(medians)) / 2
