"""Rooms of Replica as renderings along a path, in the form in which iMAP and NICE-SLAM use and share them."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ss_flow.errors import InputError
from ss_flow.tasks.artifacts import Float64
from ss_flow.tasks.capture.lens import Lens
from ss_flow.tasks.capture.names import by_stem
from ss_flow.tasks.capture.scene_files import (
    SceneFiles,
    check_lens,
    files_in,
    is_number,
    read_json,
    read_text,
    rigid_inverse,
)

_LENS = {"w": 1200, "h": 680, "fx": 600.0, "fy": 600.0, "cx": 599.5, "cy": 339.5, "scale": 6553.5}
"""Of all these renderings; `scale` is units of depth a metre."""


def is_replica(root: Path) -> bool:
    """Whether a folder holds such a room."""
    return (root / "traj.txt").is_file() and (root / "results").is_dir()


def open_replica(root: Path) -> SceneFiles:
    """A room: `results/frame000000.jpg` and `results/depth000000.png` on, and `traj.txt`, whose line n is the pose of
    the n-th of them, 16 numbers, camera-to-world.

    Intrinsics, with integer pixel centres, and the depth's unit stand in `cam_params.json` in the folder or above it;
    without that file they are those of all rooms that were shared. Half a pixel is added to cx and cy (spec 3.0).
    Raises InputError when a file is missing or makes no sense.
    """
    files = by_stem(files_in(root / "results"))
    names = [stem for stem in files if stem.startswith("frame")]
    depths = [files.get("depth" + name.removeprefix("frame")) for name in names]
    poses = _poses(root / "traj.txt")
    if not names or len(names) != len(poses):
        raise InputError(
            f"{root / 'traj.txt'} holds {len(poses)} poses, and {root / 'results'} {len(names)} photos called "
            "frame000000.jpg and on; each photo needs its pose."
        )
    if None in depths:
        raise InputError(f"{root / 'results'} lacks the depth map of {files[names[depths.index(None)]].name}.")
    lens, scale = _camera(root)
    return SceneFiles(
        kind="replica",
        root=root,
        names=tuple(names),
        photos=tuple(files[name] for name in names),
        depths=tuple(depth for depth in depths if depth is not None),
        depth_scale=1 / scale,
        lenses=(lens,) * len(names),
        poses=tuple(
            rigid_inverse(pose, f"{root / 'traj.txt'} for {name}") for name, pose in zip(names, poses, strict=True)
        ),
        metric=True,
    )


def _poses(path: Path) -> Float64:
    """[F, 4, 4] camera to world."""
    try:
        return np.array([float(word) for word in read_text(path).split()]).reshape(-1, 4, 4)
    except ValueError as error:
        raise InputError(f"{path} does not hold 16 numbers for each photo, a 4x4 matrix ({error}).") from error


def _camera(root: Path) -> tuple[Lens, float]:
    path = next((p for p in (root / "cam_params.json", root.parent / "cam_params.json") if p.is_file()), None)
    document = {"camera": _LENS} if path is None else read_json(path)
    camera = document.get("camera") if isinstance(document, dict) else None
    values = camera if isinstance(camera, dict) else {}
    lacking = [key for key in _LENS if not is_number(values.get(key))]
    if lacking or not values["scale"] > 0:
        raise InputError(
            f"{path} has no `camera` with a number `{(*lacking, 'scale')[0]}`; w, h, fx, fy, cx, cy in pixels and the "
            "depth's units a metre are expected."
        )
    fx, fy, cx, cy = (float(values[key]) for key in ("fx", "fy", "cx", "cy"))
    lens = Lens(int(values["w"]), int(values["h"]), fx, fy, cx + 0.5, cy + 0.5)
    return check_lens(lens, str(path)), float(values["scale"])
