"""COLMAP workspaces: sparse models in binary or text form."""

from __future__ import annotations

import os
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import zip_longest
from pathlib import Path

import numpy as np

from ss_flow.errors import InputError
from ss_flow.tasks.artifacts import Float32, Float64
from ss_flow.tasks.capture.lens import Lens
from ss_flow.tasks.capture.names import natural_key, view_names
from ss_flow.tasks.capture.scene_files import (
    Pose,
    SceneFiles,
    check_lens,
    check_rigid,
    files_in,
    place_of,
    read_text,
)

_MODELS: tuple[tuple[str, int], ...] = (
    ("SIMPLE_PINHOLE", 3),
    ("PINHOLE", 4),
    ("SIMPLE_RADIAL", 4),
    ("RADIAL", 5),
    ("OPENCV", 8),
    ("OPENCV_FISHEYE", 8),
    ("FULL_OPENCV", 12),
    ("FOV", 5),
    ("SIMPLE_RADIAL_FISHEYE", 4),
    ("RADIAL_FISHEYE", 5),
    ("THIN_PRISM_FISHEYE", 12),
    ("RAD_TAN_THIN_PRISM_FISHEYE", 16),
    ("SIMPLE_DIVISION", 4),
    ("DIVISION", 5),
    ("SIMPLE_FISHEYE", 3),
    ("FISHEYE", 4),
    ("EUCM", 6),
    ("EQUIRECTANGULAR", 2),
)
"""Names of COLMAP's camera models and their numbers of parameters, by model id (COLMAP 4.2); `_lens` knows those that
are read."""


@dataclass(frozen=True)
class _View:
    file_name: str
    pose: Pose
    camera: int


def is_colmap(root: Path) -> bool:
    """Whether a folder is a COLMAP workspace or model."""
    return bool(_models(root))


def open_colmap(root: Path) -> SceneFiles:
    """The largest model of a COLMAP workspace, by registered images.

    Photos lie in `images/`, or beside the model; of a model in `sparse/` that is named itself, in the workspace above.
    Those that the model lacks are skipped. World units are arbitrary (`metric` is False).
    Raises InputError when a file is damaged, a photo missing, or a lens unknown.
    """
    models = [(folder, *_read_model(folder)) for folder in _models(root)]
    folder, lenses, views = max(models, key=lambda m: len(m[2]))
    if not views:
        raise InputError(f"{folder} has no registered image; reconstruct the scene again, or give its photos alone.")
    views.sort(key=lambda v: (natural_key(v.file_name), v.file_name))
    images = _images(root, folder, views[0].file_name)
    photos = tuple(place_of(images, v.file_name) for v in views)
    for view in views:
        if view.camera not in lenses:
            raise InputError(f"{folder} has no camera {view.camera}, which its image {view.file_name} refers to.")
    registered = set(photos)
    # COLMAP looks for photos in all folders below `images/`; beside a model without one lie other things, too.
    places = {p.parent for p in photos} | (set() if images == root else set(images.glob("**/")))
    unregistered = [p for place in sorted(places) for p in files_in(place) if p not in registered]
    everything = sorted([*photos, *unregistered], key=lambda p: natural_key(p.as_posix()))
    called = view_names(photos, unregistered)
    taken = {called[p] for p in photos}
    called |= {p: "_".join(p.relative_to(images).with_suffix("").parts) for p in unregistered if called[p] in taken}
    sparse = next((p for p in (folder / "points3D.bin", folder / "points3D.txt") if p.is_file()), None)
    return SceneFiles(
        kind="colmap",
        root=root,
        names=tuple(called[p] for p in photos),
        photos=photos,
        lenses=tuple(lenses[v.camera] for v in views),
        poses=tuple(v.pose for v in views),
        sparse=sparse,
        skipped=tuple(called[p] for p in unregistered),
        why_skipped="which the model did not register",
        all_names=tuple(dict.fromkeys(called[p] for p in everything)),
    )


