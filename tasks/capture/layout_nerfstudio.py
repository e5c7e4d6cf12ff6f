"""nerfstudio's `transforms.json`, which `ns-process-data` also makes of what Polycam, Record3D and others export."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ss_flow.cache.plain_json import read_json
from ss_flow.errors import InputError
from ss_flow.tasks.capture.lens import Lens
from ss_flow.tasks.capture.names import natural_key, view_names
from ss_flow.tasks.capture.photo_files import header_size
from ss_flow.tasks.capture.scene_files import (
    OPENGL_TO_OPENCV,
    Pose,
    SceneFiles,
    check_lens,
    place_of,
    read_text,
    rigid_inverse,
)
from ss_flow.tasks.geometry.cameras import Camera

_ENDINGS = (".png", ".jpg", ".jpeg", ".PNG", ".JPG", ".JPEG")
"""Those that a photo's name may leave out, as in NeRF's synthetic scenes."""
_PERSPECTIVE = {"OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "PERSPECTIVE"}
_DEPTH = ("depth_file_path", "depth_unit_scale_factor")
_DEPTH_OF_NGP = ("depth_path", "integer_depth_scale")
"""What a frame's depth file is called, and world units per unit of these, by nerfstudio and by instant-ngp."""


def open_nerfstudio(path: Path) -> SceneFiles:
    """The capture that a `transforms.json` describes.

    Its poses are camera-to-world with OpenGL's axes (y up, looking along -z); where all frames have depth, all may be
    without. A unit of its depth files is `depth_unit_scale_factor` world units (0.001 unless said), or, where they are
    listed as `depth_path`, `integer_depth_scale`. The scene counts as metric exactly when it has depth maps: those of a
    sensor come in metres, while poses alone are mostly structure from motion's.
    Frames whose photo is not there are left out: such a file is often passed on with a part of its photos.
    Raises InputError when the file or another file that it lists is missing or makes no sense, or no photo is there.
    """
    root = path.parent
    document = _document(path)
    listed = sorted(document["frames"], key=lambda f: (natural_key(f["file_path"]), f["file_path"]))
    places = [(frame, _photo(place_of(root, frame["file_path"]))) for frame in listed]
    found = [(frame, photo) for frame, photo in places if photo is not None]
    if not found:
        first = place_of(root, listed[0]["file_path"])
        raise InputError(
            f"{path} lists {len(listed)} photos, and none of them exists; the first is looked for at {first}"
            f"{'' if first.suffix else ', also with .png, .jpg or .jpeg at its end'}."
        )
    frames, photos = [frame for frame, _ in found], tuple(photo for _, photo in found)
    missing = [place_of(root, frame["file_path"]) for frame, photo in places if photo is None]
    called = view_names(photos, missing)
    depth, unit = _DEPTH if any(f.get(_DEPTH[0]) for f in frames) else _DEPTH_OF_NGP
    with_depth = [f for f in frames if f.get(depth)]
    if with_depth and len(with_depth) < len(frames):
        lacking = next(f["file_path"] for f in frames if not f.get(depth))
        raise InputError(f"{path} gives no {depth} for {lacking}; give one for every frame, or for none.")
    unposed = with_depth and not any("transform_matrix" in frame for frame in frames)
    poses = None if unposed else tuple(_pose(frame, path) for frame in frames)
    return SceneFiles(
        kind="nerfstudio",
        root=root,
        names=tuple(called[p] for p in photos),
        photos=photos,
        valid=tuple(_listed(root, f.get("mask_path"), path) for f in frames),
        depths=tuple(place_of(root, f[depth]) for f in frames) if with_depth else None,
        depth_scale=_depth_scale(document, unit, path) if with_depth else 1e-3,
        lenses=tuple(_lens({**document, **f}, p, path) for f, p in zip(frames, photos, strict=True)),
        poses=poses,
        metric=bool(with_depth),
        skipped=tuple(called[p] for p in missing),
        why_skipped="whose photo is not there",
        all_names=tuple(called[photo or place_of(root, frame["file_path"])] for frame, photo in places),
    )


def read_cameras(path: Path) -> tuple[Camera, ...]:
    """The cameras of a `transforms.json` in the order of its frames, without their distortion; photos need not exist
    where it gives sizes.

    Raises InputError when the file is missing or makes no sense.
    """
    document = _document(path)
    cameras = []
    for frame in document["frames"]:
        lens = _lens({**document, **frame}, path.parent / frame["file_path"], path)
        pose = np.array(_pose(frame, path)).reshape(4, 4)
        cameras.append(Camera(lens.width, lens.height, lens.fx, lens.fy, lens.cx, lens.cy, pose))
    return tuple(cameras)


def transforms_document(cameras: Sequence[Camera], files: Sequence[str]) -> dict[str, Any]:
    """The content of a `transforms.json` of pinhole cameras; files: the photo of each, relative to it."""
    frames = []
    for camera, file in zip(cameras, files, strict=True):
        matrix = np.linalg.inv(camera.world_to_camera) @ OPENGL_TO_OPENCV
        lens = {"fl_x": camera.fx, "fl_y": camera.fy, "cx": camera.cx, "cy": camera.cy}
        size = {"w": camera.width, "h": camera.height}
        frames.append({"file_path": file, **size, **lens, "transform_matrix": matrix.tolist()})
    return {"camera_model": "OPENCV", "frames": frames}


