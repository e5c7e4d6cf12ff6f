"""The cameras of a film: along the input views, round the scene, round an instance."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ss_flow.task import FileRef, task
from ss_flow.tasks.artifacts import Cameras, Float64, Gaussians
from ss_flow.tasks.capture.layout_nerfstudio import read_cameras
from ss_flow.tasks.deliver.point_view import orbit_camera
from ss_flow.tasks.geometry.cameras import Camera, cameras_by_view, looking, pixels_in_view, up_of

_TOWARDS_SURFACE = 0.1
"""How much the places that the cameras look at count for the middle of an orbit, against the meeting of their axes."""

_ONE_SIDED_DEG = 120.0
"""Views leave a side out where they leave a gap larger than this between their directions."""
_LEAST_SWING_DEG = 30.0
"""A narrower swing, as where all views stand side by side, would show no depth."""

_WIDER = 0.8
"""Shortens the lens of an orbit round an instance, so that no end of it is cut off."""


@task(name="deliver.camera_paths.along")
def along(cameras: Cameras, *, frames: int) -> tuple[Camera, ...]:
    """Cameras on a smooth way through the input views in their order, which begins at the first and ends at the last.

    Places lie on a cubic spline, rotations on one whose angular velocity is smooth; the lens is that of the nearest
    view, fitted into the first one's size where its photo has another. frames: how many; 0 = the input views
    themselves.
    """
    views = cameras_by_view(cameras)
    if not frames or len(views) < 2:
        return views
    from scipy.interpolate import CubicSpline
    from scipy.spatial.transform import Rotation, RotationSpline

    first = views[0]
    at, times = np.arange(len(views)), np.linspace(0, len(views) - 1, frames)
    centers = CubicSpline(at, np.array([view.center for view in views]))(times)
    turns = RotationSpline(at, Rotation.from_matrix(cameras.world_to_camera[:, :3, :3]))(times).as_matrix()
    found = []
    for time, center, turn in zip(times, centers, turns, strict=True):
        lens = views[round(time)].fitted(first.width, first.height)
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = turn, -turn @ center
        found.append(replace(lens, world_to_camera=pose))
    return tuple(found)


@task(name="deliver.camera_paths.round_instance")
def round_instance(own: Gaussians, cameras: Cameras, *, frames: int, elevation_deg: float) -> tuple[Camera, ...]:
    """Cameras on a circle round some Gaussians, a little above or below them, that show all of them.

    own: those of the instances, one at least. cameras: the input views; they tell which way is up.
    """
    found = []
    for turn in np.arange(frames) / frames * 360.0:
        near = orbit_camera(own.means, cameras, azimuth_deg=float(turn), elevation_deg=elevation_deg)
        found.append(replace(near, fx=_WIDER * near.fx, fy=_WIDER * near.fy))
    return tuple(found)


@task(name="deliver.camera_paths.round_scene")
def round_scene(scene: Gaussians, cameras: Cameras, *, frames: int) -> tuple[Camera, ...]:
    """Cameras on a level circle at the input views' mean height and distance, that look at what these look at.

    A capture from inside a room keeps inside; the lens is the first view's. Where the input views leave a side out, the
    cameras swing over the arc that they cover, and back.
    """
    views = cameras_by_view(cameras)
    up = up_of(cameras.world_to_camera)
    target = _looked_at(scene, views)
    offsets = np.array([view.center for view in views]) - target
    height = float((offsets @ up).mean())
    level = offsets - np.outer(offsets @ up, up)
    radius = float(np.linalg.norm(level, axis=1).mean())
    start = level[0] if np.linalg.norm(level[0]) > 1e-6 else np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
    east = start / np.linalg.norm(start)
    north = np.cross(up, east)
    found = []
    for angle in _azimuths(np.arctan2(level @ north, level @ east), frames):
        center = target + height * up + radius * (np.cos(angle) * east + np.sin(angle) * north)
        forward = (target - center) / max(float(np.linalg.norm(target - center)), 1e-9)
        found.append(replace(views[0], world_to_camera=looking(center, forward, up)))
    return tuple(found)


def _azimuths(taken: Float64, frames: int) -> Float64:
    """[frames] angles of one round, or of a swing over the covered arc. taken: those of the input views; in radians."""
    turn = 2 * np.pi * np.arange(frames) / frames
    ordered = np.sort(taken)
    gaps = np.diff(ordered, append=ordered[0] + 2 * np.pi)
    widest = int(gaps.argmax())
    if gaps[widest] <= np.radians(_ONE_SIDED_DEG):
        return turn
    covered = 2 * np.pi - gaps[widest]
    half = max(covered, np.radians(_LEAST_SWING_DEG)) / 2
    return ordered[widest] + gaps[widest] + covered / 2 - half * np.cos(turn)


def _looked_at(scene: Gaussians, views: tuple[Camera, ...]) -> Float64:
    """[3] the point nearest to all optical axes, drawn a little towards the surfaces in the views' middles.

    The latter decides where axes are parallel, and so meet nowhere.
    """
    matrix, vector = np.zeros((3, 3)), np.zeros(3)
    for view in views:
        axis = view.world_to_camera[2, :3]
        depths = pixels_in_view(scene.means, view)[3]
        depth = float(np.median(depths)) if len(depths) else 1.0
        across = np.eye(3) - np.outer(axis, axis)
        matrix += across + _TOWARDS_SURFACE * np.eye(3)
        vector += across @ view.center + _TOWARDS_SURFACE * (view.center + depth * axis)
    return np.asarray(np.linalg.solve(matrix, vector), np.float64)


@task(name="deliver.camera_paths.given")
def given(*, file: FileRef) -> tuple[Camera, ...]:
    """The cameras of a `transforms.json`, without their distortion. Raises InputError as `read_cameras` does."""
    return read_cameras(file.path)
