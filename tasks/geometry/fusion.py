"""Fusing the depth maps of several views into one cloud."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from ss_flow.running import in_threads
from ss_flow.tasks.artifacts import Bool, Cameras, DepthMap, Float32, Float64, Int32, Int64
from ss_flow.tasks.geometry.cameras import camera_of, pixels_in_view
from ss_flow.tasks.geometry.images import pixels_under
from ss_flow.tasks.geometry.zbuffer import nearest_per_pixel

_MEDIAN_OF_NORMAL = 0.6745
"""Median of the absolute value of a normal variable of standard deviation 1."""
_SAMPLE = 20_000
"""So many points tell how noisy the depth is."""
_ELSEWHERE = 0.05
"""Share of the depth from which on a view sees another surface than the point's."""
_AT_ONCE = 1 << 22
"""So many sums are held at once, or twice as many as there are voxels; each takes 64 bytes, thrice while added."""
_CELLS = 1 << 21
"""Voxels a side that fit the 63-bit code of a voxel; farther points wrap around, which needs 40 km at 2 cm."""


@dataclass(frozen=True)
class VoxelSums:
    """Coloured points, summed by voxel; sums of sums are exact up to rounding, so views can be added one by one."""

    position: Float64
    """[N, 3] weighted sum."""
    color: Float64
    """[N, 3] weighted sum, RGB 0..255."""
    weight: Float64
    """[N] how many samples."""
    side: Float64
    """[N] weighted sum of the sides that their cubes are to have at least, world units; 0 = any."""

    def means(self) -> tuple[Float64, Float64]:
        """Mean position and colour of each voxel: [N, 3], [N, 3]."""
        return self.position / self.weight[:, None], self.color / self.weight[:, None]

    def sides(self, voxel: float) -> Float64:
        """[N] the sides of their cubes: `voxel`, twice that, four times and so on."""
        return np.asarray(voxel * 2 ** np.floor(np.log2(np.maximum(self.side / (self.weight * voxel), 1))))

    def take(self, keep: Bool) -> VoxelSums:
        """The voxels where `keep` [N] holds."""
        return VoxelSums(self.position[keep], self.color[keep], self.weight[keep], self.side[keep])


def sum_by_voxel(parts: Iterable[VoxelSums], voxel: float) -> VoxelSums:
    """Add up the points whose means lie in the same cube of side `voxel`; the order is that of the cubes in space.

    Where points are to have cubes of twice the side at least, of four times and so on, such cubes follow the others.
    The origin is the centre of a cube, not a corner: a floor at height zero must not fall apart into two layers.
    Of an iterator, hundreds of views are never held at once: what has come is added up in between.
    """
    held: list[VoxelSums] = []
    most = _AT_ONCE
    for part in parts:
        held.append(part)
        if len(held) > 1 and sum(len(one.weight) for one in held) > most:
            held = [_added_up(held, voxel)]
            most = max(_AT_ONCE, 2 * len(held[0].weight))
    return _added_up(held, voxel)


def finest(sums: VoxelSums, voxel: float) -> VoxelSums:
    """The points but those in whose cubes others lie that are in smaller ones: what a view shows from far away says
    nothing where another was near. sums: as `sum_by_voxel` gives them."""
    sides = sums.sides(voxel)
    places, _ = sums.means()
    kept = np.ones(len(sides), bool)
    for side in np.unique(sides)[1:].tolist():
        own, finer = np.flatnonzero(sides == side), np.flatnonzero(sides < side)
        code = _codes(places[np.concatenate([own, finer])], side)
        kept[own] = ~np.isin(code[: len(own)], code[len(own) :])
    return sums.take(kept)


def _added_up(parts: list[VoxelSums], voxel: float) -> VoxelSums:
    sums = _all_of(parts)
    sides = sums.sides(voxel)
    found = np.unique(sides)
    if len(found) < 2:
        return _in_cubes(sums, float(found.max(initial=voxel)))
    return _all_of([_in_cubes(sums.take(sides == side), side) for side in found.tolist()])


def _all_of(parts: list[VoxelSums]) -> VoxelSums:
    return VoxelSums(*(np.concatenate([getattr(part, one.name) for part in parts]) for one in fields(VoxelSums)))


