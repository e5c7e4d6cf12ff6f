"""Pictures of a finished scene from any camera, and films of them."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np

from ss_flow.errors import InputError
from ss_flow.running import progress
from ss_flow.task import Resources, task
from ss_flow.tasks.artifacts import Float32, Gaussians, UInt8
from ss_flow.tasks.deliver.export.content import FileContent
from ss_flow.tasks.deliver.palette import paint_ids, turbo
from ss_flow.tasks.gaussians.rasterize import backend_identity
from ss_flow.tasks.gaussians.render import render, shown_instances
from ss_flow.tasks.geometry.cameras import Camera
from ss_flow.tasks.geometry.images import encode_png

What = Literal["colour", "labels", "depth", "alpha"]

_SOLID = 0.5
"""Alpha from which a pixel has a depth and an id."""
_PAPER = (1.0, 1.0, 1.0)
_FARTHEST = np.iinfo(np.uint16).max


@task(name="deliver.pictures.picture", resources=Resources(gpus=0.1), environment=backend_identity)
def picture(gaussians: Gaussians, camera: Camera, *, what: What, width: int, depth_unit: float) -> FileContent:
    """A rendering as a PNG file.

    "colour": RGB over white. "labels": uint16 instance ids, that of the instance that weighs most in each pixel.
    "depth": uint16, the expected depth in steps of `depth_unit` world units, 0 where there is none. "alpha": uint8.
    width: of the picture, pixels; 0 = the camera's own.
    """
    if width:
        camera = camera.scaled(width, max(1, round(camera.height * width / camera.width)))
    if what == "labels":
        shown = shown_instances(gaussians, camera)
        return FileContent(encode_png(np.where(shown.alpha > _SOLID, shown.ids, np.uint16(0))))
    seen = render(gaussians, camera, background=_PAPER, winners=False)
    if what == "colour":
        pixels: np.ndarray = np.rint(255 * seen.rgb.clip(0, 1)).astype(np.uint8)
    elif what == "alpha":
        pixels = np.rint(255 * seen.alpha.clip(0, 1)).astype(np.uint8)
    else:
        depth = np.where(seen.alpha > _SOLID, seen.depth / np.maximum(seen.alpha, 1e-6), 0)
        pixels = np.rint(depth / depth_unit).clip(0, _FARTHEST).astype(np.uint16)
    return FileContent(encode_png(pixels))


@task(name="deliver.pictures.side_by_side")
def side_by_side(left: FileContent, right: FileContent) -> FileContent:
    """Two pictures of `picture` of one size and kind as one."""
    return FileContent(encode_png(np.concatenate([_decoded(left), _decoded(right)], axis=1)))


@task(name="deliver.pictures.film")
def film(pictures: Sequence[FileContent], *, what: What, fps: int) -> FileContent:
    """The pictures of `picture` as an MP4 file (MPEG-4 part 2), at most 8 bits a channel.

    Ids are painted in their colours, depth in one colour scale for all pictures, near = red. Sizes are made even by
    repeating the last row or column. Raises InputError when this OpenCV cannot write such a file, or sizes differ;
    OSError when there is no room for it.
    """
    import cv2

    frames = [_decoded(one) for one in pictures]
    sizes = {frame.shape[:2] for frame in frames}
    if len(sizes) != 1:
        raise InputError(f"pictures of {len(sizes)} sizes make no film; give --width, or a folder as --out.")
    near, far = _ends([frame for frame in frames if what == "depth"])
    ((height, width),) = sizes
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "film.mp4"
        size = (width + width % 2, height + height % 2)
        writer = cv2.VideoWriter(str(file), cv2.VideoWriter.fourcc(*"mp4v"), float(fps), size)
        if not writer.isOpened():
            raise InputError("this build of OpenCV cannot write MP4 files; give a folder as --out.")
        for done, frame in enumerate(frames):
            progress(done, len(frames), "film")
            painted = _painted(frame, what, near, far)
            even = np.pad(painted, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
            writer.write(np.ascontiguousarray(even[..., ::-1]))
        writer.release()
        if cv2.VideoCapture(str(file)).get(cv2.CAP_PROP_FRAME_COUNT) != len(frames):  # OpenCV does not tell of it
            raise OSError(f"the film could not be written whole to {Path(folder).parent}; is there room?")
        return FileContent.of(file.read_bytes())


def _decoded(png: FileContent) -> np.ndarray:
    import cv2

    pixels = cv2.imdecode(png.content, cv2.IMREAD_UNCHANGED)
    return pixels[..., ::-1] if pixels.ndim == 3 else pixels


def _ends(depths: Sequence[np.ndarray]) -> tuple[float, float]:
    """The 1st and the 99th percentile of all known depths."""
    known = np.concatenate([depth[depth > 0] for depth in depths] or [np.zeros(0)])
    if not len(known):
        return 0.0, 1.0
    near, far = np.percentile(known, (1, 99))
    return float(near), float(far)


def _painted(pixels: np.ndarray, what: What, near: float, far: float) -> UInt8:
    """[H, W, 3] RGB."""
    if what == "colour":
        return pixels
    if what == "alpha":
        return np.repeat(pixels[..., None], 3, axis=2)
    if what == "labels":
        return paint_ids(pixels.astype(np.int32))
    place: Float32 = ((pixels.astype(np.float32) - near) / max(far - near, 1e-9)).clip(0, 1)
    return np.where((pixels > 0)[..., None], turbo()[np.rint(255 * (1 - place)).astype(np.intp)], np.uint8(34))
