"""Frames out of a video without poses: few, sharp, and each a step on from the one before."""

from __future__ import annotations

import shlex
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ss_flow.errors import InputError
from ss_flow.running import progress, warn
from ss_flow.task import FileRef, task
from ss_flow.tasks.artifacts import Float64, Frame, UInt8
from ss_flow.tasks.capture.ingest import IngestParams, frame_of, warn_of_skipped
from ss_flow.tasks.capture.photo_files import Pixels
from ss_flow.tasks.capture.recordings import OF_VIDEO
from ss_flow.tasks.capture.scene_files import open_video
from ss_flow.tasks.ranges import Count, JpegQuality, Natural, NonNegative

_WHOLE = 0.9
"""The share of the announced frames below which a video is taken to be cut or damaged."""
_A_SECOND = 10
"""Frames of a second between which motion is measured: flow loses what moves farther, and noise adds up in more."""
_FEWEST = 20
"""Frames that a video gives by its length alone, be it without motion."""
_LIKELY_RATE = 1000
"""Frames a second above which a video does not know its own rate."""
_STEP = 3
"""From frame to frame where motion is measured, if the rate is not known."""
_WIDTH = 160
"""Pixels of a row in which motion is measured."""
_LEAST_HEIGHT = 64
"""Pixels of a column, there and for sharpness; in less, OpenCV's flow reads outside of the picture."""
_TOO_FAR = 3
"""Times the motion that is wanted between frames from which neighbours may have too little in common."""


