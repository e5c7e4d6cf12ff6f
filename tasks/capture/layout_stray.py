"""Recordings of the app Stray Scanner: a video, LiDAR depth and a pose for each of its frames."""

from __future__ import annotations

import csv
from collections import Counter
from pathlib import Path

import numpy as np

from ss_flow.errors import InputError
from ss_flow.tasks.capture.layout_colmap import pose_matrix
from ss_flow.tasks.capture.lens import Lens
from ss_flow.tasks.capture.names import by_stem
from ss_flow.tasks.capture.scene_files import (
    Pose,
    SceneFiles,
    check_lens,
    depth_maps,
    files_in,
    open_video,
    read_text,
    rigid_inverse,
)
from ss_flow.tasks.capture.upright import upright

_PLACE, _TURN, _LENS = ("x", "y", "z"), ("qw", "qx", "qy", "qz"), ("fx", "fy", "cx", "cy")


def is_stray(root: Path) -> bool:
    """Whether a folder holds a recording of Stray Scanner."""
    return (root / "rgb.mp4").is_file() and (root / "odometry.csv").is_file()


def open_stray(root: Path) -> SceneFiles:
    """A recording of Stray Scanner: `rgb.mp4`, `odometry.csv`, `camera_matrix.csv`, `depth/` and `confidence/`.

    Row n of `odometry.csv` is frame n of the video; its number names the frame's depth, in millimetres, and the
    confidence in that: 0, 1 or 2, where depth of 0 counts as unknown. Poses are camera-to-world in a world with y up,
    of cameras that look along z. Rows may hold the lens, otherwise one holds for all. Frames without depth, and rows
    beyond the video's end, are left out. Photos are turned upright; views are named `frame-000000` and on.
    Raises InputError when a file is missing or makes no sense, or no frame is whole.
    """
    track = root / "odometry.csv"
    rows = _rows(track)
    size, length = _video(root / "rgb.mp4")
    common = None if all(key in rows[0] for key in _LENS) else _camera_matrix(root / "camera_matrix.csv", size)
    depths, confidences = depth_maps(root / "depth"), by_stem(files_in(root / "confidence"))
    stems = _stems(rows, track)
    names = [f"frame-{stem}" for stem in stems]
    kept = [i for i, stem in enumerate(stems) if i < length and (stem in depths or not depths)]
    if not kept:
        raise InputError(f"{root / 'depth'} holds no depth map of a frame that {track.name} lists; 000000.png is one.")
    used = set(kept)
    lenses, poses = upright(
        [common or _lens(rows[i], size, track) for i in kept],
        [_pose(rows[i], track) for i in kept],
    )
    return SceneFiles(
        kind="stray",
        root=root,
        names=tuple(names[i] for i in kept),
        recording=root / "rgb.mp4",
        entries=tuple(kept),
        depths=tuple(depths[stems[i]] for i in kept) if depths else None,
        confidences=tuple(confidences.get(stems[i]) for i in kept) if depths else (),
        lenses=lenses,
        poses=poses,
        metric=True,
        skipped=tuple(name for i, name in enumerate(names) if i not in used),
        all_names=tuple(names),
    )


def _rows(path: Path) -> list[dict[str, str]]:
    header, *lines = [*csv.reader(read_text(path).splitlines(), skipinitialspace=True)] or [[]]
    columns = [name.strip() for name in header]
    lacking = [key for key in ("frame", *_PLACE, *_TURN) if key not in columns]
    if lacking:
        raise InputError(f"{path} has no column `{lacking[0]}` in its first line; {_EXPECTED}.")
    # Columns of the lens may be there and empty.
    rows = [{key: word for key, word in zip(columns, line, strict=False) if word.strip()} for line in lines if line]
    if not rows:
        raise InputError(f"{path} lists no frame; {_EXPECTED}.")
    return rows


_EXPECTED = "timestamp, frame, x, y, z, qx, qy, qz, qw are expected, as Stray Scanner writes them"


def _number(row: dict[str, str], key: str, path: Path) -> float:
    try:
        return float(row[key])
    except (KeyError, ValueError) as error:
        raise InputError(f"{path} has a row without a number for `{key}`; {_EXPECTED}.") from error


def _stems(rows: list[dict[str, str]], path: Path) -> list[str]:
    """What the files of each row's frame are called."""
    numbers = [_number(row, "frame", path) for row in rows]
    number, times = Counter(numbers).most_common(1)[0]
    if times > 1:
        raise InputError(f"{path} lists frame {number:g} {times} times; each row is of a frame of its own.")
    if odd := [number for number in numbers if number % 1]:  # as it is of what is not finite
        raise InputError(f"{path} has the frame {odd[0]:g}; a whole number is expected.")
    return [f"{int(number):06d}" for number in numbers]


def _pose(row: dict[str, str], path: Path) -> Pose:
    where = f"{path} for frame {row['frame']}"
    turn, place = ([_number(row, key, path) for key in keys] for keys in (_TURN, _PLACE))
    return rigid_inverse(pose_matrix(turn, place, where), where)


def _lens(row: dict[str, str], size: tuple[int, int], path: Path) -> Lens:
    fx, fy, cx, cy = (_number(row, key, path) for key in _LENS)
    return check_lens(Lens(*size, fx, fy, cx, cy), str(path))


def _camera_matrix(path: Path, size: tuple[int, int]) -> Lens:
    try:
        matrix = np.array([float(word) for word in read_text(path).replace(",", " ").split()]).reshape(3, 3)
    except ValueError as error:
        raise InputError(f"{path} does not hold a 3x3 matrix of numbers.") from error
    fx, fy, cx, cy = (float(matrix[place]) for place in ((0, 0), (1, 1), (0, 2), (1, 2)))
    return check_lens(Lens(*size, fx, fy, cx, cy), str(path))


def _video(path: Path) -> tuple[tuple[int, int], int]:
    """Width and height of the stored frames, and how many there are."""
    import cv2

    reader = open_video(path)
    reader.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)  # the lens is that of the frames as they are stored
    found = [int(reader.get(what)) for what in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT)]
    length = int(reader.get(cv2.CAP_PROP_FRAME_COUNT))
    reader.release()
    if min(*found, length) <= 0:
        raise InputError(f"{path} cannot be opened as a video: it is cut short or damaged; copy the recording again.")
    return (found[0], found[1]), length
