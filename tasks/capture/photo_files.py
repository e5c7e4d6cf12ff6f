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
from ss_flow.tasks.artifacts import Bool, UInt8

_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_FRAME_HEADERS = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
_NEXT_MARKER = re.compile(rb"\xff[^\x00\xff\xd0-\xd7]")
_EXIF_HEADER = b"Exif\0\0"
_EXIF_ORIENTATION, _EXIF_MORE = 0x0112, 0x8769
_EXIF_FOCAL, _EXIF_FOCAL_35MM = 0x920A, 0xA405
_TIFF_EXTRA, _TIFF_ALPHA = 0x0152, (1, 2)
_PNG_WITH_ALPHA = (4, 6)
_PNG_WITH_PALETTE = 3
_LONG, _RATIONAL = 4, 5
_DIM = 1 << 13
"""An eighth of the range of 16 bits; values of 12 bits in a file of 16 stay below a sixteenth."""
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
    focal: float = 0.0
    """Focal length that EXIF tells, in millimetres as if on 35 mm film, or else the lens's own; 0 where it tells none.
    It tells lenses, and lengths of a zoom, from each other."""


@dataclass(frozen=True)
class Pixels:
    """What a photo file shows, before any rotation that EXIF asks for."""

    image: UInt8
    """[H, W, 3] blue first."""
    opaque: Bool | None
    """[H, W] which pixels its alpha channel shows, those above half; None where it has none."""
    dim: bool
    """Whether it has 16 bits a channel, of which the upper three are not used."""


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
        if not data:
            raise EOFError("an empty file")
        if data.startswith(b"\xff\xd8"):
            return _inspect_jpeg(data)
        if data.startswith(_PNG_SIGNATURE):
            return _inspect_png(data)
        if data[:4] == b"RIFF" and data[8:12] == b"WEBP":
            return Photo(data, "other", 0, 0, *_exif(_webp_exif(data)))
        if _is_heic(data):
            opened = _open_heic(data)
            _, focal = _exif((opened.info.get("exif") or b"").removeprefix(_EXIF_HEADER))
            width, height = opened.size
            return Photo(data, "heic", width, height, 1, focal)
    except (IndexError, struct.error, ValueError, EOFError) as error:
        raise InputError(f"{where} is cut short or damaged; a whole image file is expected.") from error
    return Photo(data, "other", 0, 0, 1, _exif(data)[1])  # of a TIFF, which OpenCV turns upright by itself


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


