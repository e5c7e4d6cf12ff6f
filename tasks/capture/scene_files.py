"""What a capture consists of on disk, whatever its layout."""

from __future__ import annotations

import math
import os
from codecs import BOM_UTF16_BE, BOM_UTF16_LE
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from ss_flow.cache import plain_json
from ss_flow.errors import InputError
from ss_flow.tasks.artifacts import Float64
from ss_flow.tasks.capture.lens import Lens
from ss_flow.tasks.capture.names import by_stem, capture_name, natural_key

HEIC_SUFFIXES = frozenset({".heic", ".heif"})
PNM_SUFFIXES = frozenset({".pgm", ".ppm", ".pnm"})
PHOTO_SUFFIXES = HEIC_SUFFIXES | PNM_SUFFIXES | {".jpg", ".jpeg", ".jfif", ".png", ".bmp", ".tif", ".tiff", ".webp"}
UNREAD_SUFFIXES = frozenset(
    {".arw", ".avif", ".cr2", ".cr3", ".dng", ".gif", ".jp2", ".jxl", ".nef", ".orf", ".pef", ".raf", ".raw"}
    | {".rw2", ".srw"}
)
"""Photos of cameras and phones that are not read."""
VIDEO_SUFFIXES = frozenset(
    {".mp4", ".mov", ".avi", ".mkv", ".webm", ".m4v", ".mpg", ".mpeg", ".mts", ".m2ts", ".ts", ".3gp"}
)

Pose = tuple[float, ...]
"""World-to-camera, 16 numbers row by row (plain numbers, so that a step's key can hold it)."""
NO_POSE: Pose = tuple(np.eye(4).ravel().tolist())
"""In the place of one that is yet to be found."""
OPENGL_TO_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])
"""From behind, takes a camera-to-world matrix from OpenGL's axes of the camera to OpenCV's."""
Point = tuple[float, float]


@dataclass(frozen=True)
class Hint:
    """The points that were clicked for one object in one view, in pixels of the input photo."""

    view: str
    label: int
    """The object's place among `Hints.objects`, from 1 on."""
    inside: tuple[Point, ...]
    """Points on the object; one at least."""
    outside: tuple[Point, ...]
    """Points that are not."""


@dataclass(frozen=True)
class Hints:
    """All that was clicked in a scene."""

    path: Path = field(metadata={"key": False})
    """The file, to be named in messages."""
    objects: tuple[str, ...]
    """The objects' names, in the order in which the file first gives them."""
    hints: tuple[Hint, ...]