def _codes(places: Float64, side: float) -> Int64:
    """[N] a number for the cube in which each of some places [N, 3] lies."""
    cell = np.floor(places / side + 0.5).astype(np.int64) & (_CELLS - 1)
    return np.asarray((cell[:, 0] * _CELLS + cell[:, 1]) * _CELLS + cell[:, 2])


def _in_cubes(sums: VoxelSums, side: float) -> VoxelSums:
    position, weight = sums.position, sums.weight
    code = _codes(position / weight[:, None], side)
    # Neighbours in a photo, and sums that came from earlier ones, stand nearly in order already, which makes a stable
    # sort three to seven times as fast as the one that np.unique takes.
    order = np.argsort(code, kind="stable")
    ascending = code[order]
    voxel_of = np.empty(len(code), np.int64)
    voxel_of[order] = np.cumsum(np.diff(ascending, prepend=ascending[:1]) != 0)

    def added(values: Float64) -> Float64:
        return np.bincount(voxel_of, values).astype(np.float64, copy=False)

    return VoxelSums(
        np.stack([added(position[:, i]) for i in range(3)], axis=-1),
        np.stack([added(sums.color[:, i]) for i in range(3)], axis=-1),
        added(weight),
        added(sums.side),
    )


def depth_at(
    depth: DepthMap, column: NDArray[np.integer], row: NDArray[np.integer], width: int, height: int
) -> Float32:
    """Depth at pixels of a frame of the given size, nearest neighbour: [M], 0 where unknown."""
    h, w = depth.depth.shape
    if (h, w) == (height, width):
        return depth.depth[row, column]
    return depth.depth[pixels_under(height, h)[row], pixels_under(width, w)[column]]


def consistent_points(
    points: Float64, cameras: Cameras, depths: tuple[DepthMap, ...], *, tau: float, tau_relative: float, min_views: int
) -> Bool:
    """[N] which points are confirmed by the depth of at least `min_views` views, or of all that see so far.

    points: [N, 3] world. A view sees as far as a point when its depth there is not in front of the point; it confirms
    the point when the two differ by less than max(tau, tau_relative * depth). Flying pixels at depth edges, which
    other views look through, fail.
    """

    def told(view: int) -> tuple[Int32, Int32]:
        camera = camera_of(cameras, view)
        rows, column, row, z = pixels_in_view(points, camera)
        measured = depth_at(depths[view], column, row, camera.width, camera.height)
        tolerance = np.maximum(tau, tau_relative * z)
        known = measured > 0
        return rows[known & (measured > z - tolerance)], rows[known & (np.abs(measured - z) < tolerance)]

    seen = np.zeros(len(points), np.int32)
    confirmed = np.zeros(len(points), np.int32)
    for sees, confirms in in_threads(told, range(len(depths))):
        seen[sees] += 1
        confirmed[confirms] += 1
    return confirmed >= np.clip(seen, 1, min_views)


def depth_noise(points: Float64, cameras: Cameras, depths: tuple[DepthMap, ...]) -> float:
    """Standard deviation of the views' depth from the points [N, 3] that they see, as a share of the depth, by its
    median; 0.0 where no view sees any. It is that of a sensor, of poses and of calibration together."""
    some = points[:: max(1, len(points) // _SAMPLE)]
    differences = []
    for view, depth in enumerate(depths):
        camera = camera_of(cameras, view)
        _, column, row, z = pixels_in_view(some, camera)
        measured = depth_at(depth, column, row, camera.width, camera.height)
        difference = np.abs(measured - z) / z
        differences.append(difference[(measured > 0) & (difference < _ELSEWHERE)])
    found = np.concatenate(differences)
    return float(np.median(found) / _MEDIAN_OF_NORMAL) if len(found) else 0.0


def with_sparse_points(cameras: Cameras, depths: tuple[DepthMap, ...]) -> tuple[DepthMap, ...]:
    """The depth maps, with the sparse points that fall on pixels of unknown depth."""
    maps = []
    for view, known in enumerate(depths):
        height, width = known.depth.shape
        camera = camera_of(cameras, view).scaled(width, height)
        _, column, row, z = pixels_in_view(cameras.sparse_points, camera)
        front = nearest_per_pixel(row * width + column, z, height * width)
        sparse = np.append(z, 0.0)[front].reshape(height, width)  # -1, no point there, takes the 0
        maps.append(replace(known, depth=np.where(known.depth > 0, known.depth, sparse).astype(np.float32)))
    return tuple(maps)
