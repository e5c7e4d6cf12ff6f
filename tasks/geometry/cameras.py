"""Pinhole projection, in the frames that `artifacts` declares."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ss_flow.tasks.artifacts import Cameras, Float32, Float64, Int32
from ss_flow.tasks.geometry.lying import quarter_turns


@dataclass(frozen=True)
class Camera:
    """One view's pinhole camera."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    world_to_camera: Float64
    """[4, 4] rigid."""
    photo_borders: tuple[float, float, float, float] | None = None
    """`borders` of the photo that this image is a part of; None where it is the whole photo."""

    @property
    def borders(self) -> tuple[float, float, float, float]:
        """Slopes of the rays through the borders of the whole photo, also where only a part of it is left: x / z of the
        left border, y / z of the upper, x / z of the right, y / z of the lower one."""
        if self.photo_borders is not None:
            return self.photo_borders
        return (
            -self.cx / self.fx,
            -self.cy / self.fy,
            (self.width - self.cx) / self.fx,
            (self.height - self.cy) / self.fy,
        )

    @property
    def center(self) -> Float64:
        """[3] the camera's place in the world."""
        rotation, translation = self.world_to_camera[:3, :3], self.world_to_camera[:3, 3]
        return -rotation.T @ translation

    def scaled(self, width: int, height: int) -> Camera:
        """The same camera with an image of another size (pixel borders map to pixel borders)."""
        sx, sy = width / self.width, height / self.height
        return replace(
            self, width=width, height=height, fx=self.fx * sx, fy=self.fy * sy, cx=self.cx * sx, cy=self.cy * sy
        )

    def fitted(self, width: int, height: int) -> Camera:
        """The same camera with an image of another shape, which nothing stretches: what it showed lies in the middle,
        as large as it fits, and beside it, or above and below, there is more to be seen."""
        scale = min(width / self.width, height / self.height)
        left, top = (width - scale * self.width) / 2, (height - scale * self.height) / 2
        return replace(
            self,
            width=width,
            height=height,
            fx=scale * self.fx,
            fy=scale * self.fy,
            cx=scale * self.cx + left,
            cy=scale * self.cy + top,
        )

    def cropped(self, x0: int, y0: int, x1: int, y1: int) -> Camera:
        """The same camera with only the pixels x0 <= u < x1, y0 <= v < y1; the principal point may fall outside."""
        return replace(
            self, width=x1 - x0, height=y1 - y0, cx=self.cx - x0, cy=self.cy - y0, photo_borders=self.borders
        )


def camera_of(cameras: Cameras, view: int) -> Camera:
    """The camera of one view."""
    width, height = (int(n) for n in cameras.sizes[view])
    fx, fy, cx, cy = (float(x) for x in cameras.intrinsics[view])
    return Camera(width, height, fx, fy, cx, cy, cameras.world_to_camera[view])


def cameras_by_view(cameras: Cameras) -> tuple[Camera, ...]:
    """The cameras of all views, one by one."""
    return tuple(camera_of(cameras, view) for view in range(len(cameras)))


def centers_of(poses: Float64) -> Float64:
    """[K, 3] where cameras stand in the world; poses: [K, 4, 4] world to camera."""
    return np.asarray(-np.einsum("kji,kj->ki", poses[:, :3, :3], poses[:, :3, 3]))


_AGREED = 0.1
"""Length of the mean of unit directions from which they agree; 1 = parallel."""


def up_of(poses: Float64 | Sequence[Float64]) -> Float64:
    """[3] the direction of length 1 that is up in most photos.

    poses: [K, 4, 4] world to camera, K > 0. Photos are taken upright, or lie on their side (`quarter_turns`). Where the
    pictures' upper borders point all ways, as in photos straight down on a table from all its sides, up is where they
    look away from; where they look all ways, too, the first one says what is up.
    """
    poses = np.asarray(poses)
    right, down, forward = poses[:, :3, :3].mean(axis=0)
    down = {0: down, 1: -right, 3: right}[quarter_turns(poses)]
    for away in (down, forward):
        length = float(np.linalg.norm(away))
        if length >= _AGREED:
            return np.asarray(-away / length)
    return np.asarray(-poses[0][1, :3])


