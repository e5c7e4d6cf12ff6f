"""Points as a picture, and a camera that shows a whole object."""

from __future__ import annotations

import numpy as np

from ss_flow.tasks.artifacts import Cameras, Float32, Float64, UInt8
from ss_flow.tasks.gaussians.native_pass import NEAR_PLANE
from ss_flow.tasks.geometry.cameras import Camera, level_axes, looking, pixels_in_view, up_of
from ss_flow.tasks.geometry.zbuffer import nearest_per_pixel

_WIDTH, _HEIGHT = 960, 720
"""Size of an orbit's pictures, pixels."""
_SKY = (244, 245, 247)
_WIDEST = 4
"""Largest half-width of a point's square, pixels: more would hide what lies behind a near point."""

_ONE_SIDE = 0.5
"""Length of the mean of the photos' level viewing directions from which they are taken from one side; 1 = parallel."""


def orbit_camera(
    points: Float32,
    cameras: Cameras | None = None,
    *,
    azimuth_deg: float = 40.0,
    elevation_deg: float = 32.0,
) -> Camera:
    """A camera outside the points, a little above, that sees nearly all of them.

    points: [N, 3] world, N > 0. cameras: tell which way is up (photos are taken upright); without them it is the
    direction in which the points spread least, away from their denser end. Where all photos are taken from about one
    side, that side is azimuth 0: what they do not show is not worth looking at.
    """
    low, high = np.percentile(points, (2, 98), axis=0)
    center, radius = (low + high) / 2, max(float(np.linalg.norm(high - low)) / 2, 1e-6)
    up = _up(points - center, cameras)
    east = _side(up, cameras)
    azimuth, elevation = np.radians([azimuth_deg, elevation_deg])
    around = np.cos(azimuth) * east + np.sin(azimuth) * np.cross(up, east)
    outward = np.cos(elevation) * around + np.sin(elevation) * up
    half_fov = np.radians(22.0)
    away = outward * radius / np.sin(half_fov) * 0.9
    farther = max(1.0, (radius + NEAR_PLANE) / float(np.linalg.norm(away)))  # what is nearer would not be drawn
    eye = center + away * farther
    focal = _HEIGHT / 2 / np.tan(half_fov) * farther
    return Camera(_WIDTH, _HEIGHT, focal, focal, _WIDTH / 2, _HEIGHT / 2, looking(eye, -outward, up))


def _side(up: Float64, cameras: Cameras | None) -> Float64:
    """[3] the level direction of azimuth 0, unit."""
    if cameras is not None and len(cameras):
        towards = -cameras.world_to_camera[:, 2, :3].mean(axis=0)
        towards -= up * (up @ towards)
        if (agreed := float(np.linalg.norm(towards))) > _ONE_SIDE:
            return towards / agreed
    return level_axes(up)[0]


def _up(centred: Float64, cameras: Cameras | None) -> Float64:
    if cameras is not None and len(cameras):
        return up_of(cameras.world_to_camera)
    axis = np.linalg.eigh(centred.T @ centred)[1][:, 0]
    along = centred @ axis
    low, high = np.percentile(along, (2, 98))
    tenth = (high - low) / 10
    return axis if (along < low + tenth).sum() >= (along > high - tenth).sum() else -axis


def draw_points(points: Float32, colors: UInt8, camera: Camera, spacing: float) -> UInt8:
    """Points as squares of about their spacing, nearest in front, shaded at depth edges: [H, W, 3].

    points: [N, 3] world; colors: [N, 3] RGB; spacing: world units. The shading darkens a pixel by how far its
    neighbours stand in front of it (Boucheny, "Visualisation scientifique de grands volumes de données", eye-dome
    lighting).
    """
    rows, column, row, depth = pixels_in_view(points, camera)
    reach = np.clip(np.rint(0.5 * spacing * camera.fx / depth), 0, _WIDEST).astype(np.int32)
    pixels, members = [], []
    for dy in range(-_WIDEST, _WIDEST + 1):
        for dx in range(-_WIDEST, _WIDEST + 1):
            x, y = column + dx, row + dy
            hit = (reach >= max(abs(dx), abs(dy))) & (x >= 0) & (y >= 0) & (x < camera.width) & (y < camera.height)
            members.append(np.flatnonzero(hit))
            pixels.append((y * camera.width + x)[hit])
    pixel, member = np.concatenate(pixels), np.concatenate(members)
    front = nearest_per_pixel(pixel, depth[member], camera.width * camera.height)
    seen = front >= 0
    image = np.tile(np.array(_SKY, np.float64), (len(front), 1))
    image[seen] = colors[rows[member[front[seen]]]]
    log_depth = np.full(len(front), np.inf)
    log_depth[seen] = np.log(depth[member[front[seen]]])
    shade = _eye_dome(log_depth.reshape(camera.height, camera.width))
    return (image.reshape(camera.height, camera.width, 3) * shade[..., None]).astype(np.uint8)


def _eye_dome(log_depth: Float64) -> Float64:
    seen = np.isfinite(log_depth)
    ahead = np.zeros(log_depth.shape)
    for dy, dx in ((0, 2), (2, 0), (0, -2), (-2, 0)):
        neighbour = np.roll(log_depth, (dy, dx), axis=(0, 1))
        both = seen & np.isfinite(neighbour)
        ahead[both] += np.clip(log_depth[both] - neighbour[both], 0, 0.15)
    return np.exp(-5.0 * ahead)
