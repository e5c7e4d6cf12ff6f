"""ScanNet: its export folder, and its `.sens` recordings."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ss_flow.errors import InputError
from ss_flow.tasks.artifacts import Float64
from ss_flow.tasks.capture.lens import Lens
from ss_flow.tasks.capture.names import by_stem
from ss_flow.tasks.capture.scene_files import (
    NO_POSE,
    Pose,
    SceneFiles,
    check_lens,
    files_in,
    read_matrix,
    rigid_inverse,
)


def is_scannet(root: Path) -> bool:
    """Whether a folder has ScanNet's export layout."""
    return (root / "color").is_dir() and ((root / "pose").is_dir() or (root / "intrinsic").is_dir())


def open_scannet(root: Path) -> SceneFiles:
    """A ScanNet export: `color/ intrinsic/`, and `pose/` and `depth/` or one of them.

    Poses are camera-to-world in metres; depth is in millimetres. The intrinsics assume integer pixel centres, hence
    half a pixel is added to cx and cy (spec 3.0). A pose that holds an infinity or NaN marks a view whose tracking was
    lost; such views are skipped (spec 2.1).
    Raises InputError when a view lacks its pose or depth, or a file makes no sense.
    """
    photos = list(by_stem(files_in(root / "color")).items())
    if not photos:
        raise InputError(f"{root / 'color'} holds no photo; ScanNet's colour frames (0.jpg, 1.jpg, ...) are expected.")
    lens = _intrinsics(_intrinsics_file(root, "color"))
    depths = by_stem(files_in(root / "depth")) if (root / "depth").is_dir() else None
    unposed = depths is not None and not (root / "pose").is_dir()
    poses: list[Pose] = []
    kept: list[tuple[str, Path]] = []
    skipped = []
    for stem, photo in photos:
        pose = NO_POSE if unposed else _read_pose(root, stem)
        if pose is None:
            skipped.append(stem)
            continue
        if depths is not None and stem not in depths:
            raise InputError(f"{root / 'depth'} lacks the depth map of {photo.name}; {stem}.png is expected there.")
        kept.append((stem, photo))
        poses.append(pose)
    if not kept:
        raise InputError(f"{root / 'pose'} marks every view as lost; no view has a pose to work with.")
    return SceneFiles(
        kind="scannet",
        root=root,
        names=tuple(stem for stem, _ in kept),
        photos=tuple(photo for _, photo in kept),
        depths=None if depths is None else tuple(depths[stem] for stem, _ in kept),
        depth_scale=1e-3,
        depth_lens=_depth_lens(root) if depths else None,
        lenses=(lens,) * len(kept),
        poses=None if unposed else tuple(poses),
        metric=True,
        skipped=tuple(skipped),
        why_skipped="without a pose",
        all_names=tuple(stem for stem, _ in photos),
    )


def _read_pose(root: Path, stem: str) -> Pose | None:
    pose_file = root / "pose" / f"{stem}.txt"
    if not pose_file.is_file():
        raise InputError(f"{pose_file} is missing; every photo in {root / 'color'} needs its pose.")
    return _pose(read_matrix(pose_file), str(pose_file))


def _pose(camera_to_world: Float64, where: str) -> Pose | None:
    if not np.isfinite(camera_to_world[:3]).all():
        return None
    return rigid_inverse(camera_to_world, where)


def _intrinsics(path: Path) -> Lens:
    return _lens(read_matrix(path), str(path))


def _lens(matrix: Float64, where: str, width: int = 0, height: int = 0) -> Lens:
    fx, fy, cx, cy = (float(x) for x in (matrix[0, 0], matrix[1, 1], matrix[0, 2] + 0.5, matrix[1, 2] + 0.5))
    return check_lens(Lens(width, height, fx, fy, cx, cy), where)


def _intrinsics_file(root: Path, sensor: str) -> Path:
    """Where the intrinsics of a sensor lie, "color" or "depth"; ScanNet's sample of 25,000 frames has them in no folder
    of their own."""
    of_sample = root / f"intrinsics_{sensor}.txt"
    return of_sample if of_sample.is_file() else root / "intrinsic" / f"intrinsic_{sensor}.txt"


