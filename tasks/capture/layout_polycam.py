"""Polycam's raw data: photos, poses and LiDAR depth of an iPhone or iPad, as the app exports them in developer mode."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ss_flow.errors import InputError
from ss_flow.tasks.capture.lens import Lens
from ss_flow.tasks.capture.names import by_stem, natural_key
from ss_flow.tasks.capture.photo_files import header_size
from ss_flow.tasks.capture.scene_files import (
    OPENGL_TO_OPENCV,
    Pose,
    SceneFiles,
    check_lens,
    depth_maps,
    files_in,
    is_number,
    read_json,
    rigid_inverse,
)
from ss_flow.tasks.capture.upright import upright

_JSON = frozenset({".json"})


def is_polycam(root: Path) -> bool:
    """Whether a folder, or its `keyframes/`, holds cameras and images as Polycam exports them."""
    return _keyframes(root) is not None


def _keyframes(root: Path) -> Path | None:
    places = (root / "keyframes", root)
    return next((p for p in places if (p / "images").is_dir() and files_in(p / "cameras", _JSON)), None)


def open_polycam(root: Path) -> SceneFiles:
    """Polycam's raw data: `keyframes/` with cameras, images and, of a device with LiDAR, depth and confidence.

    Where the app has optimised the poses, `corrected_cameras/` and `corrected_images/`, whose distortion is taken out,
    are read in place of `cameras/` and `images/`. Poses are camera-to-world in ARKit's world, with y up, of cameras
    that look along -z; depth counts millimetres, and where its confidence is lowest, it counts as unknown. A view that
    lacks its camera, photo or depth is left out. Where a camera has no width and height, as corrected ones of newer
    versions, they are its photo's. Photos are turned upright.
    Raises InputError when a file makes no sense, or no view is whole.
    """
    keyframes = _keyframes(root)
    assert keyframes is not None
    prefix = "corrected_" if all((keyframes / f"corrected_{name}").is_dir() for name in ("cameras", "images")) else ""
    photos = by_stem(files_in(keyframes / f"{prefix}images"))
    cameras = by_stem(files_in(keyframes / f"{prefix}cameras", _JSON))
    depths = depth_maps(keyframes / "depth")
    confidences = by_stem(files_in(keyframes / "confidence"))
    taken = by_stem(files_in(keyframes / "cameras", _JSON)) | cameras
    names = sorted(taken, key=lambda name: (natural_key(name), name))
    whole = [name for name in names if name in photos and name in cameras and (name in depths or not depths)]
    if not whole:
        raise InputError(
            f"{keyframes} holds no view with a camera in {prefix}cameras/ and a photo in {prefix}images/"
            f"{' and a depth map in depth/' if depths else ''}, all of one name; export the raw data again."
        )
    used = set(whole)
    read = [_camera(cameras[name], photos[name]) for name in whole]
    lenses, poses = upright([lens for lens, _ in read], [pose for _, pose in read])
    return SceneFiles(
        kind="polycam",
        root=root,
        names=tuple(whole),
        photos=tuple(photos[name] for name in whole),
        black_borders=bool(prefix),
        depths=tuple(depths[name] for name in whole) if depths else None,
        confidences=tuple(confidences.get(name) for name in whole) if depths else (),
        lenses=lenses,
        poses=poses,
        metric=True,
        skipped=tuple(name for name in names if name not in used),
        all_names=tuple(names),
    )


def _camera(path: Path, photo: Path) -> tuple[Lens, Pose]:
    values = read_json(path)
    if isinstance(values, dict) and not {"width", "height"} & values.keys():
        values["width"], values["height"] = header_size(photo)
    entries = [[f"t_{row}{column}" for column in range(4)] for row in range(3)]
    needed = ["width", "height", "fx", "fy", "cx", "cy", *(key for row in entries for key in row)]
    lacking = [key for key in needed if not isinstance(values, dict) or not is_number(values.get(key))]
    if lacking:
        raise InputError(f"{path} has no number `{lacking[0]}`; a camera as Polycam exports it is expected.")
    camera_to_world = np.array([[values[key] for key in row] for row in entries] + [[0, 0, 0, 1]], np.float64)
    fx, fy, cx, cy = (float(values[key]) for key in needed[2:6])
    lens = check_lens(Lens(int(values["width"]), int(values["height"]), fx, fy, cx, cy), str(path))
    return lens, rigid_inverse(camera_to_world @ OPENGL_TO_OPENCV, str(path))