def pixels_of(photo: Photo, where: str) -> Pixels:
    """Decode a photo. Raises InputError when it cannot be decoded."""
    import cv2

    image = decode(photo.data, where, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    if not _holds_more(photo):
        return Pixels(image, None, False)
    stored = decode(photo.data, where, cv2.IMREAD_UNCHANGED)
    stored = stored.reshape(*stored.shape[:2], -1)
    dim = stored.dtype == np.uint16 and bool(stored[..., :3].max() < _DIM)
    opaque = None
    if stored.shape[2] == 4 and _has_alpha(photo):
        full = 1.0 if stored.dtype.kind == "f" else np.iinfo(stored.dtype).max
        opaque = stored[..., 3] > full / 2
    return Pixels(image, opaque, dim)


def read_gray(path: Path, *, of_palette: bool = False) -> np.ndarray:
    """[H, W] a one-channel image at its own depth: uint8, uint16 or float32.

    of_palette: whether of a PNG with a palette the numbers of its colours are taken.
    Raises InputError when it is missing, damaged, or has several channels.
    """
    import cv2

    photo = read_photo(path)
    if photo.format == "png" and photo.data[25] == _PNG_WITH_PALETTE and b"PLTE" in photo.data:
        if not of_palette:
            raise InputError(f"{path} has a palette; an image of one channel is expected, so save it as gray.")
        return decode(_numbered(photo.data), str(path), cv2.IMREAD_UNCHANGED)[..., 0]
    image = decode(photo.data, str(path), cv2.IMREAD_UNCHANGED)
    if image.ndim != 2:
        raise InputError(f"{path} has {image.shape[2]} channels; an image of one channel is expected.")
    return image


def _numbered(png: bytes) -> bytes:
    """A PNG with a palette in which each colour is the gray of its own number, since OpenCV shows colours only."""
    start = png.index(b"PLTE")
    end = start + 4 + struct.unpack_from(">I", png, start - 4)[0]
    palette = b"PLTE" + bytes(i // 3 for i in range(end - start - 4))
    return png[:start] + palette + struct.pack(">I", zlib.crc32(palette)) + png[end + 4 :]


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
    exif, place = b"", 2
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
            exif = data[place + 8 : place + length]
        place += length
    if not (width and height):
        raise ValueError("no frame header")
    return Photo(data, "jpeg", width, height, *_exif(exif))


def _exif(tiff: bytes) -> tuple[int, float]:
    """A photo's orientation and focal length, as `Photo` has them."""
    tags = _tags(tiff)
    more = _tags(tiff, int(tags[_EXIF_MORE])) if _EXIF_MORE in tags else {}
    orientation = int(tags.get(_EXIF_ORIENTATION, 1))
    return orientation if 1 <= orientation <= 8 else 1, more.get(_EXIF_FOCAL_35MM) or more.get(_EXIF_FOCAL, 0.0)


def _tags(tiff: bytes, start: int | None = None) -> dict[int, float]:
    """The first number of each tag in a directory of a TIFF file, the first one where no start is given."""
    found = dict[int, float]()
    try:
        order = {b"II": "<", b"MM": ">"}[tiff[:2]]
        (start,) = struct.unpack_from(order + "I", tiff, 4) if start is None else (start,)
        (entries,) = struct.unpack_from(order + "H", tiff, start)
        for place in range(start + 2, start + 2 + 12 * entries, 12):
            tag, kind, _, short = struct.unpack_from(order + "HHIH", tiff, place)
            (number,) = struct.unpack_from(order + "I", tiff, place + 8)
            if kind == _RATIONAL:
                above, below = struct.unpack_from(order + "II", tiff, number)
                found[tag] = above / max(below, 1)
            else:
                found[tag] = number if kind == _LONG else short
    except (KeyError, struct.error):
        pass  # EXIF that cannot be read asks for nothing; the image itself may still be whole
    return found


def _inspect_png(data: bytes) -> Photo:
    width, height = struct.unpack_from(">II", data, 16)
    exif, place, kind = b"", 8, b""
    while kind != b"IEND":
        length, kind = struct.unpack_from(">I4s", data, place)
        (checksum,) = struct.unpack_from(">I", data, place + 8 + length)
        if zlib.crc32(data[place + 4 : place + 8 + length]) != checksum:
            raise ValueError("checksum of a chunk is wrong")
        if kind == b"eXIf":
            exif = data[place + 8 : place + 8 + length]
        place += 12 + length
    return Photo(data, "png", width, height, *_exif(exif))


def _webp_exif(data: bytes) -> bytes:
    place = 12
    while place + 8 <= len(data):
        kind, length = struct.unpack_from("<4sI", data, place)
        if kind == b"EXIF":
            return data[place + 8 : place + 8 + length].removeprefix(_EXIF_HEADER)
        place += 8 + length + length % 2
    return b""


def _holds_more(photo: Photo) -> bool:
    """Whether a file may hold more than three channels of eight bits."""
    data = photo.data
    if photo.format == "png":
        depth, colour = data[24:26]
        return depth == 16 or colour in _PNG_WITH_ALPHA or b"tRNS" in data[: data.find(b"IDAT")]
    return photo.format == "other"


def _has_alpha(photo: Photo) -> bool:
    """Whether the fourth channel of a photo is its opacity: that of a BMP is empty, that of a TIFF what a tag says."""
    if photo.format == "png" or photo.data[8:12] == b"WEBP":
        return True
    return _tags(photo.data).get(_TIFF_EXTRA) in _TIFF_ALPHA