@dataclass(frozen=True)
class VideoParams:
    """Which frames of a video are used."""

    max_frames: Count = 120
    """The most frames that are taken, of a video or a recording of Stray Scanner."""
    motion: NonNegative = 0.04
    """Take a frame of a video whenever the picture has moved by so much of its diagonal, and of a long recording with
    poses likewise; 0 = as many as `max_frames` (`max_views`) allows."""
    stride: Natural = 0
    """Take one frame out of so many, or of more where `max_frames` would be exceeded; 0 = by `motion`."""
    candidates: Count = 5
    """So many frames of each stretch are compared and the sharpest is taken."""
    min_sharpness: NonNegative = 0.3
    """A frame is dropped when its sharpness is below this share of the median over the frames taken."""
    max_side: Count = 1600
    """Frames whose longer side is above this are scaled down to it, in pixels."""
    jpeg_quality: JpegQuality = 95
    """Quality at which frames are encoded; 0 keeps them lossless as PNG."""

    @property
    def by_motion(self) -> bool:
        """Whether motion says which frames are taken, and not their number."""
        return self.motion > 0 and not self.stride

    def every(self, stride: int) -> VideoParams:
        """Where only one frame out of so many of them is to be taken."""
        return replace(
            self,
            max_frames=-(-self.max_frames // stride),
            motion=self.motion * stride,
            stride=self.stride * stride,
        )


@task(name="capture.video_frames")
def video_frames(*, video: FileRef, params: VideoParams = VideoParams()) -> tuple[Frame, ...]:
    """Sharp frames of a video, one a stretch, named `frame-000000` and on by their place in it.

    Stretches are of equal motion (`_moved`), or of equal length where `params` say so. Sharpness is the variance of the
    Laplacian at a width of 320 pixels, compared within each stretch, since it depends on what is seen as much as on
    blur. Pixels that are not square, as those of DV and AVCHD, are made so.
    Warns where fewer frames can be decoded than the video announces.
    Raises InputError when the video cannot be opened or shows nothing.
    """
    moved = _moved(video.path, measured=params.by_motion)
    total = len(moved)
    starts = _starts(moved, params)
    reader = open_video(video.path)
    aspect = _pixel_aspect(reader)
    best: list[tuple[float, Frame]] = []
    for start, stop in zip(starts, [*starts[1:], total], strict=True):
        step = max(1, (stop - start) // params.candidates)
        sharpest: tuple[float, int, UInt8] | None = None
        for i in range(start, stop):
            ok = reader.grab()
            if ok and (i - start) % step == 0:
                ok, image = reader.retrieve()
                if ok and (sharpness := _sharpness(image)) > (sharpest[0] if sharpest else -1):
                    sharpest = sharpness, i, image
            progress(total + i + 1, 2 * total)
        if sharpest is not None:
            best.append((sharpest[0], _encode(sharpest[2], sharpest[1], aspect, params)))
    reader.release()
    floor = params.min_sharpness * float(np.median([sharpness for sharpness, _ in best]))
    warn_of_skipped(
        tuple(frame.name for sharpness, frame in best if sharpness < floor),
        "blurred or without detail beside the other frames",
    )
    return tuple(frame for sharpness, frame in best if sharpness >= floor)


def _starts(moved: Float64, params: VideoParams) -> list[int]:
    """The frames at which the stretches of a video begin, ascending, from 0."""
    total = len(moved)
    if not params.by_motion:
        stride = max(params.stride, -(-total // params.max_frames))
        if 0 < params.stride < stride:
            warn(
                f"One frame out of {stride} is taken instead of one out of {params.stride}, since no more than "
                f"{params.max_frames} are to be taken (capture.video.max_frames)."
            )
        return list(range(0, total, stride))
    way = moved / params.motion
    way += max(0.0, _FEWEST - way[-1]) * np.arange(1, total + 1) / total
    count = min(int(np.ceil(way[-1])), params.max_frames)
    if way[-1] > _TOO_FAR * params.max_frames:
        warn(
            f"{int(np.ceil(way[-1]))} frames would follow the video's motion, and {count} are taken "
            "(capture.video.max_frames): some may find no pose."
        )
    stretch = np.minimum(np.floor(way * (count / way[-1])), count - 1)
    return [int(i) for i in np.unique(stretch, return_index=True)[1]]


def _moved(video: Path, *, measured: bool) -> Float64:
    """[frames] how far the picture of a video has moved from its first frame on, all ways added up, in its diagonals.

    The motion between two frames is the mean length of the optical flow over all pixels (Kroeger et al., "Fast Optical
    Flow using Dense Inverse Search"), measured some times a second; in between it is taken to be even. All 0 where it
    is not to be measured.
    """
    import cv2

    reader = open_video(video)
    if not reader.isOpened():
        raise InputError(
            f"{video} cannot be opened as a video: it is cut short or damaged, or holds no pictures; copy it again."
        )
    # The container's own count is often wrong, too low mostly: only one that is far too high tells of a damage.
    announced = int(reader.get(cv2.CAP_PROP_FRAME_COUNT))
    rate = reader.get(cv2.CAP_PROP_FPS)
    every = max(1, round(rate / _A_SECOND)) if 0 < rate <= _LIKELY_RATE else _STEP
    flow = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_FAST)
    places, ways, last = [0], [0.0], None
    total = 0
    while reader.grab():
        if measured and total % every == 0:
            ok, image = reader.retrieve()
            if ok:
                gray = _small_gray(image, _WIDTH)
                if last is not None:
                    moved = np.linalg.norm(flow.calc(last, gray, None), axis=-1).mean()
                    places.append(total)
                    ways.append(ways[-1] + float(moved / np.hypot(*gray.shape)))
                last = gray
        total += 1
        progress(total, 2 * max(total, announced))
    reader.release()
    if total == 0:
        raise InputError(
            f"{video} holds no frame that can be decoded: it is damaged, or of a codec that is not read, such as AV1; "
            f"convert it to H.264 (ffmpeg -i {shlex.quote(video.name)} -c:v libx264 converted.mp4)."
        )
    if total < _WHOLE * announced:
        warn(f"{video.name} announces {announced} frames, but only {total} can be decoded; it may be cut or damaged.")
    return np.interp(np.arange(total), places, ways)


def _small_gray(image: UInt8, width: int) -> UInt8:
    """An image [H, W, 3] BGR in grey, so many pixels wide, and at least _LEAST_HEIGHT high."""
    import cv2

    gray = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    height = max(_LEAST_HEIGHT, round(width * gray.shape[0] / gray.shape[1]))
    return cv2.resize(gray, (width, height), interpolation=cv2.INTER_AREA)


def _sharpness(image: UInt8) -> float:
    import cv2

    return float(cv2.Laplacian(_small_gray(image, 320), cv2.CV_64F).var())


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
    return frame_of(name, OF_VIDEO, Pixels(image, None, False), name, None, None, ingest)
