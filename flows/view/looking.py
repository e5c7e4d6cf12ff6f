"""Where to look from: what photos saw is what Gaussians show well."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ss_flow.tasks.artifacts import Cameras, Float32, Float64
from ss_flow.tasks.gaussians.native_pass import NEAR_PLANE
from ss_flow.tasks.geometry.cameras import camera_extent, camera_of, cameras_by_view, pixels_in_view, up_of

if TYPE_CHECKING:
    from viser import ClientHandle, ViserServer

_MOST_POINTS = 20_000
"""So many tell where things are."""
_OF_PICTURE = 0.7
"""The share of the picture's height that an object is to take."""


@dataclass(frozen=True)
class Viewpoint:
    """Where to look from: as viser's cameras, in world units."""

    position: Float64
    look_at: Float64
    up: Float64
    fov: float
    """Vertical, in radians."""


def start_view(cameras: Cameras, points: Float32) -> Viewpoint:
    """The view of the capture that shows most of the scene.

    points: [N, 3] centres of the scene.
    """
    some = _some(points)
    shown = [pixels_in_view(some, camera)[3] for camera in cameras_by_view(cameras)]
    view = max(range(len(shown)), key=lambda k: len(shown[k]))
    camera = camera_of(cameras, view)
    # Where nothing is seen, how far apart the cameras stand tells the scene's size.
    ahead = float(np.median(shown[view])) if len(shown[view]) else camera_extent(cameras_by_view(cameras)) or 1.0
    forward = camera.world_to_camera[2, :3]
    fov = 2 * np.arctan(camera.height / 2 / camera.fy)
    return Viewpoint(camera.center, camera.center + ahead * forward, up_of(cameras.world_to_camera), float(fov))


def view_of_object(cameras: Cameras, points: Float32, fov: float) -> tuple[Float64, Float64]:
    """[3] from where, [3] to where: from the side of the view of the capture that has most of an object, as near as
    shows it whole, and no farther; a tiny one from where it is still drawn. World units.

    points: [N, 3] its centres, N > 0. fov: vertical, of who looks, in radians.
    """
    some = _some(points)
    center = np.median(some, axis=0).astype(np.float64)
    # The solid angle of the points in the picture goes with the inverse square of their depth.
    angle = [float((1 / pixels_in_view(some, camera)[3] ** 2).sum()) for camera in cameras_by_view(cameras)]
    away = camera_of(cameras, int(np.argmax(angle))).center - center
    radius = float(np.quantile(np.linalg.norm(some - center, axis=1), 0.95))
    near = max(radius / np.sin(_OF_PICTURE * fov / 2), radius + NEAR_PLANE)
    return center + away * min(1.0, near / np.linalg.norm(away)), center


def look_from(server: ViserServer, first: Viewpoint) -> None:
    """Let browsers that come look from there."""
    camera = server.initial_camera
    server.scene.set_up_direction(first.up)
    camera.position, camera.look_at, camera.up, camera.fov = first.position, first.look_at, first.up, first.fov


def move_to(client: ClientHandle, position: Float64, look_at: Float64) -> None:
    """Let one browser look from there, with its own up and field of view."""
    with client.atomic():
        client.camera.position = position  # takes what it looks at along
        client.camera.look_at = look_at


def _some(points: Float32) -> Float32:
    return points[:: max(1, len(points) // _MOST_POINTS)]
