"""Pixels of frames and of their ids: decoding, encoding, sizes, borders."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from ss_flow.tasks.artifacts import Bool, ColourTransform, Float32, Frame, UInt8


def decode_rgb(frame: Frame) -> UInt8:
    """The photo of a frame: [H, W, 3] uint8 RGB."""
    import cv2

    bgr: UInt8 = cv2.imdecode(frame.encoded, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    return np.asarray(cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB))


def shared_rgb(frame: Frame) -> UInt8:
    """The same, read-only; for the many small steps of one scene, which cut their parts out of the same photos."""
    return _decoded.of(frame.encoded, lambda: decode_rgb(frame))


def shared_valid(frame: Frame) -> Bool:
    """As `decode_valid`, likewise."""
    return _decoded.of(frame.valid, lambda: decode_valid(frame)) if frame.valid.size else decode_valid(frame)


class _Decoded:
    """The images that were decoded last, up to a number of bytes, for all threads of a process."""

    def __init__(self, most_bytes: int) -> None:
        self._most_bytes = most_bytes
        self._lock = threading.Lock()
        # With the encoded bytes, or another array might come to have the id of one that is gone.
        self._images: OrderedDict[int, tuple[UInt8, np.ndarray]] = OrderedDict()

    def of(self, encoded: UInt8, decode: Callable[[], np.ndarray]) -> np.ndarray:
        name = id(encoded)
        with self._lock:
            if name in self._images:
                self._images.move_to_end(name)
                return self._images[name][1]
        image = decode()
        image.flags.writeable = False
        with self._lock:
            self._images[name] = encoded, image
            while sum(kept.nbytes for _, kept in self._images.values()) > self._most_bytes:
                self._images.popitem(last=False)
        return image


_decoded = _Decoded(256 << 20)


def transformed(image: Float32, colours: ColourTransform) -> Float32:
    """A photo in the colours of the scene: [H, W, 3] float32, from the same, 0..1."""
    matrix = colours.matrix.astype(np.float32)
    return image @ matrix[:, :3].T + matrix[:, 3]


def scene_rgb(frame: Frame, colours: ColourTransform | None = None) -> UInt8:
    """The photo of a frame in the colours of the scene, where these are another thing: [H, W, 3] uint8 RGB."""
    photo = decode_rgb(frame)
    if colours is None or not colours.reference:
        return photo
    return np.rint(255 * transformed(photo.astype(np.float32) / np.float32(255), colours)).clip(0, 255).astype(np.uint8)


def suffix_of(frame: Frame) -> str:
    """What the name of a file with a frame's bytes ends in: "jpg" or "png"."""
    return "jpg" if frame.encoded[:2].tobytes() == b"\xff\xd8" else "png"


def decode_valid(frame: Frame) -> Bool:
    """[H, W] which pixels of a frame count."""
    if not frame.valid.size:
        return np.ones((frame.height, frame.width), bool)
    import cv2

    gray: UInt8 = cv2.imdecode(frame.valid, cv2.IMREAD_GRAYSCALE)
    return gray > 0


def encode_valid(valid: Bool) -> UInt8:
    """What `Frame.valid` holds of the pixels that count: [H, W]."""
    return np.zeros(0, np.uint8) if valid.all() else encode_png(valid.astype(np.uint8) * 255)


def averaged_valid(valid: Bool, width: int, height: int) -> Bool:
    """[height, width] which pixels of a photo count once it is scaled down (INTER_AREA): where all they average does.

    valid: [H, W], of the photo.
    """
    import cv2

    return np.asarray(cv2.resize(valid.astype(np.float32), (width, height), interpolation=cv2.INTER_AREA) > 0.999)


def encode_png(image: np.ndarray) -> UInt8:
    """The bytes of a PNG file: image is [H, W] uint8 or uint16, or [H, W, 3] uint8 RGB."""
    import cv2

    ok, data = cv2.imencode(".png", image[..., ::-1] if image.ndim == 3 else image)
    if not ok:
        raise ValueError(f"cannot encode an image of shape {image.shape} and type {image.dtype}")
    return data.ravel()


def resampled(image: np.ndarray, height: int, width: int) -> np.ndarray:
    """[height, width] an image at another size, nearest neighbour (ids and depths must not be blended)."""
    return image[np.ix_(pixels_under(height, image.shape[0]), pixels_under(width, image.shape[1]))]


def inverse_depth(depth: np.ndarray) -> np.ndarray:
    """1 / depth, of the same floating type and shape; 0 where depth is unknown, that is 0."""
    inverse = np.zeros_like(depth)
    np.divide(1, depth, out=inverse, where=depth > 0)
    return inverse


def pixels_under(count: int, size: int) -> NDArray[np.intp]:
    """[count] of `size` pixels in a row, those under the centres of `count` others that span the same length."""
    return ((np.arange(count) + 0.5) * size / count).astype(np.intp)


def at_diagonal(pixels: float, height: int, width: int) -> float:
    """A length that is meant for an image 800 pixels across, in pixels of an image of this size."""
    return pixels * float(np.hypot(height, width)) / 800


def size_within(side: int, width: int, height: int) -> tuple[int, int]:
    """Width and height of an image, scaled down where one of them is above `side`."""
    scale = min(1.0, side / max(width, height))
    return max(1, round(width * scale)), max(1, round(height * scale))


def near_border(ids: np.ndarray, reach: int) -> Bool:
    """[H, W] which pixels have another id (uint8, uint16 or float32) within so many rows and columns of them."""
    import cv2

    window = np.ones((2 * reach + 1,) * 2, np.uint8)
    return np.asarray(cv2.erode(ids, window) != cv2.dilate(ids, window))
