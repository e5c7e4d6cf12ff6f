"""Frames out of one file whose poses are known: an app's video, or ScanNet's `.sens`."""

from __future__ import annotations

import zlib

import numpy as np

from ss_flow.errors import InputError
from ss_flow.running import progress
from ss_flow.task import FileRef, task
from ss_flow.tasks.artifacts import DepthMap, Frame
from ss_flow.tasks.capture.ingest import IngestParams, frame_of, warn_of_skipped
from ss_flow.tasks.capture.layout_scannet import read_sens_index
from ss_flow.tasks.capture.lens import Lens
from ss_flow.tasks.capture.photo_files import Photo, Pixels, inspect, pixels_of
from ss_flow.tasks.capture.scene_files import open_video
from ss_flow.tasks.capture.sensor_depth import in_world_units, registered_depth

OF_VIDEO = Photo(b"", "other", 0, 0, 1)
"""What stands for the photo file of a video's frame."""


@task(name="capture.recorded_frames")
def recorded_frames(
    *,
    recording: FileRef,
    names: tuple[str, ...],
    entries: tuple[int, ...],
    lenses: tuple[Lens, ...],
    valid: tuple[FileRef | None, ...] = (),
    skipped: tuple[str, ...] = (),
    params: IngestParams = IngestParams(),
) -> tuple[Frame, ...]:
    """Some frames of a video whose poses are known, as `capture.ingest` has photos.

    entries: their places in the video, from 0, ascending. skipped: views that are not among these, of which the run is
    to warn.
    Raises InputError when the video ends before the last of them.
    """
    import cv2

    warn_of_skipped(skipped, "without depth, or beyond the video's end")
    reader = open_video(recording.path)
    reader.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)
    result: list[Frame] = []
    for place in range(entries[-1] + 1):
        i = len(result)
        ok = reader.grab()
        if ok and place == entries[i]:
            ok, image = reader.retrieve()
        if not ok:
            raise InputError(
                f"{recording.path} ends or is damaged at frame {place} of {entries[-1] + 1} that are needed; copy the "
                "recording again."
            )
        if place == entries[i]:
            where, mask = f"{recording.path}, frame {place},", valid[i] if valid else None
            result.append(frame_of(names[i], OF_VIDEO, Pixels(image, None, False), where, mask, lenses[i], params))
        progress(place + 1, entries[-1] + 1, names[i])
    reader.release()
    return tuple(result)


@task(name="capture.sens_frames")
def sens_frames(
    *,
    recording: FileRef,
    names: tuple[str, ...],
    entries: tuple[int, ...],
    valid: tuple[FileRef | None, ...] = (),
    skipped: tuple[str, ...] = (),
    params: IngestParams = IngestParams(),
) -> tuple[Frame, ...]:
    """The colour photos of some views of a ScanNet `.sens` file.

    entries: places in the file, from 0. skipped: views that are not among these, of which the run is to warn.
    Raises InputError when the file is damaged.
    """
    warn_of_skipped(skipped, "without a pose")
    index = read_sens_index(recording.path)
    result = []
    with recording.path.open("rb") as file:
        for i, (name, entry) in enumerate(zip(names, entries, strict=True)):
            start, length, _, _ = index.offsets[entry]
            file.seek(start)
            where, mask = f"{recording.path}, frame {entry},", valid[i] if valid else None
            photo = inspect(file.read(length), where)
            pixels = pixels_of(photo, where)
            result.append(frame_of(name, photo, pixels, where, mask, index.color_lens, params))
            progress(i + 1, len(entries), name)
    return tuple(result)


@task(name="capture.sens_depth")
def sens_depth(
    frames: tuple[Frame, ...], *, recording: FileRef, names: tuple[str, ...], entries: tuple[int, ...]
) -> tuple[DepthMap, ...]:
    """The depth maps of some views of a ScanNet `.sens` file, registered to its colour camera.

    names, entries: of the capture's views, of which the frames are some.
    Raises InputError when the file is damaged.
    """
    index = read_sens_index(recording.path)
    lens = index.depth_lens
    place = dict(zip(names, entries, strict=True))
    result = []
    with recording.path.open("rb") as file:
        for i, frame in enumerate(frames):
            entry = place[frame.name]
            _, _, start, length = index.offsets[entry]
            where = f"{recording.path}, frame {entry},"
            file.seek(start)
            raw = _depth_values(file.read(length), index.depth_compression, lens.width, lens.height, where)
            values = in_world_units(raw, index.depth_scale)
            result.append(registered_depth(frame, values, where, True, index.color_lens, lens))
            progress(i + 1, len(frames), frame.name)
    return tuple(result)


def _depth_values(data: bytes, compression: int, width: int, height: int, where: str) -> np.ndarray:
    try:
        raw = zlib.decompress(data) if compression else data
    except zlib.error as error:
        raise InputError(f"{where} has damaged depth ({error}); copy the recording again.") from error
    if len(raw) != 2 * width * height:
        raise InputError(f"{where} has {len(raw)} bytes of depth; {width}x{height} pixels of 2 bytes are expected.")
    return np.frombuffer(raw, "<u2").reshape(height, width)