def read_points(path: Path) -> Float32:
    """[S, 3] the triangulated points of a points3D file.

    Raises InputError when the file is damaged.
    """
    if path.suffix == ".txt":
        rows = [line.split() for line in _lines(path)]
        try:
            return np.array([[float(x) for x in row[1:4]] for row in rows], np.float32).reshape(-1, 3)
        except ValueError as error:
            raise InputError(f"{path} is not a COLMAP points file ({error}).") from error
    data = path.read_bytes()
    points = np.zeros((_count(data, path), 3), np.float32)
    place = 8
    try:
        for i in range(len(points)):
            points[i] = struct.unpack_from("<3d", data, place + 8)
            place += 51 + 8 * struct.unpack_from("<Q", data, place + 43)[0]
    except struct.error as error:
        raise _truncated(path) from error
    return points


def _models(root: Path) -> list[Path]:
    """The folders that hold models, or parts of one, so that a file that is missing is told."""
    places = [root / "sparse", root / "colmap" / "sparse"]
    folders = [f for place in places for f in (place, *sorted(place.glob("*/"), key=lambda p: natural_key(p.name)))]
    # Of the scene's own folder, images.txt may be any list of its photos.
    alone = [root] if _holds_any(root, "cameras", "points3D") else []
    return alone + [folder for folder in folders if _holds_any(folder, "cameras", "images", "points3D")]


def _images(root: Path, model: Path, first: str) -> Path:
    """The folder below which photos are listed; first: one of them."""
    if (root / "images").is_dir():
        return root / "images"
    above = root.absolute().parents[:2] if model == root and not place_of(root, first).exists() else ()
    return next((place / "images" for place in above if (place / "images").is_dir()), root)


def _holds_any(folder: Path, *stems: str) -> bool:
    return any((folder / f"{stem}{suffix}").is_file() for stem in stems for suffix in (".bin", ".txt"))


def _read_model(folder: Path) -> tuple[dict[int, Lens], list[_View]]:
    suffix = ".bin" if any((folder / f"{stem}.bin").is_file() for stem in ("cameras", "images")) else ".txt"
    cameras, images = folder / f"cameras{suffix}", folder / f"images{suffix}"
    for file in (cameras, images):
        if not file.is_file():
            raise InputError(f"{file} is missing; a COLMAP model consists of cameras, images and points3D.")
    if suffix == ".bin":
        return _cameras_binary(cameras), _views_binary(images)
    return _cameras_text(cameras), _views_text(images)


def _lens(model: str, width: int, height: int, p: tuple[float, ...], where: str) -> Lens:
    match model:
        case "SIMPLE_PINHOLE":
            lens = Lens(width, height, p[0], p[0], p[1], p[2])
        case "PINHOLE":
            lens = Lens(width, height, p[0], p[1], p[2], p[3])
        case "SIMPLE_RADIAL":
            lens = Lens(width, height, p[0], p[0], p[1], p[2], (p[3], 0.0, 0.0, 0.0))
        case "RADIAL":
            lens = Lens(width, height, p[0], p[0], p[1], p[2], (p[3], p[4], 0.0, 0.0))
        case "OPENCV" | "FULL_OPENCV":
            lens = Lens(width, height, p[0], p[1], p[2], p[3], p[4:])
        case "OPENCV_FISHEYE":
            lens = Lens(width, height, p[0], p[1], p[2], p[3], p[4:], fisheye=True)
        case "SIMPLE_RADIAL_FISHEYE":
            lens = Lens(width, height, p[0], p[0], p[1], p[2], (p[3], 0.0, 0.0, 0.0), fisheye=True)
        case "RADIAL_FISHEYE":
            lens = Lens(width, height, p[0], p[0], p[1], p[2], (p[3], p[4], 0.0, 0.0), fisheye=True)
        case _:
            raise InputError(f"{where} has a camera of model {model}; undistort the images first (PINHOLE).")
    return check_lens(lens, where)


