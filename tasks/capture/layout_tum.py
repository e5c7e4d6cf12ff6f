"""TUM RGB-D sequences: photos, depth maps and poses with time stamps of their own."""

from __future__ import annotations

from bisect import bisect_left
from pathlib import Path

from ss_flow.errors import InputError
from ss_flow.tasks.capture.layout_colmap import pose_matrix
from ss_flow.tasks.capture.lens import Lens
from ss_flow.tasks.capture.scene_files import SceneFiles, check_lens, read_text, rigid_inverse

MAX_TIME_APART = 0.02
"""Seconds; the value of the benchmark's own association."""


def open_tum(root: Path) -> SceneFiles:
    """A TUM RGB-D sequence: `rgb.txt`, `groundtruth.txt` and `depth.txt`; one of these two may be absent.

    Depth and poses are taken from the entry nearest in time, at most 0.02 s away; photos without are skipped. Depth
    files count 5000 to the metre and are registered to the photos. Intrinsics are four numbers, fx fy cx cy with
    integer pixel centres, in `intrinsics.txt` or `camera.txt`; without that file, the ROS default of the benchmark:
    525 525 319.5 239.5, for its photos of 640x480. Half a pixel is added to cx and cy (spec 3.0).
    Raises InputError when a file is missing or makes no sense, or no photo has a partner.
    """
    photos = _entries(root / "rgb.txt")
    depths = _entries(root / "depth.txt") if (root / "depth.txt").is_file() else None
    unposed = depths is not None and not (root / "groundtruth.txt").is_file()
    tracks = None if unposed else _entries(root / "groundtruth.txt")
    kept, skipped = [], []
    for time, words in photos:
        track, depth = (None if entries is None else _nearest(entries, time) for entries in (tracks, depths))
        if (tracks is not None and track is None) or (depths is not None and depth is None):
            skipped.append(Path(words[0]).stem)
        else:
            kept.append((words[0], track, depth))
    if not kept:
        raise InputError(
            f"{root / 'rgb.txt'} has no photo whose time lies within {MAX_TIME_APART} s of a pose and a depth map; "
            "the time stamps of rgb.txt, depth.txt and groundtruth.txt must be those of one clock."
        )
    files = tuple(root / photo for photo, _, _ in kept)
    return SceneFiles(
        kind="tum",
        root=root,
        names=tuple(p.stem for p in files),
        photos=files,
        depths=tuple(root / depth[0] for _, _, depth in kept if depth is not None) if depths is not None else None,
        depth_scale=1 / 5000,
        lenses=(_lens(root),) * len(kept),
        poses=None if unposed else tuple(_pose(t, root / "groundtruth.txt", photo) for photo, t, _ in kept if t),
        metric=True,
        skipped=tuple(skipped),
        why_skipped="without a pose or a depth map of the same time",
        all_names=tuple(Path(words[0]).stem for _, words in photos),
    )


def _entries(path: Path) -> list[tuple[float, list[str]]]:
    entries = []
    for line in read_text(path).splitlines():
        words = line.replace(",", " ").split()
        if not words or words[0].startswith("#"):
            continue
        try:
            entries.append((float(words[0]), words[1:]))
        except ValueError as error:
            raise InputError(
                f"{path} has the line {line[:60]!r}, which does not begin with a time in seconds."
            ) from error
        if len(words) < 2:
            raise InputError(f"{path} has the line {line[:60]!r}, which holds a time and nothing else.")
    if not entries:
        raise InputError(f"{path} is empty; lines of a time and a value are expected.")
    return sorted(entries, key=lambda e: e[0])


def _nearest(entries: list[tuple[float, list[str]]], time: float) -> list[str] | None:
    place = bisect_left(entries, time, key=lambda e: e[0])
    best = min(entries[max(place - 1, 0) : place + 1], key=lambda e: abs(e[0] - time))
    return best[1] if abs(best[0] - time) <= MAX_TIME_APART else None


def _pose(words: list[str], path: Path, photo: str) -> tuple[float, ...]:
    try:
        x, y, z, qx, qy, qz, qw = (float(w) for w in words)
    except ValueError as error:
        raise InputError(
            f"{path} has a line without `tx ty tz qx qy qz qw` after its time, the pose of {photo}."
        ) from error
    where = f"{path} for {photo}"
    return rigid_inverse(pose_matrix((qw, qx, qy, qz), (x, y, z), where), where)


def _lens(root: Path) -> Lens:
    path = next((root / n for n in ("intrinsics.txt", "camera.txt") if (root / n).is_file()), None)
    if path is None:
        return Lens(640, 480, 525.0, 525.0, 320.0, 240.0)
    try:
        fx, fy, cx, cy = (float(w) for w in read_text(path).split())
    except ValueError as error:
        raise InputError(f"{path} does not hold four numbers; fx fy cx cy in pixels are expected.") from error
    return check_lens(Lens(0, 0, fx, fy, cx + 0.5, cy + 0.5), str(path))
