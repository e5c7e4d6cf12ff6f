"""Dense points of the scene from its depth maps."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np

from ss_flow.errors import InputError
from ss_flow.running import in_threads, progress
from ss_flow.task import Resources, task
from ss_flow.tasks.artifacts import Cameras, ColourTransform, DepthMap, Float32, Float64, Frame, PointCloud, SceneUnit
from ss_flow.tasks.geometry.cameras import backproject, camera_of
from ss_flow.tasks.geometry.fusion import VoxelSums, consistent_points, depth_noise, finest, sum_by_voxel
from ss_flow.tasks.geometry.images import decode_valid, resampled, scene_rgb
from ss_flow.tasks.ranges import Count, NonNegative, Positive, Range

SIDES_PER_OCTAVE = 8
"""Sides that a sampling cube may have between a length and its double. Were the side any number, one photo more would
move all points, those of objects that it does not show too."""
_COARSEST = 4.0
"""Sides of a cube that a step between two float32 numbers at the points may have. A generated room, moved away, keeps
its masks at steps of 3 (IoU .99) and loses them at 5.7 (.73); at 11 things fell on one place, and Split failed."""
_JUMP = 0.05
"""Share of the depth by which neighbouring pixels of one surface may differ."""


@dataclass(frozen=True)
class DenseParams:
    """How densely the scene's surfaces are sampled."""

    voxel: Positive = 0.02
    """Upper limit of the side of the smallest sampling cubes, in scene units (metres where the scale is known); others
    are twice, four times and so on as large."""
    voxel_pixels: Positive = 2.0
    """How many pixels a cube has a side, where the nearest view sees it, or more; and the smallest ones, of median
    pixels, where that is less than `voxel`."""
    max_points: Annotated[int, Range(100, float("inf"))] = 400_000
    """Cubes take more pixels until no more points than this remain."""
    tolerance: Positive = 0.02
    """How far two views' depths may differ at one point, in scene units."""
    relative_tolerance: NonNegative = 0.01
    """The same as a fraction of the depth; the larger of the two counts."""
    min_views: Count = 2
    """How many views must confirm a point, where as many see it."""


@task(resources=Resources(cores=1, most_cores=8))
def dense(
    frames: tuple[Frame, ...],
    cameras: Cameras,
    depths: tuple[DepthMap, ...],
    unit: SceneUnit,
    colours: tuple[ColourTransform, ...] = (),
    *,
    params: DenseParams,
) -> PointCloud:
    """Dense points P_dense, by back-projection of all depth maps (spec S2, row 11).

    Known depth pixels that their frame does not mask out become world points; the points of one voxel are averaged;
    those that other views contradict are dropped (see `consistent_points`). The points are ordered by voxel, and have
    the colours of the scene where photos differ (`colours`).

    Raises InputError when no two views agree, or the scene lies too far from the world's origin for float32.
    """
    voxel = voxel_side(cameras, depths, unit, params)

    def views() -> Iterator[int]:
        for view, frame in enumerate(frames):
            progress(view, len(frames), frame.name)
            yield view

    def sums(view: int) -> VoxelSums:
        return sum_by_voxel(
            [depth_samples(frames[view], cameras, view, depths[view], colours, params.voxel_pixels)], voxel
        )

    summed = sum_by_voxel(in_threads(sums, views()), voxel)
    cloud = consistent_cloud(summed, cameras, depths, voxel=voxel, unit=unit, params=params)
    if not len(cloud.points):
        raise InputError(
            "The depth maps of this scene agree in no point; they should be z-depths in the unit of the camera poses."
        )
    return cloud


def consistent_cloud(
    cloud: VoxelSums,
    cameras: Cameras,
    depths: tuple[DepthMap, ...],
    *,
    voxel: float,
    unit: SceneUnit,
    params: DenseParams,
) -> PointCloud:
    """The voxels whose means the views' depth confirms, in cubes large enough that no more than `max_points` remain.

    cloud: samples summed in cubes of side `voxel`. Returns no points where nothing is confirmed.
    Raises InputError when the scene is so far from the origin that float32 cannot tell its points apart.
    """
    while True:
        means, _ = cloud.means()
        kept = consistent_points(
            means,
            cameras,
            depths,
            tau=params.tolerance * unit.length,
            tau_relative=params.relative_tolerance,
            min_views=params.min_views,
        )
        cloud = finest(cloud.take(kept), voxel)
        if len(cloud.weight) <= params.max_points:
            break
        # On surfaces the count falls with the square of the side; far and near ones grow alike.
        grown = _one_of_few(np.sqrt(len(cloud.weight) / params.max_points), np.ceil)
        if (cloud.sides(voxel) == voxel).all():  # else points that are to have no larger cubes would never get fewer
            voxel *= grown
        cloud = sum_by_voxel([replace(cloud, side=cloud.side * grown)], voxel)
    means, colors = cloud.means()
    spacing = cloud.sides(voxel)
    _refuse_coarse(means, spacing)
    return PointCloud(
        means.astype(np.float32),
        np.rint(colors).astype(np.uint8),
        unit.length,
        spacing=spacing.astype(np.float32),
        noise=depth_noise(means, cameras, depths),
    )


