"""A scene made by ray casting: a floor (0), a turned box (1) and a ball (2) at its corner, seen from a ring."""

from __future__ import annotations

import numpy as np
from view_masks import as_fields

from ss_flow.tasks.artifacts import Cameras, DepthMap, Frame, InstanceMasks, LabelMap, SceneUnit
from ss_flow.tasks.gaussians.views import Views
from ss_flow.tasks.geometry.cameras import backproject, camera_of, cameras_by_view, looking
from ss_flow.tasks.geometry.images import encode_png

WIDTH, HEIGHT, VIEWS = 96, 72, 8
BALL, RADIUS = np.array([0.42, 0.0, 0.22]), 0.22
HALF, TURN = np.array([0.3, 0.2, 0.25]), np.deg2rad(35)


class SmallScene:
    def __init__(self) -> None:
        poses = [_look_from(2.2 * np.array([np.cos(t), np.sin(t), 0.75])) for t in 2 * np.pi * np.arange(VIEWS) / VIEWS]
        names = tuple(f"v{k}" for k in range(VIEWS))
        self.cameras = Cameras(
            names=names,
            sizes=np.tile(np.array([[WIDTH, HEIGHT]], np.int32), (VIEWS, 1)),
            intrinsics=np.tile([[90.0, 90.0, WIDTH / 2, HEIGHT / 2]], (VIEWS, 1)),
            world_to_camera=np.array(poses),
            metric=True,
        )
        self.images, self.ids, frames, depths, maps = [], [], [], [], []
        points, colors, labels = [], [], []
        for k, name in enumerate(names):
            camera = camera_of(self.cameras, k)
            directions = backproject(np.ones((HEIGHT, WIDTH), np.float32), camera) - camera.center
            z, ids = _cast(camera.center, directions)
            places = camera.center + z[:, None] * directions
            rgb = _texture(places, ids).reshape(HEIGHT, WIDTH, 3)
            self.images.append(rgb)
            self.ids.append(ids.reshape(HEIGHT, WIDTH))
            frames.append(Frame(name, WIDTH, HEIGHT, encode_png(rgb), np.zeros(0, np.uint8), WIDTH, HEIGHT))
            depths.append(DepthMap(name, z.reshape(HEIGHT, WIDTH).astype(np.float32), "sensor"))
            maps.append(LabelMap(name, self.ids[-1].astype(np.uint16)))
            points.append(places)
            colors.append(rgb.reshape(-1, 3))
            labels.append(ids)
        self.frames, self.depths, self.maps = tuple(frames), tuple(depths), tuple(maps)
        self.points = np.concatenate(points).astype(np.float32)
        self.colors, self.labels = np.concatenate(colors), np.concatenate(labels)

    @property
    def views(self) -> Views:
        """All of them, as a run gives them to a step."""
        return Views(self.frames, cameras_by_view(self.cameras), self.depths, SceneUnit(1.0), ())

    def instance(self, instance_id: int, views: tuple[int, ...] = tuple(range(VIEWS)), every: int = 3) -> InstanceMasks:
        mine = np.flatnonzero(self.labels == instance_id)[::every]
        masks = np.array([self.ids[k] == instance_id for k in views], bool).reshape(-1, HEIGHT, WIDTH)
        return InstanceMasks(
            instance_id=instance_id,
            points=self.points[mine],
            colors=self.colors[mine],
            point_confidence=np.full(len(mine), 0.9, np.float32),
            point_part=((self.points[mine, 2] > 0.25) & (instance_id > 0)).astype(np.int32),
            confidence=0.9,
            views=tuple(self.frames[k].name for k in views),
            **as_fields(masks),
            origin=np.zeros(len(views), np.uint8),
            weak=False,
        )


def _look_from(place: np.ndarray) -> np.ndarray:
    forward = np.array([0, 0, 0.15]) - place
    return looking(place, forward / np.linalg.norm(forward), np.array([0, 0, 1.0]))


def _cast(origin: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Depth along `directions` (of unit z-depth) and the id of what they meet; the floor ends in a round wall."""
    with np.errstate(divide="ignore", invalid="ignore"):
        floor = np.where(directions[:, 2] < 0, -origin[2] / directions[:, 2], np.inf)
        a, b = (directions[:, :2] ** 2).sum(1), directions[:, :2] @ origin[:2]
        wall = (-b + np.sqrt(b * b - a * (origin[:2] @ origin[:2] - 9.0))) / a
        a, b = (directions**2).sum(1), directions @ (origin - BALL)
        disc = b * b - a * ((origin - BALL) @ (origin - BALL) - RADIUS**2)
        ball = np.where(disc > 0, (-b - np.sqrt(np.maximum(disc, 0))) / a, np.inf)
        c, s = np.cos(TURN), np.sin(TURN)
        turn = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
        o, d = turn @ (origin - [0, 0, HALF[2]]), directions @ turn.T
        near, far = np.sort([(-HALF - o) / d, (HALF - o) / d], axis=0)
        enter = near.max(axis=1)
        box = np.where((enter < far.min(axis=1)) & (enter > 0), enter, np.inf)
    depths = np.stack([np.minimum(floor, wall), box, ball])
    return depths.min(axis=0), depths.argmin(axis=0).astype(np.int32)


def _texture(places: np.ndarray, ids: np.ndarray) -> np.ndarray:
    base = np.array([[120, 130, 110], [190, 80, 60], [60, 90, 190]], float)[ids]
    wave = np.sin(places * 9).sum(axis=1)[:, None]
    return np.clip(base + 15 * wave, 0, 255).astype(np.uint8)
