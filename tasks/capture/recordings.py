"""Frames out of one file: a video, with poses or without, or ScanNet's `.sens`."""

from __future__ import annotations

import shlex
import zlib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ss_flow.errors import InputError
from ss_flow.running import progress, warn
from ss_flow.task import FileRef, task
from ss_flow.tasks.artifacts import DepthMap, Frame, UInt8
from ss_flow.tasks.capture.ingest import IngestParams, frame_of, warn_of_skipped
from ss_flow.tasks.capture.layout_scannet import read_sens_index
from ss_flow.tasks.capture.lens import Lens
from ss_flow.tasks.capture.photo_files import Photo, Pixels, inspect, pixels_of
from ss_flow.tasks.capture.scene_files import open_video
from ss_flow.tasks.capture.sensor_depth import in_world_units, registered_depth
from ss_flow.tasks.ranges import Count, JpegQuality, Natural, NonNegative

_WHOLE = 0.9
"""The share of the announced frames below which a video is taken to be cut or damaged."""
_OF_VIDEO = Photo(b"", "other", 0, 0, 1)
"""What stands for the photo file of a video's frame."""


@dataclass(frozen=True)
class VideoParams:
    """Which frames of a video are used."""

    max_frames: Count = 120
    """The most frames that are taken, spread evenly over the video, or a recording of Stray Scanner."""
    stride: Natural = 0
    """Take one frame out of so many, or of more where `max_frames` would be exceeded; 0 = as many as that allows."""
    candidates: Count = 5
    """Out of each stride, so many frames are compared and the sharpest is taken."""
    min_sharpness: NonNegative = 0.3
    """A frame is dropped when its sharpness is below this share of the median over the frames taken."""
    max_side: Count = 1600
    """Frames whose longer side is above this are scaled down to it, in pixels."""
    jpeg_quality: JpegQuality = 95
    """Quality at which frames are encoded; 0 keeps them lossless as PNG."""

    def every(self, stride: int) -> VideoParams:
        """Where only one frame out of so many of them is to be taken."""
        return replace(self, max_frames=-(-self.max_frames // stride), stride=self.stride * stride)


@task(name="capture.video_frames")
def video_frames(*, video: FileRef, params: VideoParams = VideoParams()) -> tuple[Frame, ...]:
    """Sharp frames spread over a video, named `frame-000000` and on by their place in it.

    Sharpness is the variance of the Laplacian at a width of 320 pixels, compared within each stride, since it depends
    on what is seen as much as on blur. Pixels that are not square, as those of DV and AVCHD, are made so.
    Warns where fewer frames can be decoded than the video announces.
    Raises InputError when the video cannot be opened or shows nothing.
    """

    total = _count_frames(video.path)
    stride = max(params.stride, -(-total // params.max_frames))
    if 0 < params.stride < stride:
        warn(
            f"One frame out of {stride} is taken instead of one out of {params.stride}, since no more than "
            f"{params.max_frames} are to be taken (capture.video.max_frames)."
        )
    step = max(1, stride // max(1, params.candidates))
    reader = open_video(video.path)
    aspect = _pixel_aspect(reader)
    best: list[tuple[float, int, Frame]] = []
    window: tuple[float, int, np.ndarray] | None = None
    for i in range(total):
        if not reader.grab():
            break
        if (i % stride) % step == 0:
            ok, image = reader.retrieve()
            if ok:
                sharpness = _sharpness(image)
                if window is None or sharpness > window[0]:
                    window = (sharpness, i, image)
        if window is not None and (i % stride == stride - 1 or i == total - 1):
            best.append((window[0], window[1], _encode(window[2], window[1], aspect, params)))
            window = None
        progress(i + 1, total)
    reader.release()
    floor = params.min_sharpness * float(np.median([s for s, _, _ in best]))
    kept = [frame for sharpness, _, frame in best if sharpness >= floor]
    warn_of_skipped(
        tuple(frame.name for sharpness, _, frame in best if sharpness < floor),
        "blurred or without detail beside the other frames",
    )
    return tuple(kept)


def _count_frames(video: Path) -> int:
    import cv2

    reader = open_video(video)
    if not reader.isOpened():
        raise InputError(
            f"{video} cannot be opened as a video: it is cut short or damaged, or holds no pictures; copy it again."
        )
    # The container's own count is often wrong, too low mostly: only one that is far too high tells of a damage.
    announced = int(reader.get(cv2.CAP_PROP_FRAME_COUNT))
    total = 0
    while reader.grab():
        total += 1
    reader.release()
    if total == 0:
        raise InputError(
            f"{video} holds no frame that can be decoded: it is damaged, or of a codec that is not read, such as AV1; "
            f"convert it to H.264 (ffmpeg -i {shlex.quote(video.name)} -c:v libx264 converted.mp4)."
        )
    if total < _WHOLE * announced:
        warn(f"{video.name} announces {announced} frames, but only {total} can be decoded; it may be cut or damaged.")
    return total


def _sharpness(image: UInt8) -> float:
    import cv2

    gray = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    height = max(1, round(320 * gray.shape[0] / gray.shape[1]))
    small = cv2.resize(gray, (320, height), interpolation=cv2.INTER_AREA)
    return float(cv2.Laplacian(small, cv2.CV_64F).var())


def _pixel_aspect(reader: Any) -> float:
    """How wide a pixel of a video is that is one unit high, once turned upright; 1 where the video does not say."""
    import cv2

    across, down = reader.get(cv2.CAP_PROP_SAR_NUM), reader.get(cv2.CAP_PROP_SAR_DEN)
    aspect = float(across / down) if across > 0 and down > 0 else 1.0
    return 1 / aspect if reader.get(cv2.CAP_PROP_ORIENTATION_META) % 180 else aspect


def _encode(image: UInt8, index: int, aspect: float, params: VideoParams) -> Frame:
    import cv2

    height, width = image.shape[0], max(1, round(image.shape[1] * aspect))
    if width != image.shape[1]:  # a lens with one focal length needs square pixels
        image = cv2.resize(image, (width, height), interpolation=cv2.INTER_LINEAR)
    name, ingest = f"frame-{index:06d}", IngestParams(params.max_side, params.jpeg_quality)
    return frame_of(name, _OF_VIDEO, Pixels(image, None, False), name, None, None, ingest)


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
            result.append(frame_of(names[i], _OF_VIDEO, Pixels(image, None, False), where, mask, lenses[i], params))
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
