"""The built-in scene: a generated room with exact poses, depth and instance ids, as arrays or as an ordinary capture.

The room is 4 m wide, z up, in metres. A table, a shelf, a sofa and small things of distinct names ("red mug") stand
in it; the camera goes once round, looking inwards, near and far, high and low. In a composite room everything is made
of differently coloured parts, and every second view is a close one.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from ss_flow.errors import InputError
from ss_flow.flows.generated.composite_room import GAZE, Station, close_up, furnish_composites, gripper
from ss_flow.flows.generated.layout import MAX_OBJECTS, Thing, furnish
from ss_flow.flows.generated.masks import DegradeParams, degrade
from ss_flow.flows.generated.render import Renderer
from ss_flow.tasks.artifacts import Bool, Cameras, Float32, Float64, Int32, UInt8
from ss_flow.tasks.geometry.cameras import Camera, backproject, camera_of, looking
from ss_flow.tasks.geometry.images import encode_png

__all__ = ["DegradeParams", "Room", "RoomParams", "SceneObject", "Views", "degrade", "generate", "write_scene"]

_FOCAL = 0.9
"""Focal length in image widths: 58 degrees across."""
_JPEG_QUALITY = 95
_POINT_VOXEL = 0.02
_GAZE = 0.5
"""Height that the views look at, metres."""


@dataclass(frozen=True)
class RoomParams:
    """What the generated room is like."""

    objects: int = 10
    """Number of small things, besides table, shelf and sofa; a composite room always holds the same dozen."""
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
    composite: bool = False
    """Whether to furnish with things of several, differently coloured parts; 480 x 360 pixels show them well."""
    gripper: bool = False
    """Whether a gripper moves along in front of the lens; the valid masks leave it out."""

    def __post_init__(self) -> None:
        """Raises InputError when a number is out of range."""
        if self.views < 2 or self.held_out < 0 or min(self.width, self.height) < 16:
            raise InputError("A generated room needs at least 2 views, 0 held-out views and 16 x 16 pixels.")
        if not 1 <= self.objects <= MAX_OBJECTS:
            raise InputError(f"A generated room holds 1 to {MAX_OBJECTS} objects, not {self.objects}.")


@dataclass(frozen=True)
class SceneObject:
    """One instance of the room: a piece of furniture or a small thing; or its structure."""

    instance_id: int
    """1.. in the order of the table; 0 is the structure."""
    name: str
    """Unique in the room: colour word and noun, such as "red mug"."""
    color: str
    """The colour word."""
    parts: tuple[str, ...] = ()
    """What its parts 1.. are called; none where it is of one piece."""

    @property
    def kind(self) -> Literal["thing", "stuff"]:
        """Walls, floor and ceiling are stuff."""
        return "thing" if self.instance_id else "stuff"


@dataclass(frozen=True)
class Views:
    """Rendered views with their ground truth."""

    rgb: UInt8
    """[K, H, W, 3]."""
    depth: Float32
    """[K, H, W] z-depth at pixel centres, metres, exact and known everywhere but on a desk."""
    ids: NDArray[np.uint16]
    """[K, H, W] exact instance ids at pixel centres; 0 = structure (walls, floor, ceiling)."""
    parts: UInt8
    """[K, H, W] exact part ids within the instance; 0 where it has no parts."""
    valid: Bool
    """[K, H, W] False where something that moves with the camera hides the room; ids and parts are 0 there."""
    cameras: Cameras

    def __len__(self) -> int:
        return len(self.rgb)


@dataclass(frozen=True)
class Room(Views):
    """A generated room: its views, and what is in it."""

    held_out: Views
    objects: tuple[SceneObject, ...]
    """The things, by their ids 1.."""
    structure: SceneObject
    """Walls, floor and ceiling together."""
    points: Float32
    """[N, 3] surface points that some view sees, one in each cube of 2 cm, world."""
    point_colors: UInt8
    """[N, 3] RGB."""
    point_ids: Int32
    """[N] instance ids, 0 = structure."""


def generate(params: RoomParams) -> Room:
    """Build and photograph a room; the same parameters give the same arrays.

    Raises InputError when open3d cannot be loaded.
    """
    rng = np.random.default_rng(params.seed)
    things, stations = _furnished(params, rng)
    gaze = GAZE if params.composite else _GAZE
    renderer = Renderer(things, params.seed)
    phase, jitter = rng.uniform(0, 2 * np.pi, 3), rng.uniform(-1, 1, (params.views, 2))
    turn = np.arange(params.views) / params.views
    between = (
        np.floor((np.arange(params.held_out) + 0.5) * params.views / max(params.held_out, 1)) + 0.5
    ) / params.views
    poses = np.stack([_pose(t, phase, j, gaze) for t, j in zip(turn, jitter, strict=True)])
    extra = np.array([_pose(t, phase, np.zeros(2), gaze) for t in between]).reshape(-1, 4, 4)
    if stations:
        for i in range(1, params.views, 2):
            poses[i] = looking_at(*close_up(stations[i // 2 % len(stations)], rng))
    views = photographed(renderer, poses, params, rng)
    held_out = photographed(renderer, extra, params, rng)
    if params.gripper:
        views, held_out = _gripped(views, params, rng), _gripped(held_out, params, rng)
    return furnished_room(views, held_out, things)


def furnished_room(views: Views, held_out: Views, things: tuple[Thing, ...]) -> Room:
    """The room of these views, which shows these things."""
    structure, *objects = _objects(things)
    return Room(**vars(views), held_out=held_out, objects=tuple(objects), structure=structure, **_points(views))


def renderer_of(params: RoomParams) -> Renderer:
    """What photographs a room from anywhere, the room or one thing of it."""
    return Renderer(_furnished(params, np.random.default_rng(params.seed))[0], params.seed)


def write_scene(
    room: Room,
    folder: Path,
    masks: Literal["truth", "degraded"] | None = None,
    seed: int = 0,
) -> None:
    """Write a room as a capture in the ScanNet export layout, the way a user's own would lie on disk.

    `color/NNNN.jpg`, `depth/NNNN.png` (uint16 millimetres), `pose/NNNN.txt` (camera-to-world), `intrinsic/` (4 x 4,
    integer pixel centres), `instance/NNNN.png` (uint16 ground truth) and `instances.json` (id -> name, whose first
    word is the colour; also of 0, the structure, since every pixel is annotated); the same in `held_out/` for the views
    kept back. With `masks`, also `instance_masks/NNNN.png` (uint16, 0 = no mask): the true masks, or masks degraded
    with `seed`. Where things have parts, also `part/NNNN.png` (uint8, ids within the instance) and
    `parts.json` (instance id -> name, kind "thing" or "stuff", parts by id; the structure is 0); where something stands
    before the lens, `valid/NNNN.png` (0 = ignore).

    Raises InputError when `folder` already holds something.
    """
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise InputError(f"{folder} already exists and is not an empty folder; name a new one for the generated scene.")
    write_views(room, folder)
    if len(room.held_out):
        write_views(room.held_out, folder / "held_out")
    names = {str(o.instance_id): o.name for o in (room.structure, *room.objects)}
    (folder / "instances.json").write_text(json.dumps(names, indent=1) + "\n", encoding="utf-8")
    if room.parts.any():
        tree = {
            o.instance_id: {"name": o.name, "kind": o.kind, "parts": dict(enumerate(o.parts, 1))}
            for o in (room.structure, *room.objects)
        }
        (folder / "parts.json").write_text(json.dumps(tree, indent=1) + "\n", encoding="utf-8")
    if masks is not None:
        ids = room.ids if masks == "truth" else degrade(room.ids, DegradeParams(), seed=seed)
        for name, image in zip(room.cameras.names, ids, strict=True):
            _write_bytes(folder / "instance_masks" / f"{name}.png", encode_png(image))


def _furnished(params: RoomParams, rng: np.random.Generator) -> tuple[tuple[Thing, ...], tuple[Station, ...]]:
    """Everything in the room, and the stations of its close views."""
    return furnish_composites(rng) if params.composite else (furnish(params.objects, rng), ())


def _pose(turn: float, phase: Float64, jitter: Float64, gaze: float) -> Float64:
    """World-to-camera of the view at a place (0..1) of the way round, looking at about the height `gaze`."""
    angle = 2 * np.pi * turn + 0.05 * jitter[0]
    outwards = np.array([np.cos(angle), np.sin(angle), 0.0])
    radius = 1.2 + 0.3 * np.cos(4 * angle + phase[0])
    height = 1.55 + 0.25 * np.sin(3 * angle + phase[1]) + 0.03 * jitter[1]
    eye = radius * outwards + (0, 0, height)
    target = -(0.5 + 0.6 * (1.2 - radius)) * outwards + (0, 0, gaze + 0.08 * np.sin(5 * angle + phase[2]))
    return looking_at(eye, target)


def looking_at(eye: Float64, target: Float64) -> Float64:
    """World-to-camera of an upright camera at `eye` that looks at `target`."""
    forward = target - eye
    return looking(eye, forward / np.linalg.norm(forward), np.array([0.0, 0.0, 1.0]))


def photographed(renderer: Renderer, poses: Float64, params: RoomParams, rng: np.random.Generator) -> Views:
    """Photos from poses [K, 4, 4], world-to-camera, of the size that `params` tell."""
    h, w, k = params.height, params.width, len(poses)
    cameras = Cameras(
        names=tuple(f"{i:04d}" for i in range(k)),
        sizes=np.tile(np.array([w, h], np.int32), (k, 1)),
        intrinsics=np.tile([_FOCAL * w, _FOCAL * w, w / 2, h / 2], (k, 1)),
        world_to_camera=poses,
        metric=True,
    )
    rgb, depth = np.empty((k, h, w, 3), np.uint8), np.empty((k, h, w), np.float32)
    ids, parts = np.empty((k, h, w), np.uint16), np.empty((k, h, w), np.uint8)
    for i in range(k):
        rgb[i], depth[i], ids[i], parts[i] = renderer.render(camera_of(cameras, i), rng)
    return Views(rgb, depth, ids, parts, np.ones((k, h, w), bool), cameras)


def _gripped(views: Views, params: RoomParams, rng: np.random.Generator) -> Views:
    """The views with the gripper before the lens, the same in all of them."""
    focal = _FOCAL * params.width
    camera = Camera(params.width, params.height, focal, focal, params.width / 2, params.height / 2, np.eye(4))
    rgb, depth, ids, _ = Renderer(gripper(), params.seed).render(camera, rng)
    clear = ids == 0
    return replace(
        views,
        rgb=np.where(clear[..., None], views.rgb, rgb),
        depth=np.where(clear, views.depth, depth),
        ids=views.ids * clear,
        parts=views.parts * clear,
        valid=views.valid & clear,
    )


def _objects(things: tuple[Thing, ...]) -> list[SceneObject]:
    """The instances by rising id, the structure first."""
    names: dict[int, tuple[str, str]] = {}
    parts: dict[int, dict[int, str]] = {}
    for t in things:
        names.setdefault(t.instance_id, (t.name, t.color))
        parts.setdefault(t.instance_id, {})[t.part_id] = t.part
    return [
        SceneObject(i, *names[i], tuple(name for part_id, name in sorted(parts[i].items()) if part_id)) for i in names
    ]


def _points(views: Views) -> dict[str, Any]:
    """A room's points: one of each occupied cube, the first that a view sees."""
    points = np.concatenate([backproject(views.depth[i], camera_of(views.cameras, i)) for i in range(len(views))])
    clear = np.flatnonzero(views.valid)
    points = points[clear]
    cell = ((points - points.min(axis=0)) / _POINT_VOXEL).astype(np.int64)
    _, first = np.unique(np.ravel_multi_index(cell.T, cell.max(axis=0) + 1), return_index=True)
    first.sort()
    pixel = clear[first]
    return {
        "points": points[first].astype(np.float32),
        "point_colors": views.rgb.reshape(-1, 3)[pixel],
        "point_ids": views.ids.ravel()[pixel].astype(np.int32),
    }


def write_views(views: Views, folder: Path) -> None:
    """Write views as `write_scene` writes those of a room, without what its things are called."""
    import cv2

    for i, name in enumerate(views.cameras.names):
        ok, jpeg = cv2.imencode(".jpg", views.rgb[i][..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
        if not ok:
            raise ValueError(f"cannot encode view {name} as JPEG")
        _write_bytes(folder / "color" / f"{name}.jpg", jpeg)
        millimetres = np.round(1000 * views.depth[i]).astype(np.uint16)
        _write_bytes(folder / "depth" / f"{name}.png", encode_png(millimetres))
        _write_bytes(folder / "instance" / f"{name}.png", encode_png(views.ids[i]))
        if views.parts.any():
            _write_bytes(folder / "part" / f"{name}.png", encode_png(views.parts[i]))
        if not views.valid.all():
            _write_bytes(folder / "valid" / f"{name}.png", encode_png(np.uint8(255) * views.valid[i]))
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
