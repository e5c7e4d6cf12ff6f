"""Pictures of a report as they are kept: the bytes of a PNG or JPEG file, whichever is smaller."""

from __future__ import annotations

import base64
from dataclasses import dataclass

import numpy as np

from ss_flow.tasks.artifacts import UInt8
from ss_flow.tasks.geometry.images import encode_png

_WIDEST = 960
_JPEG_QUALITY = 88


@dataclass(frozen=True)
class Picture:
    """A picture of a report."""

    name: str
    """"VIEW/KIND" for one of several of a view; any other name is its caption."""
    content: UInt8
    """[bytes] of a PNG or JPEG file."""


@dataclass(frozen=True)
class Thumbnail:
    """A small picture of an instance."""

    instance_id: int
    share: float
    """How much of all pixels of all views the instance fills, 0..1."""
    content: UInt8
    """[bytes] of a PNG or JPEG file."""


def compressed(picture: UInt8) -> UInt8:
    """A picture [H, W, 3] RGB as the bytes of a file; wider ones are scaled down to 960 pixels."""
    import cv2

    scale = _WIDEST / picture.shape[1]
    if scale < 1:
        size = (_WIDEST, max(1, round(picture.shape[0] * scale)))
        picture = np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), np.uint8)
    _, jpeg = cv2.imencode(".jpg", np.ascontiguousarray(picture[..., ::-1]), [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
    return min(encode_png(picture), jpeg.ravel(), key=len)


def decompressed(content: UInt8) -> UInt8:
    """[H, W, 3] RGB."""
    import cv2

    bgr = cv2.imdecode(content, cv2.IMREAD_COLOR)
    return np.ascontiguousarray(bgr[..., ::-1], np.uint8)


def data_uri(content: UInt8 | bytes) -> str:
    """The bytes of a PNG or JPEG file as a data URI."""
    data = content if isinstance(content, bytes) else content.tobytes()
    kind = "png" if data.startswith(b"\x89PNG") else "jpeg"
    return f"data:image/{kind};base64,{base64.b64encode(data).decode('ascii')}"