def _pose(frame: dict[str, Any], path: Path) -> Pose:
    where = f"{path} for {frame['file_path']}"
    try:
        matrix = np.array(frame["transform_matrix"], np.float64)
    except (KeyError, ValueError, TypeError) as error:
        raise InputError(f"{where} has no transform_matrix of numbers; a 4x4 matrix is expected.") from error
    if matrix.shape != (4, 4):
        raise InputError(f"{where} has a transform_matrix of shape {matrix.shape}; a 4x4 matrix is expected.")
    with np.errstate(invalid="ignore"):  # of an infinite number, which is refused next
        matrix = matrix @ OPENGL_TO_OPENCV
    return rigid_inverse(matrix, where)


def _document(path: Path) -> dict[str, Any]:
    try:
        document = read_json(read_text(path))
    except ValueError as error:
        raise InputError(f"{path} is not valid JSON ({error}).") from error
    frames = document.get("frames") if isinstance(document, dict) else None
    if not isinstance(frames, list) or not all(isinstance(f, dict) and "file_path" in f for f in frames):
        raise InputError(
            f"{path} lacks a list `frames` whose items have a `file_path`; nerfstudio's layout is expected."
        )
    if not frames:
        raise InputError(f"{path} lists no frame; at least one photo is needed.")
    for number, frame in enumerate(frames):
        for key in ("file_path", _DEPTH[0], _DEPTH_OF_NGP[0], "mask_path"):
            value = frame.get(key)
            if not (isinstance(value, str) and value) and (key == "file_path" or value not in (None, "")):
                raise InputError(f"{path} has `{key}` {value!r} in frame {number}; the name of a file is expected.")
    return document


def _photo(photo: Path) -> Path | None:
    """The photo itself, or with the ending that the list leaves out."""
    endings = ("",) if photo.suffix else ("", *_ENDINGS)
    return next((file for end in endings if (file := photo.with_name(photo.name + end)).is_file()), None)


def _listed(root: Path, name: str | None, path: Path) -> Path | None:
    if not name:
        return None
    file = place_of(root, name)
    if not file.is_file():
        raise InputError(f"{file}, which {path.name} lists, does not exist; put it there or drop the entry.")
    return file


def _lens(values: dict[str, Any], photo: Path, path: Path) -> Lens:
    bent = values.get("is_fisheye") is True  # as instant-ngp calls it, whose files name no model
    model = str(values.get("camera_model", "OPENCV_FISHEYE" if bent else "OPENCV")).upper()
    fisheye = model == "OPENCV_FISHEYE"
    if not fisheye and model not in _PERSPECTIVE:
        raise InputError(f"{path} has cameras of model {model}; OPENCV, PINHOLE or OPENCV_FISHEYE is expected.")
    if bent and not fisheye:
        raise InputError(f"{path} has `is_fisheye` true and the camera_model {model}; take away the one that is wrong.")

    def number(key: str) -> float:
        return _number(values[key], key, path) if key in values else 0.0

    def focal(side: int, key: str) -> float:
        angle = number(key)
        if not 0 < angle < math.pi:  # whose tangent, in degrees say, may be that of another lens
            raise InputError(f"{path} has `{key}` {angle:g}; an angle in radians is expected, above 0 and below pi.")
        return 0.5 * side / math.tan(0.5 * angle)

    width, height = int(number("w")), int(number("h"))
    if not (width and height):
        width, height = header_size(photo)
    if "fl_x" in values:
        fx = number("fl_x")
        fy = number("fl_y") if "fl_y" in values else fx
    elif "camera_angle_x" in values:
        fx = fy = focal(width, "camera_angle_x")
        if "camera_angle_y" in values:
            fy = focal(height, "camera_angle_y")
    else:
        raise InputError(f"{path} has no intrinsics; give fl_x, fl_y, cx, cy, w and h in pixels.")
    cx = number("cx") if "cx" in values else width / 2
    cy = number("cy") if "cy" in values else height / 2
    if not fisheye and number("k4"):
        raise InputError(
            f"{path} has `k4`, which is read of a fisheye only; undistort the photos first, or set it to 0."
        )
    keys = ("k1", "k2", "k3", "k4") if fisheye else ("k1", "k2", "p1", "p2", "k3")
    return check_lens(Lens(width, height, fx, fy, cx, cy, tuple(number(k) for k in keys), fisheye), str(path))


def _number(value: Any, key: str, path: Path) -> float:
    try:
        number = float(value)
    except (TypeError, ValueError) as error:
        raise InputError(f"{path} has `{key}` {value!r}; a number is expected.") from error
    if not math.isfinite(number):
        raise InputError(f"{path} has `{key}` {number}; a finite number is expected.")
    return number


def _depth_scale(document: dict[str, Any], unit: str, path: Path) -> float:
    if unit not in document and unit == _DEPTH_OF_NGP[1]:
        raise InputError(
            f"{path} has `{_DEPTH_OF_NGP[0]}` and no `{unit}`; world units per unit of the depth files are expected."
        )
    scale = _number(document.get(unit, 1e-3), unit, path)
    if scale <= 0:
        raise InputError(
            f"{path} has `{unit}` {scale:g}; world units per unit of the depth files are expected, above 0."
        )
    return scale
