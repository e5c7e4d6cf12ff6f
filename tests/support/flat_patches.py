"""Flat rectangles of even colours, as points, and what views see of them."""

import numpy as np
from clouds import even_cloud
from labelled_points import one_camera

from ss_flow.tasks.artifacts import Cameras, PointCloud, Visibility
from ss_flow.tasks.geometry.cameras import camera_of, looking, pixels_in_view

STEP = 0.02
SHADE = np.array([0.5, 0.53, 0.58])
"""What a shadow leaves of R, G and B, linear light."""
BROWN, GREY, WHITE, RED = (
    np.array(color) for color in ((0.3, 0.16, 0.08), (0.25, 0.26, 0.27), (0.8, 0.8, 0.8), (0.5, 0.1, 0.1))
)
Patch = tuple[np.ndarray, np.ndarray]


def patch(color: np.ndarray, x: float, y: float, z: float = 0.0, width: float = 0.5) -> Patch:
    """A horizontal rectangle, half a metre deep, with a corner at a place: points and linear colours."""
    u, v = np.meshgrid(np.arange(0, width, STEP), np.arange(0, 0.5, STEP))
    places = np.stack([x + u.ravel(), y + v.ravel(), np.full(u.size, z)], axis=1)
    return places, np.tile(color, (len(places), 1))


def scene(*patches: Patch, unlabelled: int = 0) -> tuple[PointCloud, Cameras, np.ndarray]:
    """Patches seen from above by a grainy camera, and their points' labels, 1.. in their order; the last ones have
    none."""
    light = np.concatenate([color for _, color in patches])
    light = light * np.random.default_rng(0).normal(1, 0.02, (len(light), 1))
    colors = np.round(255 * np.clip(light, 0, 1) ** (1 / 2.2)).astype(np.uint8)
    places = np.concatenate([places for places, _ in patches]).astype(np.float32)
    label = np.repeat(np.arange(1, len(patches) + 1, dtype=np.int32), [len(color) for _, color in patches])
    label[label > len(patches) - unlabelled] = 0
    pose = np.diag([1.0, -1, -1, 1])
    pose[:3, 3] = (0.5, 0.5, 3)
    return even_cloud(places, colors, 1.0, STEP), one_camera(pose), label


def views_of(cloud: PointCloud, *eyes: tuple[float, float, float]) -> tuple[Cameras, list[Visibility]]:
    """Cameras at some places that look at the middle of a table, and the points that each sees."""
    middle, size, focal = np.array([0.5, 0.25, 0.7]), 400, 400.0
    forward = [(middle - eye) / np.linalg.norm(middle - eye) for eye in eyes]
    poses = [looking(np.array(eye), way, np.array([0.0, 0, 1])) for eye, way in zip(eyes, forward, strict=True)]
    lens = np.tile([focal, focal, size / 2, size / 2], (len(eyes), 1))
    sizes = np.full((len(eyes), 2), size, np.int32)
    cameras = Cameras(tuple(map(str, range(len(eyes)))), sizes, lens, np.stack(poses), True)
    return cameras, [_seen(cloud, cameras, view) for view in range(len(eyes))]


def _seen(cloud: PointCloud, cameras: Cameras, view: int) -> Visibility:
    """The nearest points of a view, each hiding what lies behind it within as many pixels as points are apart."""
    camera = camera_of(cameras, view)
    rows, column, row, z = pixels_in_view(cloud.points, camera)
    side = int(np.ceil(2 * camera.fx * STEP / z.min()))
    cell = (row // side) * camera.width + column // side
    nearest = np.full(camera.width * camera.height, np.inf)
    np.minimum.at(nearest, cell, z)
    front = z <= nearest[cell] + 2 * STEP
    pixel = row[front] * camera.width + column[front]
    return Visibility(
        str(view), rows[front], pixel.astype(np.int32), z[front].astype(np.float32), camera.height, camera.width
    )
