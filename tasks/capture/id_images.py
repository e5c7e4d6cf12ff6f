"""Images of instance ids: ready-made masks, and ground truth."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ss_flow.errors import InputError
from ss_flow.task import FileRef, task
from ss_flow.tasks.artifacts import Cameras, Frame, LabelMap, MaskSet
from ss_flow.tasks.capture.lens import Lens, photo_lens, undistortion_map
from ss_flow.tasks.capture.photo_files import read_gray
from ss_flow.tasks.geometry.images import resampled
from ss_flow.tasks.masks.pool import masks_by_id


@task(name="capture.ready_masks")
def ready_masks(
    frames: tuple[Frame, ...],
    cameras: Cameras,
    *,
    names: tuple[str, ...],
    files: tuple[FileRef, ...],
    lenses: tuple[Lens, ...] | None = None,
) -> tuple[MaskSet, ...]:
    """Ready-made instance masks in the place of a segmenter's: one mask for each id of an id image, by rising id.

    Raises InputError when an image is damaged, holds no ids, or has not its photo's size.
    """
    return tuple(masks_by_id(ids, frame.name) for frame, ids in _id_images(frames, cameras, names, files, lenses))


@task(name="capture.ground_truth")
def ground_truth(
    frames: tuple[Frame, ...],
    cameras: Cameras,
    *,
    names: tuple[str, ...],
    files: tuple[FileRef | None, ...],
    lenses: tuple[Lens, ...] | None = None,
) -> tuple[LabelMap, ...]:
    """The annotated instances of those frames that have any, at the frames' size.

    Raises InputError when an image is damaged, holds no ids, or has not its photo's size, or there is no instance
    in any.
    """
    found = tuple(LabelMap(frame.name, ids) for frame, ids in _id_images(frames, cameras, names, files, lenses))
    if not any(of_view.ids.any() for of_view in found):
        raise InputError(
            f"the ground truth in instance/ holds no instance in any of the {len(frames)} views that are used; "
            "annotate one of them, or move the folder away to measure nothing."
        )
    return found


def _id_images(
    frames: tuple[Frame, ...],
    cameras: Cameras,
    names: tuple[str, ...],
    files: tuple[FileRef | None, ...],
    lenses: tuple[Lens, ...] | None,
) -> list[tuple[Frame, np.ndarray]]:
    row = {name: i for i, name in enumerate(names)}
    result = []
    for frame in frames:
        ref = files[row[frame.name]]
        if ref is None:
            continue
        ids = read_gray(ref.path, of_palette=True)
        if ids.dtype not in (np.uint8, np.uint16):
            raise InputError(f"{ref.path} holds {ids.dtype} pixels; instance ids of 16 bits a pixel are expected.")
        height, width = ids.shape
        if (width, height) != (frame.source_width, frame.source_height):
            raise InputError(
                f"{ref.path} is {width}x{height} pixels, but its photo is {frame.source_width}x{frame.source_height}; "
                "an image of instance ids must have its photo's size."
            )
        pixels = frame_pixels(frame, lenses[row[frame.name]] if lenses else None, cameras)
        result.append((frame, np.where(pixels >= 0, ids.ravel()[pixels], 0).astype(np.uint16)))
    return result


def written_ids(file: Path) -> NDArray[np.uint16]:
    """The ids of a view, [H, W], that a run wrote to `masks/`.

    Raises InputError when the file cannot be read or is no such image.
    """
    try:
        return read_gray(file).astype(np.uint16, copy=False)
    except InputError as error:
        raise InputError(f"{file} cannot be read or is damaged: it is no image of ids; run the scene again.") from error


def frame_pixels(frame: Frame, stated: Lens | None, cameras: Cameras) -> NDArray[np.intp]:
    """The pixel of the input photo that each pixel of a frame shows: [H, W] flat indices, -1 beyond the lens's reach.

    stated, cameras: as `photo_lens` takes them.
    """
    import cv2

    shape = frame.source_height, frame.source_width
    pixels = np.arange(shape[0] * shape[1], dtype=np.float64).reshape(shape)
    lens = photo_lens(frame, stated, cameras)
    if lens is not None:
        pixels = cv2.remap(pixels, undistortion_map(lens), None, cv2.INTER_NEAREST, borderValue=-1)
    return resampled(pixels, frame.height, frame.width).astype(np.intp)
