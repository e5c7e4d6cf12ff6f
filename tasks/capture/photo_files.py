"""Photo files: what their headers say, and whether they are whole (OpenCV reads cut JPEGs without a word).

Phones of Apple write HEIC, which OpenCV does not read; libheif does, and turns such photos upright by itself.
"""

from __future__ import annotations

import re
import struct
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ss_flow.errors import InputError
from ss_flow.tasks.artifacts import UInt8

_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_FRAME_HEADERS = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
_NEXT_MARKER = re.compile(rb"\xff[^\x00\xff\xd0-\xd7]")
_EXIF_HEADER = b"Exif\0\0"
_EXIF_ORIENTATION = 0x0112
_HEIC_BRANDS = frozenset({b"heic", b"heix", b"heim", b"heis", b"hevc", b"hevx", b"mif1", b"msf1"})


@dataclass(frozen=True)
class Photo:
    """A photo file in memory, found whole."""

    data: bytes
    format: str
    """"jpeg", "png", "heic" or "other"."""
    width: int
    height: int
    """Size as stored, before any rotation that EXIF asks for; that of HEIC is after it, 0, 0 that of other formats."""
    orientation: int
    """EXIF orientation, 1 = upright."""


def read_photo(path: Path) -> Photo:
    """Read a photo file and check that nothing of it is missing.

    Raises InputError when it is missing, cut short or damaged.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path} cannot be read ({error.strerror}); it is one of the capture's files.") from error
    return inspect(data, str(path))


def inspect(data: bytes, where: str) -> Photo:
    """As `read_photo`, for the bytes of a file; `where` is what to name in a message."""
    try:
        if data.startswith(b"\xff\xd8"):
            return _inspect_jpeg(data)
        if data.startswith(_PNG_SIGNATURE):
            return _inspect_png(data)
        if data[:4] == b"RIFF" and data[8:12] == b"WEBP":
            return Photo(data, "other", 0, 0, _webp_orientation(data))
        if _is_heic(data):
            width, height = _open_heic(data).size
            return Photo(data, "heic", width, height, 1)
    except (IndexError, struct.error, ValueError, EOFError) as error:
        raise InputError(f"{where} is cut short or damaged; a whole image file is expected.") from error
    return Photo(data, "other", 0, 0, 1)


def header_size(path: Path) -> tuple[int, int]:
    """Width and height of a photo as stored.

    Raises InputError as `read_photo` does, or when it is neither JPEG nor PNG nor HEIC.
    """
    photo = read_photo(path)
    if not photo.width:
        raise InputError(
            f"{path} is neither JPEG nor PNG nor HEIC, and its size is not stated; give it, or convert the photo."
        )
    return photo.width, photo.height


def decode(data: bytes, where: str, flags: int) -> np.ndarray:
    """Decode an image file (colour channels in OpenCV's order, blue first).

    flags: OpenCV's; HEIC comes upright and in eight bits whatever they are.
    Raises InputError when it cannot be decoded.
    """
    import cv2

    if _is_heic(data):
        try:
            return _in_colour(np.array(_open_heic(data)))  # a copy, since its memory goes with the object
        except (ValueError, EOFError) as error:
            raise InputError(f"{where} is cut short or damaged; a whole image file is expected.") from error
    buffer: UInt8 = np.frombuffer(data, np.uint8)
    image = None
    if buffer.size:
        try:
            image = cv2.imdecode(buffer, flags)
        except cv2.error:
            image = None
    if image is None:
        raise InputError(f"{where} is no image that can be read; a JPEG, PNG or HEIC file is expected.")
    return image


def read_gray(path: Path) -> np.ndarray:
    """[H, W] a one-channel image at its own depth: uint8, uint16 or float32.

    Raises InputError when it is missing, damaged, or has several channels.
    """
    import cv2

    image = decode(read_photo(path).data, str(path), cv2.IMREAD_UNCHANGED)
    if image.ndim != 2:
        raise InputError(f"{path} has {image.shape[2]} channels; an image of one channel is expected.")
    return image


def _is_heic(data: bytes) -> bool:
    return data[4:8] == b"ftyp" and data[8:12] in _HEIC_BRANDS


def _open_heic(data: bytes) -> Any:
    """The file's main picture, not decoded yet."""
    import pi_heif

    return pi_heif.open_heif(data, convert_hdr_to_8bit=True, bgr_mode=True)


def _in_colour(image: np.ndarray) -> UInt8:
    """[H, W, 3] a decoded HEIC without its opacity; black-and-white ones lack channels, and may come in 16 bits."""
    channels = image.reshape(*image.shape[:2], -1)
    colour = channels[..., :3] if channels.shape[2] > 2 else channels[..., [0, 0, 0]]
    return (colour >> 8).astype(np.uint8) if colour.dtype == np.uint16 else colour


def _inspect_jpeg(data: bytes) -> Photo:
    width = height = 0
    orientation, place = 1, 2
    while True:
        found = _NEXT_MARKER.search(data, place)
        if found is None:
            raise ValueError("no end-of-image marker")
        marker, place = found.group()[1], found.end()
        if marker == 0xD9:
            break
        if marker == 0x01:
            continue
        (length,) = struct.unpack_from(">H", data, place)
        if marker in _FRAME_HEADERS:
            height, width = struct.unpack_from(">HH", data, place + 3)
        elif marker == 0xE1 and data[place + 2 : place + 8] == _EXIF_HEADER:
            orientation = _exif_orientation(data[place + 8 : place + length])
        place += length
    if not (width and height):
        raise ValueError("no frame header")
    return Photo(data, "jpeg", width, height, orientation)


def _exif_orientation(tiff: bytes) -> int:
    try:
        order = {b"II": "<", b"MM": ">"}[tiff[:2]]
        (start,) = struct.unpack_from(order + "I", tiff, 4)
        (entries,) = struct.unpack_from(order + "H", tiff, start)
        for i in range(entries):
            tag, _, _, value = struct.unpack_from(order + "HHIH", tiff, start + 2 + 12 * i)
            if tag == _EXIF_ORIENTATION:
                return value if 1 <= value <= 8 else 1
    except (KeyError, struct.error):
        pass  # EXIF that cannot be read asks for nothing; the image itself may still be whole
    return 1


def _inspect_png(data: bytes) -> Photo:
    width, height = struct.unpack_from(">II", data, 16)
    orientation, place, kind = 1, 8, b""
    while kind != b"IEND":
        length, kind = struct.unpack_from(">I4s", data, place)
        (checksum,) = struct.unpack_from(">I", data, place + 8 + length)
        if zlib.crc32(data[place + 4 : place + 8 + length]) != checksum:
            raise ValueError("checksum of a chunk is wrong")
        if kind == b"eXIf":
            orientation = _exif_orientation(data[place + 8 : place + 8 + length])
        place += 12 + length
    return Photo(data, "png", width, height, orientation)


def _webp_orientation(data: bytes) -> int:
    place = 12
    while place + 8 <= len(data):
        kind, length = struct.unpack_from("<4sI", data, place)
        if kind == b"EXIF":
            return _exif_orientation(data[place + 8 : place + 8 + length].removeprefix(_EXIF_HEADER))
        place += 8 + length + length % 2
    return 1
