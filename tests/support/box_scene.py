"""Boxes on a floor, ray-cast from a ring of cameras: exact depth, and exact instance ids, of every pixel."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from clouds import even_cloud

from ss_flow.tasks.artifacts import (
    Bool,
    Cameras,
    DepthMap,
    EditedScene,
    Frame,
    MaskSet,
    PointLabels,
    Visibility,
)
from ss_flow.tasks.edit.holes import Measured
from ss_flow.tasks.edit.operations import edited
from ss_flow.tasks.gaussians.initialise import initialise
from ss_flow.tasks.geometry.cameras import backproject, camera_of, looking
from ss_flow.tasks.geometry.images import encode_png
from ss_flow.tasks.packed import Masks

WIDTH, HEIGHT, VIEWS = 96, 72, 6
BOXES = np.array(
    [
        [[-0.9, -0.6, 0.0], [-0.3, 0.0, 0.5]],
        [[0.2, -0.5, 0.0], [0.7, 0.1, 0.7]],
        [[-0.3, 0.4, 0.0], [0.3, 0.9, 0.4]],
    ]
)
"""[3, 2, 3] low and high corners, metres; z points up; ids 1 to 3. The floor is z = 0."""
COLORS = np.array([[120, 120, 120], [200, 40, 40], [40, 200, 40], [40, 40, 200]], np.uint8)


def cameras(scale: float = 1.0) -> Cameras:
    """A ring of cameras that look down at the boxes from 2.5 m, with the whole world `scale` times as large."""
    poses = []
    for angle in np.arange(VIEWS) * 2 * np.pi / VIEWS:
        eye = np.array([2.2 * np.cos(angle), 2.2 * np.sin(angle), 1.6])
        forward = np.array([0, 0, 0.2]) - eye
        pose = looking(eye, forward / np.linalg.norm(forward), np.array([0, 0, 1.0]))
        pose[:3, 3] *= scale
        poses.append(pose)
    return Cameras(
        names=tuple(f"{k}" for k in range(VIEWS)),
        sizes=np.tile(np.array([WIDTH, HEIGHT], np.int32), (VIEWS, 1)),
        intrinsics=np.tile([90.0, 90.0, WIDTH / 2, HEIGHT / 2], (VIEWS, 1)),
        world_to_camera=np.array(poses),
        metric=scale == 1.0,
    )


def cast(view: int, scale: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """z-depth [H, W] in the scaled world, and ids [H, W] (0 = floor), of one view."""
    camera = camera_of(cameras(), view)
    v, u = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    local = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones_like(u)], axis=-1)
    rays = local @ camera.world_to_camera[:3, :3]
    eye = camera.center
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = np.where(rays[..., 2] < 0, -eye[2] / rays[..., 2], np.inf)
        ids = np.zeros((HEIGHT, WIDTH), int)
        for number, (low, high) in enumerate(BOXES, start=1):
            a, b = (low - eye) / rays, (high - eye) / rays
            enter, leave = np.minimum(a, b).max(axis=-1), np.maximum(a, b).min(axis=-1)
            hit = (enter < leave) & (enter > 0) & (enter < depth)
            depth[hit], ids[hit] = enter[hit], number
    return np.where(np.isfinite(depth), depth, 0).astype(np.float32) * np.float32(scale), ids


def frames() -> tuple[Frame, ...]:
    """The photos: every object has one colour."""
    empty = np.zeros(0, np.uint8)
    return tuple(
        Frame(f"{k}", WIDTH, HEIGHT, encode_png(COLORS[cast(k)[1]]), empty, WIDTH, HEIGHT) for k in range(VIEWS)
    )


def depths(scale: float = 1.0) -> tuple[DepthMap, ...]:
    """The depth maps of all views."""
    return tuple(DepthMap(f"{k}", cast(k, scale)[0], "sensor") for k in range(VIEWS))


def distance_to_scene(points: np.ndarray) -> np.ndarray:
    """Distance of each point [N, 3] to the nearest surface of the boxes and the floor: [N]."""
    outside = np.maximum(BOXES[:, 0] - points[:, None], points[:, None] - BOXES[:, 1])
    boxes = np.abs(np.where(outside.max(axis=-1) <= 0, outside.max(axis=-1), np.linalg.norm(outside.clip(0), axis=-1)))
    return np.minimum(np.abs(points[:, 2]), boxes.min(axis=1))


def measured(spacing: float) -> tuple[Measured, EditedScene]:
    """What the cameras see of the floor and the boxes: as points with true ids, and as Gaussians at these.

    spacing: one point a cube of this side, metres.
    """
    seen = cameras()
    places, ids = [], []
    for view in range(VIEWS):
        depth, own = cast(view)
        places.append(backproject(depth, camera_of(seen, view)))
        ids.append(own.ravel())
    points, labels = np.concatenate(places).astype(np.float32), np.concatenate(ids).astype(np.int32)
    near = (np.abs(points) < 6).all(axis=1)
    _, first = np.unique(np.floor(points[near] / spacing).astype(int), axis=0, return_index=True)
    points, labels = points[near][first], labels[near][first]
    none, ones = np.zeros(0, np.int32), np.ones(len(points), np.float32)
    known = PointLabels(labels, ones, 3, none, none, none)
    cloud = even_cloud(points, COLORS[labels], 1.0, spacing)
    return Measured(seen, depths(), cloud, known), edited(
        initialise(points, COLORS[labels], labels, 1.0, opacity=0.9), filled=0
    )


def mask_set(masks: np.ndarray, name: str = "0") -> MaskSet:
    """A MaskSet of [N, H, W] booleans."""
    count, height, width = masks.shape
    return MaskSet(
        name=name,
        height=height,
        width=width,
        **vars(Masks.of(masks.astype(bool))),
        predicted_iou=np.ones(count, np.float32),
        stability=np.ones(count, np.float32),
        grid=np.zeros(count, np.int32),
        parent=np.full(count, -1, np.int32),
        source="generated",
    )


def true_masks() -> tuple[MaskSet, ...]:
    """One mask for each box that a view sees, in the order of the ids."""
    sets = []
    for k in range(VIEWS):
        ids = cast(k)[1]
        sets.append(mask_set(np.stack([ids == i for i in range(1, 4) if (ids == i).any()]), f"{k}"))
    return tuple(sets)


def permuted(masks: MaskSet, order: np.ndarray) -> MaskSet:
    """The same masks in another order."""
    return replace(masks, **vars(masks.rows(order)))


def row_of_points(points: list[int], width: int = 8) -> tuple[Visibility, Bool]:
    """A view of 1 x `width` pixels that sees point p at pixel p, and the pixels it sees as a mask."""
    index = np.array(sorted(points), np.int32)
    mask = np.zeros((1, width), bool)
    mask[0, index] = True
    return Visibility("0", index, index, np.ones(len(index), np.float32), 1, width), mask
