"""A coloured ball, cast ray by ray from eight sides, and points on it to train from."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ss_flow.tasks.artifacts import Gaussians
from ss_flow.tasks.gaussians.initialise import initialise
from ss_flow.tasks.gaussians.native_pass import PARAMETERS
from ss_flow.tasks.gaussians.objective import Objective, Target
from ss_flow.tasks.gaussians.trainer import PartView
from ss_flow.tasks.gaussians.views import TrainView
from ss_flow.tasks.geometry.cameras import Camera

SIZE = 48


def camera_round(angle: float) -> Camera:
    """Looks at the origin from 3 units away, in the plane y = 0."""
    pose = np.eye(4)
    pose[:3, :3] = [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
    pose[2, 3] = 3
    return Camera(SIZE, SIZE, 60.0, 60.0, SIZE / 2, SIZE / 2, pose)


def color_at(points: np.ndarray) -> np.ndarray:
    return (0.5 + 0.4 * np.sin(3 * points + (0, 1, 2))).astype(np.float32)


def ball_view(angle: float) -> TrainView:
    """The ball of radius 0.8 about the origin, cast ray by ray."""
    camera = camera_round(angle)
    v, u = np.mgrid[:SIZE, :SIZE] + 0.5
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones_like(u)], -1)
    rays = rays @ camera.world_to_camera[:3, :3]
    a, b, c = (rays**2).sum(-1), rays @ camera.center, camera.center @ camera.center - 0.64
    root = b * b - a * c
    inside = root > 0
    z = np.where(inside, (-b - np.sqrt(np.maximum(root, 0))) / a, 0)
    image = color_at(camera.center + rays * z[..., None])
    image[~inside] = 1
    return TrainView(camera, image, inside, ~inside, z.astype(np.float32))


VIEWS = [ball_view(a) for a in np.linspace(0, 2 * np.pi, 8, endpoint=False)]


def ball_points(n: int = 300):
    points = np.random.default_rng(0).normal(size=(n, 3))
    points *= 0.8 / np.linalg.norm(points, axis=1, keepdims=True)
    return initialise(points.astype(np.float32), (255 * color_at(points)).astype(np.uint8), 4, 0.5)


def same_bytes(a: Gaussians, b: Gaussians) -> bool:
    return all(getattr(a, name).tobytes() == getattr(b, name).tobytes() for name in PARAMETERS)


def part_view(start: int, stop: int, angle: float) -> PartView:
    """Of these rows nothing may reach beyond the ball's outline."""
    view = ball_view(angle)
    image = np.zeros_like(view.image)
    empty = replace(view, image=image, inside=np.zeros_like(view.inside))
    return PartView(start, stop, Target.of(empty, Objective(), 0))