def _cameras_binary(path: Path) -> dict[int, Lens]:
    data = path.read_bytes()
    lenses, place = {}, 8
    try:
        for _ in range(_count(data, path)):
            camera, model, width, height = struct.unpack_from("<IiQQ", data, place)
            if not 0 <= model < len(_MODELS):
                raise InputError(f"{path} has a camera of model {model}; undistort the images first (PINHOLE).")
            name, number = _MODELS[model]
            parameters = struct.unpack_from(f"<{number}d", data, place + 24)
            lenses[camera] = _lens(name, width, height, parameters, str(path))
            place += 24 + 8 * number
    except struct.error as error:
        raise _truncated(path) from error
    return lenses


def _views_binary(path: Path) -> list[_View]:
    data = path.read_bytes()
    views, place = [], 8
    try:
        for _ in range(_count(data, path)):
            values = struct.unpack_from("<7d", data, place + 4)
            (camera,) = struct.unpack_from("<I", data, place + 60)
            end = data.index(b"\0", place + 64)
            name = os.fsdecode(data[place + 64 : end])
            place = end + 9 + 24 * struct.unpack_from("<Q", data, end + 1)[0]
            views.append(_View(name, _pose(values, path, name), camera))
    except (struct.error, ValueError) as error:
        raise _truncated(path) from error
    if place > len(data):
        raise _truncated(path)
    return views


def _cameras_text(path: Path) -> dict[int, Lens]:
    lenses = {}
    numbers = dict(_MODELS)
    for line in _lines(path):
        words = line.split()
        try:
            camera, model, width, height = int(words[0]), words[1], int(words[2]), int(words[3])
            parameters = tuple(float(w) for w in words[4:])
        except (ValueError, IndexError) as error:
            raise InputError(f"{path} has a line that describes no camera: {line[:60]!r}.") from error
        if len(parameters) != numbers.get(model, len(parameters)):
            raise InputError(f"{path} gives {len(parameters)} parameters to a {model} camera; {numbers[model]} it has.")
        lenses[camera] = _lens(model, width, height, parameters, str(path))
    return lenses


def _views_text(path: Path) -> list[_View]:
    lines = [line for line in read_text(path).splitlines() if not line.startswith("#")]
    while lines and not lines[0].strip():
        lines.pop(0)
    views = []
    for line, points in zip_longest(lines[::2], lines[1::2], fillvalue=""):
        if not line.strip():
            continue
        words = line.split(maxsplit=9)
        try:
            values, camera, name = [float(w) for w in words[1:8]], int(words[8]), words[9].strip()
        except (ValueError, IndexError) as error:
            raise InputError(f"{path} has a line that describes no image: {line[:60]!r}.") from error
        # Where these lines are left out, every second image would be taken for one of them.
        if points.strip() and not points.split()[-1].lstrip("-").isdecimal():
            raise InputError(
                f"{path} lacks the line of image points below that of {name}; COLMAP writes one below every image's, "
                "empty where there are none."
            )
        views.append(_View(name, _pose(values, path, name), camera))
    return views


def _pose(values: Sequence[float], path: Path, name: str) -> Pose:
    where = f"{path} for {name}"
    return tuple(check_rigid(pose_matrix(values[:4], values[4:], where), where).ravel().tolist())


def pose_matrix(quaternion: Sequence[float], place: Sequence[float], where: str) -> Float64:
    """[4, 4] a rotation, as a quaternion w x y z of any length but zero, and then a shift; where it is not finite, NaN.

    where: what to name in a message.
    Raises InputError when the quaternion's length is zero.
    """
    if not any(quaternion):
        raise InputError(f"the pose in {where} has a quaternion of length 0; a rotation has one of length 1.")
    with np.errstate(invalid="ignore"):
        w, x, y, z = np.array(quaternion) / np.linalg.norm(quaternion)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y), place[0]],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x), place[1]],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y), place[2]],
            [0, 0, 0, 1],
        ]
    )


def _lines(path: Path) -> list[str]:
    return [line for line in read_text(path).splitlines() if line.strip() and not line.startswith("#")]


def _count(data: bytes, path: Path) -> int:
    if len(data) < 8:
        raise _truncated(path)
    count = struct.unpack_from("<Q", data)[0]
    if count > len(data):
        raise _truncated(path)
    return int(count)


def _truncated(path: Path) -> InputError:
    return InputError(f"{path} ends too early or is no COLMAP file; export the model again.")
