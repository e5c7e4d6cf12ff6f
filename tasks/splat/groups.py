"""Sets of Gaussians as the Splat steps handle them."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ss_flow.tasks.artifacts import Cameras, DepthMap, Float32, Frame, Gaussians
from ss_flow.tasks.geometry.shape import box_diagonal
from ss_flow.tasks.splat.views import SceneViews
from ss_flow.tasks.split.dense import scene_unit

NO_GAUSSIANS = Gaussians(
    means=np.zeros((0, 3), np.float32),
    quaternions=np.zeros((0, 4), np.float32),
    log_scales=np.zeros((0, 3), np.float32),
    opacity_logits=np.zeros(0, np.float32),
    sh=np.zeros((0, 1, 3), np.float32),
    instance_id=np.zeros(0, np.int32),
    instance_conf=np.zeros(0, np.float32),
    part_id=np.zeros(0, np.int32),
)


def rasterizer() -> Mapping[str, str]:
    """What the results of training depend on besides the inputs: the instruction set or device of the rasterizer."""
    from ss_flow.tasks.gaussians.rasterize import backend_identity

    return backend_identity()


def scene_views(
    frames: tuple[Frame, ...],
    cameras: Cameras,
    depths: tuple[DepthMap, ...],
    tau_depth: float,
    tau_relative: float,
) -> SceneViews:
    """The views of a scene, with the depth tolerance in world units (tau_depth is in scene units, spec 3.0)."""
    return SceneViews(frames, cameras, depths, tau_depth * scene_unit(cameras, depths), tau_relative)


def extents(gaussians: Gaussians) -> Float32:
    """[N] the size of the instance that each Gaussian is part of, world units: the diagonal of its box."""
    sizes = np.zeros(len(gaussians), np.float32)
    for instance_id in np.unique(gaussians.instance_id):
        own = gaussians.instance_id == instance_id
        sizes[own] = box_diagonal(gaussians.means[own])
    # An instance of a single Gaussian is as large as that.
    return np.maximum(sizes, np.exp(gaussians.log_scales.max(axis=1)))
