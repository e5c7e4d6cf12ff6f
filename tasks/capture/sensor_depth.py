"""Depth that came with the capture, registered to the frames."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ss_flow.errors import InputError
from ss_flow.running import progress, warn
from ss_flow.task import FileRef, task
from ss_flow.tasks.artifacts import Bool, DepthMap, Float32, Frame
from ss_flow.tasks.capture.lens import Lens, depth_to_color_map, undistortion_map
from ss_flow.tasks.capture.photo_files import read_gray
from ss_flow.tasks.geometry.images import decode_valid, resampled
from ss_flow.tasks.words import first_of

_NO_RETURN = np.iinfo(np.uint16).max
_SKY = 100
"""Floats above so many times the depth that a tenth of their map lies below are none: renderers write such numbers
where nothing is."""


@task(name="capture.sensor_depth")
def depth(
    frames: tuple[Frame, ...],
    *,
    names: tuple[str, ...],
    files: tuple[FileRef, ...],
    confidences: tuple[FileRef | None, ...] = (),
    scale: float,
    metric: bool,
    lenses: tuple[Lens, ...] | None = None,
    depth_lens: Lens | None = None,
) -> tuple[DepthMap, ...]:
    """Sensor depth, registered to the frames' cameras, at the sensor's own resolution.

    files: one-channel images, 16 bit in units of `scale` world units (0 and 65535: unknown), or 32-bit floats in world
    units, of which such are unknown, too, as renderers write for the sky. confidences: one-channel images of their
    sizes, 0 where the depth is not to be relied on.
    depth_lens: the depth camera, where it is not the colour camera at another resolution; same centre and axes.
    Pixels that the frame's valid mask leaves out, and those that are not finite, become unknown (0). Warns of views
    without a known pixel, and of those with such a sky.
    Raises InputError when a file is damaged, not depth, or implausible for a metric scene.
    """
    row = {name: i for i, name in enumerate(names)}
    result = []
    measured = False
    skies: list[str] = []
    scaled: list[str] = []
    for i, frame in enumerate(frames):
        ref = files[row[frame.name]]
        lens = lenses[row[frame.name]] if lenses else None
        raw = read_gray(ref.path)
        if raw.dtype not in (np.uint16, np.float32):
            raise InputError(
                f"{ref.path} holds {raw.dtype} pixels; depth of 16 bits a pixel (or 32-bit floats) is expected."
            )
        if raw.dtype == np.float32:
            sky = _sky(raw)
            values = np.where(sky, np.float32(0), raw)
            skies += [frame.name] * bool(sky.any())
        else:
            values = in_world_units(raw, scale)
        if confidences and (confidence := confidences[row[frame.name]]) is not None:
            values = _reliable(values, confidence, ref)
        if lens is not None:
            values = np.rot90(values, lens.turns)
        if depth_lens is not None and (meant := depth_lens.of_photo(*values.shape[::-1])) != values.shape[::-1]:
            scaled.append("of {1} x {0} instead of about {2:.0f} x {3:.0f}".format(*values.shape, *meant))
        measured = measured or bool((np.isfinite(values) & (values > 0)).any())
        result.append(registered_depth(frame, values, str(ref.path), metric, lens, depth_lens))
        progress(i + 1, len(frames), frame.name)
    _check_known(result, measured, str(files[0].path.parent))
    if scaled:
        warn(
            "The intrinsics of the depth camera were scaled to its images, since its principal point shows that they "
            f"are of another size: {len(scaled)} of {len(frames)} views, the first {scaled[0]} pixels."
        )
    if skies:
        warn(
            f"Depth of {_SKY} times what is near in its view counts as unknown, as renderers write such numbers for "
            f"the sky: in {len(skies)} of {len(frames)} views, {first_of(skies)}."
        )
    return tuple(result)


def _sky(values: Float32) -> Bool:
    """[h, w] where a map of floats has a number that is no depth."""
    known = np.isfinite(values) & (values > 0)
    return known & (values > _SKY * np.quantile(values[known], 0.1)) if known.any() else known


def _reliable(values: Float32, confidence: FileRef, depth: FileRef) -> Float32:
    """[h, w] depth, 0 where its confidence is."""
    known = read_gray(confidence.path)
    if known.shape != values.shape:
        raise InputError(
            f"{confidence.path} is {known.shape[1]}x{known.shape[0]} pixels and the depth that it belongs to, "
            f"{depth.path}, {values.shape[1]}x{values.shape[0]}; the two must agree."
        )
    return np.where(known > 0, values, np.float32(0))


def in_world_units(raw: np.ndarray, scale: float) -> Float32:
    """[h, w] depth of 16 bits, of which one unit is `scale` world units; 0 where it is 0 or 65535, the largest number,
    which some sensors give for what returns nothing."""
    return np.where(raw == _NO_RETURN, 0, raw).astype(np.float32) * np.float32(scale)


def registered_depth(
    frame: Frame, values: np.ndarray, where: str, metric: bool, lens: Lens | None, depth_lens: Lens | None
) -> DepthMap:
    """One view's depth map from what its sensor read.

    values: [h, w] float32, world units. Raises InputError as `depth` does.
    """
    import cv2

    values = np.where(np.isfinite(values) & (values > 0), values, np.float32(0))
    known = values[values > 0]
    if metric and known.size and not 0.01 <= float(np.median(known)) <= 100:
        raise InputError(
            f"{where} has a median depth of {float(np.median(known)):.4g} m; between 0.01 and 100 m is plausible, so "
            "its unit (the depth scale) is probably wrong."
        )
    h, w = values.shape
    color = None if lens is None else lens.scaled(frame.source_width, frame.source_height)
    sized = None if depth_lens is None else depth_lens.scaled(w, h)
    if sized is not None and color is not None and not _same_camera(sized, color, w, h):
        if not (abs(sized.cx / w - 0.5) < 0.25 and abs(sized.cy / h - 0.5) < 0.25):
            raise InputError(
                f"{where} is {w}x{h} pixels, but its lens has its centre at ({sized.cx:g}, {sized.cy:g}), far from the "
                "middle; the intrinsics are for depth of another size."
            )
        values = cv2.remap(values, depth_to_color_map(sized, color), None, cv2.INTER_NEAREST)
    elif abs(w * frame.source_height / (h * frame.source_width) - 1) > 0.02:
        raise InputError(
            f"{where} is {w}x{h} pixels and its photo {frame.source_width}x{frame.source_height}; depth must have the "
            "photo's proportions, or an intrinsic_depth.txt of its own."
        )
    if color is not None and not color.pinhole:
        values = cv2.remap(values, undistortion_map(color.scaled(w, h)), None, cv2.INTER_NEAREST)
    if frame.valid.size:
        keep = decode_valid(frame)
        values = np.where(resampled(keep, h, w), values, np.float32(0))
    return DepthMap(frame.name, np.ascontiguousarray(values, np.float32), "sensor")


def _focal_and_center(lens: Lens) -> tuple[float, float, float, float]:
    return lens.fx, lens.fy, lens.cx, lens.cy


def _same_camera(depth_lens: Lens, color: Lens, width: int, height: int) -> bool:
    scaled = color.scaled(width, height)
    return bool(np.abs(np.subtract(_focal_and_center(depth_lens), _focal_and_center(scaled))).max() < 0.1)


def _check_known(maps: Sequence[DepthMap], measured: bool, where: str) -> None:
    """measured: whether any file has a known pixel, be it one that a valid mask leaves out."""
    empty = [m.name for m in maps if not m.depth.any()]
    if not empty:
        return
    if len(empty) == len(maps) and measured:
        raise InputError(
            f"the depth maps in {where} have no known pixel that counts: valid masks (0 = ignored) or the photos' "
            "alpha channels leave out every one, or none lies in the photo; let both be 0 only where a pixel is to be "
            "ignored."
        )
    if len(empty) == len(maps):
        raise InputError(
            f"the depth maps in {where} are 0 everywhere; leave depth out, or give maps with known pixels."
        )
    views = "1 view has" if len(empty) == 1 else f"{len(empty)} views have"
    warn(f"{views} no known depth, 0 everywhere or where the valid mask is not 0: {first_of(empty)}.")
