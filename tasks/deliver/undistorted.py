"""The frames and cameras that a run worked with, as a capture that other tools (and we) read."""

from __future__ import annotations

import json
import os
import struct
from collections.abc import Sequence
from pathlib import Path

from ss_flow.tasks.artifacts import Cameras, Frame, LabelMap
from ss_flow.tasks.capture.layout_nerfstudio import transforms_document
from ss_flow.tasks.geometry.cameras import cameras_by_view
from ss_flow.tasks.geometry.images import encode_png, suffix_of

_PINHOLE = 1
"""COLMAP's number of the camera model."""
_NONE = struct.pack("<Q", 0)
"""A list without entries, in COLMAP's binary files."""


def write_undistorted(folder: Path, frames: Sequence[Frame], cameras: Cameras, maps: Sequence[LabelMap]) -> None:
    """Write a COLMAP workspace of pinhole cameras, and what belongs to its photos.

    `images/` holds the frames' photos as they are, `sparse/0/` the cameras in binary form, with the sparse points that
    came with the capture; `valid/` is 0 where a pixel is to be ignored, for the frames that have such pixels; `masks/`
    holds the instance ids of `maps` (uint16), in the pixels of `images/`.
    """
    for name in ("images", "sparse/0", "masks"):
        (folder / name).mkdir(parents=True)
    files = []
    for frame, ids in zip(frames, maps, strict=True):
        files.append(f"{frame.name}.{suffix_of(frame)}")
        (folder / "images" / files[-1]).write_bytes(frame.encoded.tobytes())
        (folder / "masks" / f"{frame.name}.png").write_bytes(encode_png(ids.ids).tobytes())
        if frame.valid.size:
            (folder / "valid").mkdir(exist_ok=True)
            (folder / "valid" / f"{frame.name}.png").write_bytes(frame.valid.tobytes())
    _write_model(folder / "sparse" / "0", files, cameras)


def write_nerfstudio(folder: Path, frames: Sequence[Frame], cameras: Cameras) -> None:
    """Write `transforms.json` of pinhole cameras, the photos in `images/`, and where pixels are to be ignored `valid/`.

    The masks of `valid/` are 0 there, as nerfstudio takes them.
    """
    (folder / "images").mkdir(parents=True)
    files = [f"images/{frame.name}.{suffix_of(frame)}" for frame in frames]
    document = transforms_document(cameras_by_view(cameras), files)
    for frame, file, entry in zip(frames, files, document["frames"], strict=True):
        (folder / file).write_bytes(frame.encoded.tobytes())
        if frame.valid.size:
            (folder / "valid").mkdir(exist_ok=True)
            entry["mask_path"] = f"valid/{frame.name}.png"
            (folder / entry["mask_path"]).write_bytes(frame.valid.tobytes())
    (folder / "transforms.json").write_text(json.dumps(document, indent=1), encoding="utf-8")


def _write_model(folder: Path, files: Sequence[str], cameras: Cameras) -> None:
    """In binary form: in that of text, COLMAP ends a photo's name at its first blank."""
    from scipy.spatial.transform import Rotation

    lenses: dict[bytes, int] = {}
    images = []
    quaternions = Rotation.from_matrix(cameras.world_to_camera[:, :3, :3]).as_quat()[:, [3, 0, 1, 2]]
    shifts = cameras.world_to_camera[:, :3, 3]
    for k, file in enumerate(files):
        lens = struct.pack("<iQQ4d", _PINHOLE, *cameras.sizes[k].tolist(), *cameras.intrinsics[k].tolist())
        number = lenses.setdefault(lens, len(lenses) + 1)
        placed = struct.pack("<I7dI", k + 1, *quaternions[k], *shifts[k], number)
        images.append(placed + os.fsencode(file) + b"\0" + _NONE)
    grey = struct.pack("<3Bd", 128, 128, 128, 0.0) + _NONE  # neither colours nor errors nor who sees a point are known
    points = [struct.pack("<Q3d", i + 1, *point) + grey for i, point in enumerate(cameras.sparse_points.tolist())]
    for name, entries in (
        ("cameras", [struct.pack("<I", number) + lens for lens, number in lenses.items()]),
        ("images", images),
        ("points3D", points),
    ):
        (folder / f"{name}.bin").write_bytes(struct.pack("<Q", len(entries)) + b"".join(entries))