def _refuse_coarse(places: Float64, sides: Float64) -> None:
    """Raise InputError where float32 rounds points [N, 3] by many sides [N] of their cubes; both in world units."""
    if not len(places):
        return
    away, side = float(np.median(np.abs(places).max(axis=1))), float(np.median(sides))
    step = float(np.spacing(np.float32(away)))
    if step > _COARSEST * side:
        raise InputError(
            f"The scene lies {away:,.0f} world units from the origin along an axis, where 32-bit floats have steps of "
            f"{step:.2g}, too coarse for points {side:.2g} apart: subtract one offset from all poses, as the mean of "
            "the cameras' places, and from given points."
        )


def voxel_side(cameras: Cameras, depths: tuple[DepthMap, ...], unit: SceneUnit, params: DenseParams) -> float:
    """Side of the sampling cube, in world units."""
    footprint = params.voxel_pixels * _pixel_footprint(cameras, depths)
    return min(params.voxel * unit.length, _one_of_few(footprint, np.rint))


def _one_of_few(side: float, to_integer: np.ufunc) -> float:
    """One of `SIDES_PER_OCTAVE` sides."""
    return float(2 ** (to_integer(SIDES_PER_OCTAVE * np.log2(side)) / SIDES_PER_OCTAVE))


def _pixel_footprint(cameras: Cameras, depths: tuple[DepthMap, ...]) -> float:
    """Median side, in world units, of the surface patch that a depth pixel covers when it is looked at head-on;
    infinite where no depth is known."""
    sides = []
    for view, depth in enumerate(depths):
        known = depth.depth[depth.depth > 0]
        if known.size:
            height, width = depth.depth.shape
            sides.append(float(np.median(known)) / camera_of(cameras, view).scaled(width, height).fx)
    return float(np.median(sides)) if sides else np.inf


def depth_samples(
    frame: Frame, cameras: Cameras, view: int, depth: DepthMap, colours: tuple[ColourTransform, ...], pixels: float
) -> VoxelSums:
    """The known depth pixels of one view as points with the colours of its photo, or those of the scene there, in cubes
    of `pixels` a side at least.

    In cubes of less than one each pixel of each view would be a point of its own, and far walls would leave hardly any
    of `max_points` to what is near.
    """
    height, width = depth.depth.shape
    known = ((depth.depth > 0) & resampled(decode_valid(frame), height, width)).ravel()
    camera = camera_of(cameras, view).scaled(width, height)
    points = backproject(depth.depth, camera)
    sides = _footprints(points.reshape(height, width, 3), depth.depth, camera.fx).ravel()[known]
    points = points[known]
    photo = scene_rgb(frame, *colours[view : view + 1])  # as it is where there are none
    colors = resampled(photo, height, width).reshape(-1, 3)[known].astype(np.float64)
    return VoxelSums(points, colors, np.ones(len(points)), pixels * sides)


def _footprints(points: Float64, depth: Float32, focal: float) -> Float64:
    """[H, W] how far apart the places lie that neighbouring pixels show, world units: farther on what is looked at from
    the side. As if it were looked at head-on where both neighbours are on other surfaces, or unknown.

    points, depth: [H, W, 3] and [H, W], of the pixels, 0 = unknown; focal: focal length, px.
    """
    sides = depth.astype(np.float64) / focal
    for axis in (0, 1):
        ahead, back = [(slice(None),) * axis + (some,) for some in (slice(1, None), slice(None, -1))]
        apart = np.linalg.norm(points[ahead] - points[back], axis=2)
        nearer = np.minimum(depth[ahead], depth[back])
        apart[~(np.abs(depth[ahead] - depth[back]) < _JUMP * nearer)] = np.inf
        nearest = np.full(depth.shape, np.inf)
        for some in (ahead, back):
            nearest[some] = np.minimum(nearest[some], apart)
        sides = np.where(np.isfinite(nearest), np.maximum(sides, nearest), sides)
    return sides