@dataclass(frozen=True)
class SceneFiles:
    """The files of a capture, in the order of the views; `tuple[... | None, ...]` fields have one entry a view."""

    kind: str
    """"photos", "video", "colmap", "nerfstudio", "scannet", "sens", "tum", "replica", "polycam" or
    "stray"."""
    root: Path
    opened: Path | None = None
    """What the user named: the folder, or the video or JSON file in it."""
    names: tuple[str, ...] = ()
    """Name of each view; unique. Empty for a video, whose frames are chosen later."""
    photos: tuple[Path, ...] = ()
    """The photos; empty where they are in a recording."""
    recording: Path | None = None
    """A video, one whose frames have poses, or a .sens file."""
    entries: tuple[int, ...] = ()
    """Which frame of the recording each view is; empty for a video, whose frames are chosen later."""
    valid: tuple[Path | None, ...] = ()
    """One-channel images, 0 where a pixel is to be ignored."""
    black_borders: bool = False
    """Whether black borders of the photos are to be ignored: distortion was taken out of them."""
    depths: tuple[Path, ...] | None = None
    confidences: tuple[Path | None, ...] = ()
    """One-channel images, 0 where the depth is not to be relied on; empty where there are none."""
    depth_scale: float = 0.001
    """World units per unit of the depth files."""
    depth_lens: Lens | None = None
    """The depth camera where it is not the colour camera at another resolution."""
    lenses: tuple[Lens, ...] | None = None
    poses: tuple[Pose, ...] | None = None
    metric: bool = False
    """Whether one world unit is one metre."""
    sparse: Path | None = None
    """COLMAP's points3D file."""
    ready_masks: tuple[Path, ...] | None = None
    """Instance masks that stand in for a segmenter: uint16 images of ids, 0 = none."""
    coco_masks: Path | None = None
    """The same for all views in one COCO file."""
    hints: Hints | None = None
    """Points clicked on objects, at which the segmenter is to be prompted."""
    corrections: Hints | None = None
    """Points clicked on what Split is to join or to part."""
    given_scene: Path | None = None
    """A PLY file of Gaussians that were trained elsewhere, to be labelled in the place of a reconstruction."""
    ground_truth: tuple[Path | None, ...] | None = None
    """Annotated instances: uint16 images of ids, 0 = not annotated or background."""
    zero_is_void: bool = True
    """Whether 0 in them means "not annotated"; otherwise it is background."""
    skipped: tuple[str, ...] = ()
    """Views of the capture that are left out, for lack of a photo that can be read, a pose or a depth map."""
    why_skipped: str = "without a photo, a pose or a depth map"
    """The same of this layout, in words that follow "are left out, "."""
    remarks: tuple[str, ...] = ()
    """What is to be said of other files that a run does not read."""
    all_names: tuple[str, ...] = ()
    """Names of all views, those left out at their places among the others; empty = `names`."""

    @property
    def name(self) -> str:
        """What the capture is called."""
        return capture_name(self.place)

    @property
    def place(self) -> Path:
        """What its runs are recorded under."""
        return self.opened or self.root

    def files(self) -> Iterator[Path]:
        """Where it lies, and all files of it that a run may read; some more than once."""
        for value in vars(self).values():
            for one in value if isinstance(value, tuple) else (value,):
                place = one.path if isinstance(one, Hints) else one
                if isinstance(place, Path):
                    yield place

    @property
    def has_masks(self) -> bool:
        """Whether it brings masks that stand in for a segmenter."""
        return self.ready_masks is not None or self.coco_masks is not None

    @property
    def world_to_camera(self) -> Float64 | None:
        """[K, 4, 4], or None where the capture has no poses."""
        return None if self.poses is None else np.array(self.poses, np.float64).reshape(-1, 4, 4)

    def every(self, stride: int) -> SceneFiles:
        """Those of every `stride`-th view, from the first on, that are not left out (spec, row 1).

        Views left out count, so that ScanNet's 1:20 is frames 0, 20, 40 ... wherever tracking was lost.
        Raises InputError when none remains.
        """
        if stride < 1:
            raise InputError(f"frame stride {stride} is not possible; it must be 1 or more.")
        all_names = (self.all_names or self.names)[::stride]
        chosen = set(all_names)
        views = [i for i, name in enumerate(self.names) if name in chosen]
        if self.names and not views:
            raise InputError(
                f"{self.root} has no view that can be used among every {stride} views (capture.stride); take another "
                "stride."
            )
        skipped = tuple(name for name in self.skipped if name in chosen)
        return replace(self.pick(views), all_names=all_names, skipped=skipped)

    def pick(self, views: list[int]) -> SceneFiles:
        """Only these views, in this order."""
        per_view = (
            "names", "photos", "entries", "valid", "depths", "confidences", "lenses", "poses", "ready_masks",
            "ground_truth",
        )  # fmt: skip
        kept: dict[str, Any] = {}
        for name in per_view:
            values = getattr(self, name)
            kept[name] = tuple(values[i] for i in views) if values else values
        return replace(self, **kept)


def files_in(folder: Path, suffixes: frozenset[str] = PHOTO_SUFFIXES) -> list[Path]:
    """The files of a folder that carry one of these suffixes, naturally sorted; hidden files do not count."""
    if not folder.is_dir():
        return []
    named = [folder / entry.name for entry in os.scandir(folder) if not entry.is_dir()]
    found = [p for p in named if p.suffix.lower() in suffixes and not p.name.startswith(".")]
    return sorted(found, key=lambda p: (natural_key(p.name), p.name))


def depth_maps(folder: Path) -> dict[str, Path]:
    """The depth maps of a recording by their stems; none where the folder is missing or empty.

    Raises InputError when it holds other files only, or two of one stem.
    """
    found = by_stem(files_in(folder))
    others = [] if found or not folder.is_dir() else sorted(e.name for e in os.scandir(folder) if e.name[0] != ".")
    if others:
        raise InputError(
            f"{folder} holds no depth map that is read, but {others[0]}, for one; PNG of 16 bits is expected: convert "
            "them, or take the folder away to do without depth."
        )
    return found


def place_of(folder: Path, name: str) -> Path:
    """Where a file lies that is listed by its name below a folder; Windows writes folders with backslashes."""
    place = folder / name
    return place if place.exists() else folder / name.replace("\\", "/")