def _depth_lens(root: Path) -> Lens | None:
    path = _intrinsics_file(root, "depth")
    if not path.is_file():
        return None
    extrinsic = root / "intrinsic" / "extrinsic_depth.txt"
    if extrinsic.is_file():
        _check_shared_center(read_matrix(extrinsic), str(extrinsic))
    return _intrinsics(path)


def _check_shared_center(extrinsic: Float64, where: str) -> None:
    if not np.allclose(extrinsic, np.eye(4), atol=1e-3):
        raise InputError(
            f"{where} sets the depth camera apart from the colour camera; depth that is registered to the colour "
            "camera's centre (an identity matrix) is expected."
        )


@dataclass(frozen=True)
class SensIndex:
    """Where the frames of a `.sens` file lie."""

    color_lens: Lens
    depth_lens: Lens
    depth_compression: int
    """0 = raw uint16, 1 = zlib."""
    depth_scale: float
    """Metres per unit."""
    camera_to_world: Float64
    """[F, 4, 4]."""
    offsets: tuple[tuple[int, int, int, int], ...]
    """[F] offset and length of the colour data, offset and length of the depth data, in bytes."""


def read_sens_index(path: Path) -> SensIndex:
    """Read the header of a `.sens` file (version 4) and where each frame lies, without its images.

    Raises InputError when the file is damaged or of another version.
    """
    size = path.stat().st_size
    try:
        with path.open("rb") as file:

            def read(form: str) -> tuple:
                return struct.unpack("<" + form, file.read(struct.calcsize("<" + form)))

            (version,) = read("I")
            if version != 4:
                raise InputError(f"{path} is a .sens file of version {version}, or none at all; version 4 is expected.")
            file.seek(read("Q")[0], 1)
            matrices = [np.array(read("16f"), np.float64).reshape(4, 4) for _ in range(4)]
            color_kind, depth_kind, cw, ch, dw, dh, shift, count = read("iiIIIIfQ")
            poses, offsets = [], []
            for _ in range(count):
                *pose, _, _, color_bytes, depth_bytes = read("16fQQQQ")
                start = file.tell()
                poses.append(pose)
                offsets.append((start, color_bytes, start + color_bytes, depth_bytes))
                file.seek(color_bytes + depth_bytes, 1)
    except (struct.error, OverflowError, OSError) as error:
        raise InputError(f"{path} ends too early or is no .sens file; copy it again.") from error
    if offsets and sum(offsets[-1][2:]) > size:
        raise InputError(f"{path} ends too early or is no .sens file; copy it again.")
    if color_kind not in (1, 2) or depth_kind not in (0, 1):
        raise InputError(
            f"{path} packs its images in a way that is not known (colour {color_kind}, depth {depth_kind}); JPEG or "
            "PNG colour and raw or zlib depth are expected."
        )
    if shift <= 0:
        raise InputError(f"{path} states {shift:g} depth units per metre; a positive number (1000) is expected.")
    _check_shared_center(matrices[3], str(path))
    return SensIndex(
        color_lens=_lens(matrices[0], str(path), cw, ch),
        depth_lens=_lens(matrices[2], str(path), dw, dh),
        depth_compression=depth_kind,
        depth_scale=1.0 / shift,
        camera_to_world=np.array(poses, np.float64).reshape(-1, 4, 4),
        offsets=tuple(offsets),
    )


def open_sens(path: Path) -> SceneFiles:
    """A ScanNet `.sens` recording; views are named `frame-000000` and on, views whose tracking was lost are skipped.

    Raises InputError when the file is damaged or holds no usable view.
    """
    index = read_sens_index(path)
    names = tuple(f"frame-{i:06d}" for i in range(len(index.camera_to_world)))
    poses, entries, skipped = [], [], []
    for i, matrix in enumerate(index.camera_to_world):
        pose = _pose(matrix, f"{path}, frame {i}")
        if pose is None:
            skipped.append(names[i])
        else:
            poses.append(pose)
            entries.append(i)
    if not entries:
        raise InputError(f"{path} holds no view with a pose; a recording with at least one is needed.")
    return SceneFiles(
        kind="sens",
        root=path.parent,
        names=tuple(names[i] for i in entries),
        recording=path,
        entries=tuple(entries),
        depth_scale=index.depth_scale,
        depth_lens=index.depth_lens,
        lenses=(index.color_lens,) * len(entries),
        poses=tuple(poses),
        metric=True,
        skipped=tuple(skipped),
        all_names=names,
    )
