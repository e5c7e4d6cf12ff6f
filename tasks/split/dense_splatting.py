"""Dense points of the scene as the paper makes them: centres of a short, depth-regularised splatting of all of it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ss_flow.errors import InputError
from ss_flow.task import Resources, task
from ss_flow.tasks.artifacts import Cameras, ColourTransform, DepthMap, Frame, Gaussians, PointCloud, SceneUnit
from ss_flow.tasks.gaussians.initialise import SH_ZERO, initialise
from ss_flow.tasks.gaussians.learning_rates import SLOW_RATES
from ss_flow.tasks.gaussians.objective import Objective
from ss_flow.tasks.gaussians.rasterize import backend_identity
from ss_flow.tasks.gaussians.render import render
from ss_flow.tasks.gaussians.trainer import TrainParams, train
from ss_flow.tasks.gaussians.views import SceneViews, TrainView, whole_view
from ss_flow.tasks.geometry.cameras import cameras_by_view
from ss_flow.tasks.geometry.fusion import VoxelSums, sum_by_voxel, with_sparse_points
from ss_flow.tasks.geometry.shape import box_diagonal
from ss_flow.tasks.geometry.visibility import VisibilityParams
from ss_flow.tasks.ranges import Count, Fraction
from ss_flow.tasks.split.dense import DenseParams, consistent_cloud, depth_samples, voxel_side

_WIDTH = 0.25
"""Of the first Gaussians, in distances to their neighbours. Wider ones reach out in front of a surface that is seen at
an angle, and the depth loss, which knows their centres only, pushes them behind it."""


@dataclass(frozen=True)
class DenseSplattingParams:
    """The splatting of the whole scene of which only the centres are kept."""

    iterations_per_view: Count = 40
    """Training steps for each view of the scene, within the two limits below."""
    min_iterations: Count = 600
    """Fewest steps."""
    max_iterations: Count = 3000
    """Most steps."""
    initial_points: Count = 50_000
    """Most points that training starts from; more are thinned out."""
    max_gaussians: Count = 200_000
    """Most Gaussians."""
    objective: Objective = Objective(depth_weight_start=0.1)
    """What the training makes small."""
    min_opacity: Fraction = 0.5
    """Fainter Gaussians give no point."""
    max_side: Count = 640
    """Longest side of the photos that are trained on, pixels; larger ones are scaled down."""

    def iterations(self, num_views: int) -> int:
        """Training steps for a scene of so many views (spec A38)."""
        return int(np.clip(self.iterations_per_view * num_views, self.min_iterations, self.max_iterations))


@task(
    resources=Resources(cores=1, most_cores=8, memory_mb=4000, gpus=0.5),
    environment=backend_identity,
)
def dense_splatting(
    frames: tuple[Frame, ...],
    cameras: Cameras,
    depths: tuple[DepthMap, ...],
    unit: SceneUnit,
    colours: tuple[ColourTransform, ...] = (),
    *,
    params: DenseParams,
    splatting: DenseSplattingParams,
) -> PointCloud:
    """Dense points P_dense, as centres of Gaussians (Split&Splat, Sec. 3.1.2; spec A38, row 25).

    Gaussians at the known depth pixels and the sparse points are trained on the whole photos, with the depth loss where
    a view's depth is known. The centres of opaque ones that two views confirm, by their depth or, where that is
    unknown, by the depth that the Gaussians show, are sampled, limited and ordered like the points of `dense`.

    Raises InputError when a scene has neither depth nor sparse points to start from, or no centre is confirmed.
    """
    seeds = with_sparse_points(cameras, depths)
    known = depths if any(depth.depth.any() for depth in depths) else seeds
    voxel = voxel_side(cameras, known, unit, params)
    samples = (
        sum_by_voxel([depth_samples(frame, cameras, view, seed, colours, params.voxel_pixels)], voxel)
        for view, (frame, seed) in enumerate(zip(frames, seeds, strict=True))
    )
    initial = _first_gaussians(sum_by_voxel(samples, voxel), voxel, splatting.initial_points)
    seen = SceneViews(frames, cameras_by_view(cameras), depths, unit, colours, VisibilityParams())
    everything = [np.zeros((frame.height, frame.width), np.int32) for frame in frames]
    views = [whole_view(seen, view, all_of_it, splatting.max_side) for view, all_of_it in enumerate(everything)]
    trained = train(
        initial,
        [view for view in views if view.inside.any()],
        params=TrainParams(
            iterations=splatting.iterations(len(views)),
            sh_degree=0,
            objective=splatting.objective,
            max_gaussians=splatting.max_gaussians,
            rates=SLOW_RATES,
        ),
        extent=max(box_diagonal(initial.means), voxel),
        seed=0,
    ).gaussians
    cloud = consistent_cloud(
        sum_by_voxel([_centres(trained, splatting.min_opacity, voxel)], voxel),
        cameras,
        tuple(_completed(depth, view, trained) for depth, view in zip(depths, views, strict=True)),
        voxel=voxel,
        unit=unit,
        params=params,
    )
    if not len(cloud.points):
        raise InputError(
            "No two views of this scene confirm a point of its splatting; more steps (split.splatting.min_iterations) "
            "or points from depth (split.dense_source=depth) may help."
        )
    return cloud


def _first_gaussians(samples: VoxelSums, voxel: float, limit: int) -> Gaussians:
    """Gaussians at no more than `limit` of the points, in larger voxels where there are more."""
    while len(samples.weight) > limit:
        voxel *= 1.05 * float(np.sqrt(len(samples.weight) / limit))
        samples = sum_by_voxel([samples], voxel)
    points, colors = samples.means()
    if not len(points):
        raise InputError("All known depth and sparse points of this scene lie in pixels that its frames mask out.")
    first = initialise(points.astype(np.float32), np.rint(colors).astype(np.uint8), 0, 1.0)
    return replace(first, log_scales=first.log_scales + np.float32(np.log(_WIDTH)))


def _centres(gaussians: Gaussians, min_opacity: float, side: float) -> VoxelSums:
    """The centres of the opaque Gaussians, with their colours, in cubes of a side."""
    opaque = gaussians.opacities >= min_opacity
    colors = np.clip(255 * (0.5 + SH_ZERO * gaussians.sh[opaque, 0].astype(np.float64)), 0, 255)
    ones = np.ones(len(colors))
    return VoxelSums(gaussians.means[opaque].astype(np.float64), colors, ones, side * ones)


def _completed(depth: DepthMap, view: TrainView, gaussians: Gaussians) -> DepthMap:
    """The depth of a view, at the size of its training, as the Gaussians show it where it is unknown."""
    shown = render(gaussians, view.camera)
    covered = view.inside & (shown.alpha >= 0.5)
    rendered = np.where(covered, shown.depth / np.maximum(shown.alpha, 0.5), 0)
    return replace(depth, depth=np.where(view.depth > 0, view.depth, rendered).astype(np.float32))
