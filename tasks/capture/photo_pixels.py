"""From the frames back to the photos as they were taken, with their distortion and at their own size."""

from __future__ import annotations

from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from ss_flow.tasks.artifacts import Float32, Frame
from ss_flow.tasks.capture.lens import Lens, distorted, undistorted

T = TypeVar("T", bound=np.generic)

_NODES = 400
"""So many places along the longer side are solved for; cubic interpolation between them is mostly exact enough."""
_EXACT = 1e-3
"""Pixels of the photo; an interpolated place that misses its pixel by more is solved for itself."""
_PIXELS_AT_ONCE = 1 << 19


def photo_pixels(frame: Frame, lens: Lens) -> NDArray[np.int32]:
    """The pixel of a frame that shows each pixel of its input photo: [H, W] flat indices, -1 where none does.

    What `id_images.frame_pixels` tells for the pixels of a frame, the other way round: nearest neighbour, by the
    centres of the photo's pixels. lens: what `lens.photo_lens` gives for the frame.
    """
    width, height = frame.source_width, frame.source_height
    moves = _moves(lens, width, height)
    result = np.empty((height, width), np.int32)
    rows = max(1, _PIXELS_AT_ONCE // width)
    for top in range(0, height, rows):
        y, x = np.mgrid[top : min(top + rows, height), :width] + 0.5
        points = np.column_stack([x.ravel(), y.ravel()])
        place = points + moves[top : top + rows].reshape(-1, 2).astype(np.float64)
        near = np.abs(distorted(place, lens) - points) < _EXACT
        missed = ~(near[:, 0] & near[:, 1])
        place[missed] = undistorted(points[missed], lens)
        place *= frame.width / width, frame.height / height
        inside = (place >= 0) & (place < (frame.width, frame.height))
        shown = inside[:, 0] & inside[:, 1]
        column, row = np.where(shown[:, None], place, 0).astype(np.int32).T
        result[top : top + rows] = np.where(shown, row * frame.width + column, -1).reshape(-1, width)
    return result


def on_photo(image: NDArray[T], frame: Frame, pixels: NDArray[np.int32] | None) -> NDArray[T]:
    """What a frame's pixels hold, in the pixels of its input photo: [source height, source width], nearest neighbour.

    image: [H, W]. pixels: what `photo_pixels` gives for the frame; None for a photo without distortion. Pixels of the
    photo that the frame does not show are 0.
    """
    import cv2

    if pixels is None:
        size = (frame.source_width, frame.source_height)
        return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_NEAREST_EXACT), image.dtype)
    return np.where(pixels >= 0, image.ravel()[pixels], 0).astype(image.dtype)


def _moves(lens: Lens, width: int, height: int) -> Float32:
    """[height, width, 2] how far the undistorted place of each pixel of a photo is from it, x and y, about; NaN where
    there is none nearby."""
    step = -(-max(width, height) // _NODES)
    x, y = (np.arange(-1, -(-side // step) + 2.0) * step for side in (width, height))
    nodes = np.stack(np.meshgrid(x, y), axis=-1)
    moves = (undistorted(nodes.reshape(-1, 2), lens).reshape(nodes.shape) - nodes).astype(np.float32)
    in_rows = _interpolated(moves, step)[:height]
    return _interpolated(in_rows.swapaxes(0, 1), step)[:width].swapaxes(0, 1)


def _interpolated(nodes: Float32, step: int) -> Float32:
    """[(K - 3) * step, ...] Catmull-Rom splines through nodes [K, ...] `step` pixels apart, at the pixels' centres; the
    second node is where the first pixel begins."""
    t = (np.arange(step, dtype=np.float32) + np.float32(0.5)) / step
    weights = np.array([-t + 2 * t**2 - t**3, 2 - 5 * t**2 + 3 * t**3, t + 4 * t**2 - 3 * t**3, t**3 - t**2]) / 2
    windows = np.stack([nodes[i : len(nodes) - 3 + i] for i in range(4)])
    filled: Float32 = np.einsum("ws,wk...->ks...", weights, windows)
    return filled.reshape(-1, *nodes.shape[1:])