def level_axes(up: Float64) -> tuple[Float64, Float64]:
    """Two directions [3] across `up` and each other, all of length 1: east, and north = up x east."""
    east = np.cross(up, np.eye(3)[np.abs(up).argmin()])
    east /= np.linalg.norm(east)
    return east, np.cross(up, east)


def looking(eye: Float64, forward: Float64, up: Float64) -> Float64:
    """[4, 4] world-to-camera of an upright camera.

    eye: [3] where it stands, world. forward: [3] where it looks, of length 1. up: [3] of any length; where it looks
    straight up or down, any camera will do.
    """
    right = np.cross(forward, up)
    if np.linalg.norm(right) < 1e-6:
        right = np.cross(forward, np.eye(3)[np.abs(forward).argmin()])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward])
    pose[:3, 3] = -pose[:3, :3] @ eye
    return pose


def camera_extent(cameras: Sequence[Camera]) -> float:
    """What 3DGS measures a scene with: 1.1 times the largest distance of a camera from the mean of all, world units.

    0 where all cameras stand at one place.
    """
    centers = np.array([camera.center for camera in cameras])
    return 1.1 * float(np.linalg.norm(centers - centers.mean(axis=0), axis=1).max())


def project(points: Float32 | Float64, camera: Camera) -> tuple[Float64, Float64]:
    """Project world points (Split&Splat, Pi_k).

    points: [N, 3] world. Returns uv: [N, 2] image points in pixels (meaningless where z <= 0), z: [N] depth.
    """
    # One row a coordinate: operations on short rows of two or three numbers take several times as long.
    local = camera.world_to_camera[:3, :3] @ points.T.astype(np.float64) + camera.world_to_camera[:3, 3:]
    uv, z = local[:2], local[2]
    with np.errstate(divide="ignore", invalid="ignore"):
        uv /= z
        uv *= [[camera.fx], [camera.fy]]
        uv += [[camera.cx], [camera.cy]]
    return uv.T, z


def pixels_in_view(points: Float32 | Float64, camera: Camera) -> tuple[Int32, Int32, Int32, Float64]:
    """The points in front of a camera and inside its image (Split&Splat, Eq. 1: P^_k).

    points: [N, 3] world. Returns, for the M points that remain: their rows (ascending), pixel columns, pixel rows,
    and z-depths.
    """
    uv, z = project(points, camera)
    u, v = uv.T
    with np.errstate(invalid="ignore"):
        inside = (z > 0) & (u >= 0) & (v >= 0) & (u < camera.width) & (v < camera.height)
    rows = np.flatnonzero(inside).astype(np.int32)
    # What is not negative is cut off to its floor.
    return rows, u[rows].astype(np.int32), v[rows].astype(np.int32), z[rows]


def backproject(depth: Float32, camera: Camera) -> Float64:
    """World points of a depth map's pixels: [H * W, 3], row-major, at pixel centres.

    depth: [H, W] z-depth in world units at the camera's own size (see `Camera.scaled`); unknown depth (0) gives the
    camera's centre.
    """
    row, column = np.mgrid[: camera.height, : camera.width]
    return surface_of_pixels(column.ravel(), row.ravel(), depth.ravel(), camera)


def surface_of_pixels(column: NDArray[np.integer], row: NDArray[np.integer], depth: Float32, camera: Camera) -> Float64:
    """World points of some pixels, at their centres: [M, 3]. column, row, depth: [M], z-depth in world units."""
    rays = np.stack([(column + 0.5 - camera.cx) / camera.fx, (row + 0.5 - camera.cy) / camera.fy, np.ones(len(depth))])
    local = (rays * depth).T - camera.world_to_camera[:3, 3]
    return np.asarray(local @ camera.world_to_camera[:3, :3])


def nearest_views(cameras: Cameras, view: int, count: int, within: float = 45) -> list[int]:
    """Rows of the nearest other cameras that look the same way as one does, within so many degrees; the nearest
    first."""
    poses = cameras.world_to_camera
    centers = centers_of(poses)
    distance = np.linalg.norm(centers - centers[view], axis=1)
    distance[poses[:, 2, :3] @ poses[view, 2, :3] < np.cos(np.radians(within))] = np.inf
    distance[view] = np.inf
    nearest = np.argsort(distance, kind="stable")[:count]
    return [int(other) for other in nearest if np.isfinite(distance[other])]
