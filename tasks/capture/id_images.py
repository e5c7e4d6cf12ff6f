"""Images of instance ids: ready-made masks, and ground truth."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ss_flow.errors import InputError
from ss_flow.task import FileRef, task
from ss_flow.tasks.artifacts import Frame, LabelMap, MaskSet
from ss_flow.tasks.capture.lens import Lens, undistortion_map
from ss_flow.tasks.capture.photo_files import read_gray
from ss_flow.tasks.capture.sensor_depth import resampled
from ss_flow.tasks.geometry.images import pack_masks

_USES = ("opencv-contrib-python-headless",)


@task(name="capture.ready_masks", uses=_USES)
def ready_masks(
    frames: tuple[Frame, ...],
    *,
    names: tuple[str, ...],
    files: tuple[FileRef, ...],
    lenses: tuple[Lens, ...] | None = None,
) -> tuple[MaskSet, ...]:
    """Ready-made instance masks in the place of a segmenter's: one mask for each id of an id image, by rising id.

    Raises InputError when an image is damaged, holds no ids, or has not its photo's size.
    """
    return tuple(masks_of(ids, frame.name) for frame, ids in _id_images(frames, names, files, lenses))


def masks_of(ids: NDArray[np.integer], name: str) -> MaskSet:
    """The masks of an id image [H, W], one for each id above 0, by rising id."""
    present = np.unique(ids)
    present = present[present > 0]
    count = len(present)
    return MaskSet(
        name=name,
        height=ids.shape[0],
        width=ids.shape[1],
        packed=pack_masks(ids[None] == present[:, None, None]),
        predicted_iou=np.ones(count, np.float32),
        stability=np.ones(count, np.float32),
        grid=np.zeros(count, np.int32),
        parent=np.full(count, -1, np.int32),
        source="ready-made",
    )


@task(name="capture.ground_truth", uses=_USES)
def ground_truth(
    frames: tuple[Frame, ...],
    *,
    names: tuple[str, ...],
    files: tuple[FileRef | None, ...],
    lenses: tuple[Lens, ...] | None = None,
) -> tuple[LabelMap, ...]:
    """The annotated instances of those frames that have any, at the frames' size.

    Raises InputError when an image is damaged, holds no ids, or has not its photo's size.
    """
    return tuple(LabelMap(frame.name, ids) for frame, ids in _id_images(frames, names, files, lenses))


def _id_images(
    frames: tuple[Frame, ...],
    names: tuple[str, ...],
    files: tuple[FileRef | None, ...],
    lenses: tuple[Lens, ...] | None,
) -> list[tuple[Frame, np.ndarray]]:
    import cv2

    row = {name: i for i, name in enumerate(names)}
    result = []
    for frame in frames:
        ref = files[row[frame.name]]
        if ref is None:
            continue
        ids = read_gray(ref.path)
        if ids.dtype not in (np.uint8, np.uint16):
            raise InputError(f"{ref.path} holds {ids.dtype} pixels; instance ids of 16 bits a pixel are expected.")
        height, width = ids.shape
        if (width, height) != (frame.source_width, frame.source_height):
            raise InputError(
                f"{ref.path} is {width}x{height} pixels, but its photo is {frame.source_width}x{frame.source_height}; "
                "an image of instance ids must have its photo's size."
            )
        lens = lenses[row[frame.name]] if lenses else None
        if lens is not None and not lens.pinhole:
            ids = cv2.remap(ids, undistortion_map(lens.scaled(width, height)), None, cv2.INTER_NEAREST)
        result.append((frame, np.ascontiguousarray(resampled(ids, frame.height, frame.width), np.uint16)))
    return result
