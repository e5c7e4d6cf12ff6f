"""The frames and cameras that a run worked with, as a capture that other tools (and we) read."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

from ss_flow.tasks.artifacts import Cameras, Frame, LabelMap
from ss_flow.tasks.capture.layout_nerfstudio import transforms_document
from ss_flow.tasks.geometry.cameras import cameras_by_view
from ss_flow.tasks.geometry.images import encode_png, suffix_of


def write_undistorted(folder: Path, frames: Sequence[Frame], cameras: Cameras, maps: Sequence[LabelMap]) -> None:
    """Write a COLMAP workspace of pinhole cameras, and what belongs to its photos.

    `images/` holds the frames' photos as they are, `sparse/0/` the cameras in text form, with the sparse points that
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
    from scipy.spatial.transform import Rotation

    lenses: dict[str, int] = {}
    images = []
    quaternions = Rotation.from_matrix(cameras.world_to_camera[:, :3, :3]).as_quat()[:, [3, 0, 1, 2]]
    shifts = cameras.world_to_camera[:, :3, 3]
    for k, file in enumerate(files):
        lens = _words("PINHOLE", *cameras.sizes[k].tolist(), *cameras.intrinsics[k].tolist())
        number = lenses.setdefault(lens, len(lenses) + 1)
        images.append(_words(k + 1, *quaternions[k].tolist(), *shifts[k].tolist(), number, file) + "\n")
    points = [_words(i + 1, *point, 128, 128, 128, 0) for i, point in enumerate(cameras.sparse_points.tolist())]
    for name, heading, lines in (
        ("cameras", "CAMERA_ID MODEL WIDTH HEIGHT FX FY CX CY", [_words(n, lens) for lens, n in lenses.items()]),
        ("images", "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, then an empty line", images),
        ("points3D", "POINT3D_ID X Y Z R G B ERROR; colours and errors are not known", points),
    ):
        text = "".join(f"{line}\n" for line in (f"# {heading}", *lines))
        (folder / f"{name}.txt").write_text(text, encoding="utf-8")


def _words(*values: object) -> str:
    return " ".join(map(str, values))
