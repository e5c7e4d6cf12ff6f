"""The built-in scene: a generated room with exact poses, depth and instance ids, as arrays or as an ordinary capture.

The room is 4 m wide, z up, in metres. A table, a shelf, a sofa and small things of distinct names ("red mug") stand
in it; the camera goes once round, looking inwards, near and far, high and low.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ss_flow.errors import InputError
from ss_flow.flows.generated_layout import Thing, furnish
from ss_flow.flows.generated_masks import DegradeParams, degrade
from ss_flow.flows.generated_render import Renderer
from ss_flow.tasks.artifacts import Cameras, Float32, Float64, Int32, UInt8
from ss_flow.tasks.geometry.cameras import backproject, camera_of
from ss_flow.tasks.geometry.images import encode_png

__all__ = ["DegradeParams", "Room", "RoomParams", "SceneObject", "Views", "degrade", "generate", "write_scene"]

_FOCAL = 0.9
"""Focal length in image widths: 58 degrees across."""
_JPEG_QUALITY = 95
_POINT_VOXEL = 0.02


@dataclass(frozen=True)
class RoomParams:
    """What the generated room is like."""

    objects: int = 10
    """Number of small things, besides table, shelf and sofa."""
    views: int = 24
    """Number of views round the room."""
    width: int = 320
    """Image width, pixels."""
    height: int = 240
    """Image height, pixels."""
    seed: int = 0
    """Another seed is another room."""
    held_out: int = 4
    """Number of further views between the others, kept back for novel-view evaluation."""


@dataclass(frozen=True)
class SceneObject:
    """One instance of the room: a piece of furniture or a small thing."""

    instance_id: int
    """1.. in the order of the table."""
    name: str
    """Unique in the room: colour word and noun, such as "red mug"."""
    color: str
    """The colour word."""


@dataclass(frozen=True)
class Views:
    """Rendered views with their ground truth."""

    rgb: UInt8
    """[K, H, W, 3]."""
    depth: Float32
    """[K, H, W] exact z-depth at pixel centres, metres; known everywhere."""
    ids: NDArray[np.uint16]
    """[K, H, W] exact instance ids at pixel centres; 0 = structure (walls, floor, ceiling)."""
    cameras: Cameras

    def __len__(self) -> int:
        return len(self.rgb)


@dataclass(frozen=True)
class Room(Views):
    """A generated room: its views, and what is in it."""

    held_out: Views
    objects: tuple[SceneObject, ...]
    points: Float32
    """[N, 3] surface points that some view sees, one in each cube of 2 cm, world."""
    point_colors: UInt8
    """[N, 3] RGB."""
    point_ids: Int32
    """[N] instance ids, 0 = structure."""


def generate(params: RoomParams) -> Room:
    """Build and photograph a room; the same parameters give the same arrays.

    Raises InputError when a number is out of range, or when open3d cannot be loaded.
    """
    if params.views < 2 or params.held_out < 0 or min(params.width, params.height) < 16:
        raise InputError("A generated room needs at least 2 views, 0 held-out views and 16 x 16 pixels.")
    rng = np.random.default_rng(params.seed)
    things = furnish(params.objects, rng)
    renderer = Renderer(things, params.seed)
    phase, jitter = rng.uniform(0, 2 * np.pi, 3), rng.uniform(-1, 1, (params.views, 2))
    turn = np.arange(params.views) / params.views
    between = (
        np.floor((np.arange(params.held_out) + 0.5) * params.views / max(params.held_out, 1)) + 0.5
    ) / params.views
    poses = np.stack([_pose(t, phase, j) for t, j in zip(turn, jitter, strict=True)])
    extra = np.array([_pose(t, phase, np.zeros(2)) for t in between]).reshape(-1, 4, 4)
    views = _photograph(renderer, poses, params, rng)
    held_out = _photograph(renderer, extra, params, rng)
    points, colors, ids = _surface_points(views)
    return Room(views.rgb, views.depth, views.ids, views.cameras, held_out, _objects(things), points, colors, ids)


def write_scene(
    room: Room,
    folder: Path,
    masks: Literal["truth", "degraded"] | None = None,
    degradation: DegradeParams = DegradeParams(),
    seed: int = 0,
) -> None:
    """Write a room as a capture in the ScanNet export layout, the way a user's own would lie on disk.

    `color/NNNN.jpg`, `depth/NNNN.png` (uint16 millimetres), `pose/NNNN.txt` (camera-to-world), `intrinsic/` (4 x 4,
    integer pixel centres), `instance/NNNN.png` (uint16 ground truth) and `instances.json` (id -> name, whose first
    word is the colour); the same in `held_out/` for the views kept back. With `masks`, also `instance_masks/NNNN.png`
    (uint16, 0 = no mask): the true masks, or masks degraded with `degradation` and `seed`.

    Raises InputError when `folder` already holds something.
    """
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise InputError(f"{folder} already exists and is not an empty folder; name a new one for the generated scene.")
    _write_views(room, folder)
    if len(room.held_out):
        _write_views(room.held_out, folder / "held_out")
    names = {str(o.instance_id): o.name for o in room.objects}
    (folder / "instances.json").write_text(json.dumps(names, indent=1) + "\n", encoding="utf-8")
    if masks is not None:
        ids = room.ids if masks == "truth" else degrade(room.ids, degradation, seed=seed)
        for name, image in zip(room.cameras.names, ids, strict=True):
            _write_bytes(folder / "instance_masks" / f"{name}.png", encode_png(image))


def _pose(turn: float, phase: Float64, jitter: Float64) -> Float64:
    """World-to-camera of the view at a place (0..1) of the way round."""
    angle = 2 * np.pi * turn + 0.05 * jitter[0]
    outwards = np.array([np.cos(angle), np.sin(angle), 0.0])
    radius = 1.2 + 0.3 * np.cos(4 * angle + phase[0])
    height = 1.55 + 0.25 * np.sin(3 * angle + phase[1]) + 0.03 * jitter[1]
    eye = radius * outwards + (0, 0, height)
    target = -(0.5 + 0.6 * (1.2 - radius)) * outwards + (0, 0, 0.5 + 0.08 * np.sin(5 * angle + phase[2]))
    forward = target - eye
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward])
    pose[:3, 3] = -pose[:3, :3] @ eye
    return pose


def _photograph(renderer: Renderer, poses: Float64, params: RoomParams, rng: np.random.Generator) -> Views:
    h, w, k = params.height, params.width, len(poses)
    cameras = Cameras(
        names=tuple(f"{i:04d}" for i in range(k)),
        sizes=np.tile(np.array([w, h], np.int32), (k, 1)),
        intrinsics=np.tile([_FOCAL * w, _FOCAL * w, w / 2, h / 2], (k, 1)),
        world_to_camera=poses,
        metric=True,
    )
    rgb, depth = np.empty((k, h, w, 3), np.uint8), np.empty((k, h, w), np.float32)
    ids = np.empty((k, h, w), np.uint16)
    for i in range(k):
        rgb[i], depth[i], ids[i] = renderer.render(camera_of(cameras, i), rng)
    return Views(rgb, depth, ids, cameras)


def _objects(things: tuple[Thing, ...]) -> tuple[SceneObject, ...]:
    return tuple(SceneObject(t.instance_id, t.name, t.color) for t in things if t.instance_id)


def _surface_points(views: Views) -> tuple[Float32, UInt8, Int32]:
    """One point of each occupied cube: the first that a view sees."""
    points = np.concatenate([backproject(views.depth[i], camera_of(views.cameras, i)) for i in range(len(views))])
    cell = np.floor((points - points.min(axis=0)) / _POINT_VOXEL).astype(np.int64)
    _, first = np.unique(np.ravel_multi_index(cell.T, cell.max(axis=0) + 1), return_index=True)
    first.sort()
    colors, ids = views.rgb.reshape(-1, 3)[first], views.ids.ravel()[first].astype(np.int32)
    return points[first].astype(np.float32), colors, ids


def _write_views(views: Views, folder: Path) -> None:
    import cv2

    for i, name in enumerate(views.cameras.names):
        ok, jpeg = cv2.imencode(".jpg", views.rgb[i][..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
        if not ok:
            raise ValueError(f"cannot encode view {name} as JPEG")
        _write_bytes(folder / "color" / f"{name}.jpg", jpeg)
        millimetres = np.round(1000 * views.depth[i]).astype(np.uint16)
        _write_bytes(folder / "depth" / f"{name}.png", encode_png(millimetres))
        _write_bytes(folder / "instance" / f"{name}.png", encode_png(views.ids[i]))
        _write_matrix(folder / "pose" / f"{name}.txt", np.linalg.inv(views.cameras.world_to_camera[i]))
    fx, fy, cx, cy = views.cameras.intrinsics[0]
    # Other programs count pixels from their centres: theirs is half a pixel less than ours.
    matrix = np.array([[fx, 0, cx - 0.5, 0], [0, fy, cy - 0.5, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    for sensor in ("color", "depth"):
        _write_matrix(folder / "intrinsic" / f"intrinsic_{sensor}.txt", matrix)
        _write_matrix(folder / "intrinsic" / f"extrinsic_{sensor}.txt", np.eye(4))


def _write_matrix(path: Path, matrix: Float64) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join(" ".join(f"{x:.9f}" for x in row) for row in matrix) + "\n", encoding="utf-8")


def _write_bytes(path: Path, data: UInt8) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data.tobytes())