def open_video(path: Path) -> Any:
    """OpenCV's reader of a video; whether it could be opened, it tells.

    Raises InputError when bytes of the path are no text, at which OpenCV would end the process.
    """
    import cv2

    try:
        str(path).encode()
    except UnicodeEncodeError as error:
        raise InputError(f"{path} has a name, or a folder, that is not written in UTF-8; rename it.") from error
    return cv2.VideoCapture(str(path))


def read_text(path: Path) -> str:
    """The text of a small file.

    Raises InputError when it is absent or no text.
    """
    try:
        data = path.read_bytes()
        # Editors on Windows put a mark in front, and its shell writes two bytes a letter.
        return data.decode("utf-16" if data.startswith((BOM_UTF16_LE, BOM_UTF16_BE)) else "utf-8-sig")
    except FileNotFoundError as error:
        raise InputError(f"{path} is missing; the capture needs it.") from error
    except (UnicodeDecodeError, OSError) as error:
        raise InputError(f"{path} cannot be read as text ({error}); a plain text file is expected.") from error


def read_json(path: Path) -> Any:
    """The value that a JSON file holds.

    Raises InputError when it is absent or no JSON, or names something twice in one object.
    """
    try:
        return plain_json.read_json(read_text(path), once=True)
    except ValueError as error:
        raise InputError(f"{path} is not valid JSON ({error}).") from error


def is_number(value: Any) -> bool:
    """Whether a value read from JSON is a number that may count pixels: neither NaN nor endless."""
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < 1e9


def read_matrix(path: Path) -> Float64:
    """A 4x4 matrix of numbers from a text file; they may be infinite or not numbers.

    Raises InputError when the file does not hold 16 numbers.
    """
    try:
        values = [float(word) for word in read_text(path).split()]
    except ValueError as error:
        raise InputError(f"{path} holds a word that is no number ({error}); a 4x4 matrix is expected.") from error
    if len(values) != 16:
        raise InputError(f"{path} holds {len(values)} numbers; a 4x4 matrix of 16 is expected.")
    return np.array(values).reshape(4, 4)


def rigid_inverse(camera_to_world: Float64, where: str) -> Pose:
    """World-to-camera of a camera-to-world matrix, checked.

    where: what to name in a message.
    Raises InputError when the matrix is not finite or not rigid (R^T R off the identity by more than 1e-3, a mirror
    image, or a last row other than 0 0 0 1).
    """
    checked = check_rigid(camera_to_world, where)
    inverse = np.eye(4)
    inverse[:3, :3] = checked[:3, :3].T
    inverse[:3, 3] = -checked[:3, :3].T @ checked[:3, 3]
    return tuple(inverse.ravel().tolist())


def check_rigid(matrix: Float64, where: str) -> Float64:
    """[4, 4] the rigid matrix nearest to a pose (its rotation made orthonormal to the last bit).

    Raises InputError as `rigid_inverse` does.
    """
    if matrix.shape != (4, 4):
        raise InputError(f"the pose in {where} has shape {matrix.shape}; a 4x4 matrix is expected.")
    if not np.isfinite(matrix).all():
        raise InputError(f"the pose in {where} holds NaN or infinite numbers; give a rigid 4x4 matrix of numbers.")
    rotation = matrix[:3, :3]
    if (
        np.abs(rotation.T @ rotation - np.eye(3)).max() > 1e-3
        or np.linalg.det(rotation) < 0
        or np.abs(matrix[3] - (0, 0, 0, 1)).max() > 1e-3
    ):
        raise InputError(
            f"the pose in {where} is not rigid; its upper left 3x3 block must be a rotation, without scale or "
            "mirroring, and its last row 0 0 0 1."
        )
    left, _, right = np.linalg.svd(rotation)
    rigid = np.eye(4)
    rigid[:3, :3] = left @ right
    rigid[:3, 3] = matrix[:3, 3]
    return rigid


def check_lens(lens: Lens, where: str) -> Lens:
    """The lens itself.

    Raises InputError when a focal length is not positive or a number is not finite.
    """
    if not all(map(math.isfinite, (lens.fx, lens.fy, lens.cx, lens.cy, *lens.distortion))):
        raise InputError(f"the intrinsics in {where} hold NaN or infinite numbers; fx fy cx cy in pixels are expected.")
    if lens.fx <= 0 or lens.fy <= 0 or lens.width < 0 or lens.height < 0:
        raise InputError(
            f"the intrinsics in {where} have a focal length or size that is not positive (fx {lens.fx:g}, fy "
            f"{lens.fy:g}, {lens.width}x{lens.height}); pixels are expected."
        )
    return lens
