"""Photo files of every kind: how they are turned, what they do not show, and what they tell of their lens."""

import struct
import zlib
from pathlib import Path
from types import SimpleNamespace

import capture_folders as made
import cv2
import numpy as np
import pytest
from capture_folders import ingested, ref

from ss_flow.tasks.capture import photo_files
from ss_flow.tasks.capture.ingest import IngestParams, frames
from ss_flow.tasks.capture.lens import Lens
from ss_flow.tasks.capture.photo_files import read_photo
from ss_flow.tasks.capture.scene import open_scene
from ss_flow.tasks.geometry.images import decode_rgb, decode_valid

SUPPORT = Path(__file__).parents[2] / "support"


def tiff_of(orientation: int) -> bytes:
    """EXIF that says how a photo is to be turned, and no more."""
    return b"MM\0*" + struct.pack(">IHHHIHHI", 8, 1, 0x0112, 3, 1, orientation, 0, 0)


def with_orientation(jpeg: bytes, orientation: int) -> bytes:
    segment = b"Exif\0\0" + tiff_of(orientation)
    return jpeg[:2] + b"\xff\xe1" + struct.pack(">H", len(segment) + 2) + segment + jpeg[2:]


QUARTERS = [[(220, 40, 40), (40, 200, 60)], [(50, 70, 220), (230, 210, 60)]]
"""Of the HEIC files, 48 x 32 pixels: colours upper left and right, lower left and right."""


@pytest.mark.parametrize(("file", "turns"), [("quarters.heic", 0), ("ten_bits.heic", 0), ("turned.heic", 3)])
def test_photos_of_apples_phones_are_read_upright(tmp_path, file, turns):
    (tmp_path / "IMG_1.HEIC").write_bytes((SUPPORT / file).read_bytes())
    scene = open_scene(tmp_path)
    assert scene.names == ("IMG_1",) and scene.skipped == ()
    expected = np.rot90(np.array(QUARTERS).repeat(16, axis=0).repeat(24, axis=1), turns)
    (frame,) = ingested(scene)
    assert (frame.height, frame.width) == expected.shape[:2]
    image = decode_rgb(frame)
    inside = np.s_[6::12, 6::12]  # chroma is stored at half the size, so borders are blurred
    assert np.abs(image[inside].astype(int) - expected[inside]).max() < 12


def test_a_photo_that_was_exported_beside_its_original_is_one_view(tmp_path):
    made.photos(tmp_path)
    original = next(tmp_path.rglob("2.*")).with_suffix(".heic")
    original.write_bytes((SUPPORT / "quarters.heic").read_bytes())
    scene = open_scene(tmp_path)
    assert scene.names == ("2", "10", "11") and scene.photos[0].suffix != ".heic"


@pytest.mark.parametrize("file", ["gray.heic", "gray_ten_bits.heic"])
def test_black_and_white_photos_of_apples_phones_are_read_in_three_channels(tmp_path, file):
    (tmp_path / "IMG_1.HEIC").write_bytes((SUPPORT / file).read_bytes())
    (frame,) = ingested(open_scene(tmp_path))
    image = decode_rgb(frame)
    assert image.shape == (96, 128, 3)
    assert np.abs(image - np.arange(128)[:, None].astype(int)).max() < 6  # a ramp from left to right


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("suffix", [".png", ".webp"])
def test_png_and_webp_are_turned_upright_too(tmp_path, suffix, orientation):
    stored = cv2.resize(made.photo(width=4, height=3), (64, 48), interpolation=cv2.INTER_CUBIC)
    data, exif = cv2.imencode(suffix, stored)[1].tobytes(), tiff_of(orientation)
    if suffix == ".png":  # the chunk stands behind the header's
        chunk = b"eXIf" + exif
        data = data[:33] + struct.pack(">I", len(exif)) + chunk + struct.pack(">I", zlib.crc32(chunk)) + data[33:]
    else:
        extended = b"\x08\0\0\0" + (63).to_bytes(3, "little") + (47).to_bytes(3, "little")
        chunks = b"VP8X" + struct.pack("<I", 10) + extended + data[12:] + b"EXIF" + struct.pack("<I", len(exif)) + exif
        data = b"RIFF" + struct.pack("<I", len(chunks) + 4) + b"WEBP" + chunks
    (tmp_path / f"a{suffix}").write_bytes(data)
    frame = ingested(open_scene(tmp_path), jpeg_quality=0)[0]
    jpeg = with_orientation(cv2.imencode(".jpg", stored)[1].tobytes(), orientation)
    expected = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
    assert decode_rgb(frame).shape == expected.shape
    assert np.abs(decode_rgb(frame).astype(int) - expected).mean() < 3


@pytest.mark.parametrize("orientation", range(1, 9))
def test_photos_are_turned_upright_as_a_viewer_turns_them(tmp_path, orientation):
    smooth = cv2.resize(made.photo(width=4, height=3), (64, 48), interpolation=cv2.INTER_CUBIC)
    data = with_orientation(cv2.imencode(".jpg", smooth)[1].tobytes(), orientation)
    (tmp_path / "a.jpg").write_bytes(data)
    frame = ingested(open_scene(tmp_path), jpeg_quality=0)[0]
    expected = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
    np.testing.assert_array_equal(decode_rgb(frame), expected)


def test_a_photo_is_not_turned_when_its_intrinsics_are_those_of_the_stored_one(tmp_path):
    path = tmp_path / "a.jpg"
    path.write_bytes(with_orientation(cv2.imencode(".jpg", made.photo())[1].tobytes(), 6))
    stored = frames(names=("a",), photos=(ref(path),), lenses=(Lens(32, 24, 30, 30, 16, 12),))[0]
    turned = frames(names=("a",), photos=(ref(path),), lenses=(Lens(24, 32, 30, 30, 12, 16),))[0]
    assert (stored.width, stored.height) == (32, 24)
    assert cv2.imdecode(stored.encoded, cv2.IMREAD_COLOR).shape == (24, 32, 3)  # for programs that obey EXIF, too
    assert (turned.width, turned.height) == (24, 32)


@pytest.mark.parametrize(
    ("orientation", "center", "size"),
    [(6, (16, 12), (32, 24)), (6, (12, 16), (24, 32)), (3, (16, 12), (32, 24)), (8, (12.5, 15), (24, 32))],
)
def test_where_a_size_is_not_stated_the_principal_point_tells_which_photo_the_intrinsics_are_of(
    orientation, center, size, tmp_path
):
    """As in ScanNet's layout and TUM's, whose depth lies as the photos are stored."""
    path = tmp_path / "a.jpg"
    stored = cv2.imencode(".jpg", made.photo())[1].tobytes()
    path.write_bytes(with_orientation(stored, orientation))
    lens, params = Lens(0, 0, 30, 30, *center), IngestParams(jpeg_quality=0)
    (frame,) = frames(names=("a",), photos=(ref(path),), lenses=(lens,), params=params)
    assert (frame.width, frame.height) == size
    if size == (32, 24):
        plain = cv2.imdecode(np.frombuffer(stored, np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
        np.testing.assert_array_equal(decode_rgb(frame), plain)


def cut_out(suffix, depth=np.uint8):
    """A file whose left half is transparent, and white behind that."""
    full = np.iinfo(depth).max
    image = np.dstack([made.photo().astype(depth) * (full // 255), np.full((24, 32), full, depth)])
    image[:, :16] = [full, full, full, full // 3]
    return cv2.imencode(suffix, image, [cv2.IMWRITE_WEBP_QUALITY, 101])[1].tobytes()


@pytest.mark.parametrize(("suffix", "depth"), [(".png", np.uint8), (".png", np.uint16), (".webp", np.uint8)])
def test_what_a_photo_does_not_show_is_ignored(tmp_path, suffix, depth):
    (tmp_path / f"a{suffix}").write_bytes(cut_out(suffix, depth))
    (frame,) = ingested(open_scene(tmp_path))
    np.testing.assert_array_equal(decode_valid(frame), np.arange(32)[None].repeat(24, 0) >= 16)


def test_opacity_is_turned_upright_and_joins_the_valid_mask(tmp_path):
    data = cut_out(".png")
    chunk = b"eXIf" + tiff_of(6)
    chunk = struct.pack(">I", len(chunk) - 4) + chunk + struct.pack(">I", zlib.crc32(chunk))
    (tmp_path / "a.png").write_bytes(data[:33] + chunk + data[33:])
    mask = np.full((32, 24), 255, np.uint8)
    mask[:, :4] = 0
    made.write(tmp_path / "valid" / "a.png", mask)
    (frame,) = ingested(open_scene(tmp_path))
    expected = np.zeros((32, 24), bool)
    expected[16:, 4:] = True
    np.testing.assert_array_equal(decode_valid(frame), expected)


def tiff_of_four_channels(extra):
    """Little-endian, 32 x 24, the fourth channel 0; extra: what it is said to be."""
    tags = [(256, 32), (257, 24), (258, 8), (259, 1), (262, 2), (273, 200), (277, 4), (278, 24), (279, 4 * 24 * 32)]
    entries = b"".join(struct.pack("<HHII", tag, 3, 1, value) for tag, value in [*tags, (338, extra)])
    entries = entries.replace(struct.pack("<HHII", 258, 3, 1, 8), struct.pack("<HHII", 258, 3, 4, 180))
    head = (b"II*\0" + struct.pack("<IH", 8, len(tags) + 1) + entries + bytes(4)).ljust(180, b"\0")
    pixels = np.dstack([made.photo(), np.zeros((24, 32), np.uint8)])
    return (head + struct.pack("<4H", 8, 8, 8, 8)).ljust(200, b"\0") + pixels.tobytes()


@pytest.mark.parametrize(("extra", "counts"), [(0, True), (2, False)])
def test_the_fourth_channel_of_a_tiff_is_its_opacity_only_where_it_says_so(tmp_path, extra, counts):
    (tmp_path / "a.tif").write_bytes(tiff_of_four_channels(extra))
    (frame,) = ingested(open_scene(tmp_path))
    assert (decode_valid(frame) == counts).all()


def test_a_photo_that_shows_all_keeps_its_bytes(tmp_path):
    opaque = np.dstack([made.photo(), np.full((24, 32), 255, np.uint8)])
    made.write(tmp_path / "a.png", opaque)
    (frame,) = ingested(open_scene(tmp_path))
    assert frame.encoded.tobytes() == (tmp_path / "a.png").read_bytes() and frame.valid.size == 0


def test_photos_of_sixteen_bits_that_are_nearly_black_are_warned_of(tmp_path):
    for name, gain in (("dark", 15), ("bright", 256)):
        made.write(tmp_path / f"{name}.png", made.photo().astype(np.uint16) * gain)
    with pytest.warns(UserWarning, match="less than an eighth of their range, .* 1 of 2, dark; values of 12 bits"):
        ingested(open_scene(tmp_path))


def exif_of(*focal):
    """EXIF in whose second directory stand the given entries: tag, kind, value."""
    more = struct.pack(">H", len(focal)) + b"".join(
        struct.pack(">HHI", tag, kind, 1) + struct.pack(">HH" if kind == 3 else ">I", *value)
        for tag, kind, *value in focal
    )
    first = struct.pack(">IHHHIII", 8, 1, 0x8769, 4, 1, 26, 0)
    return (b"MM\0*" + first + more).ljust(100, b"\0") + struct.pack(">II", 425, 100)


@pytest.mark.parametrize(
    ("entries", "focal"),
    [
        ([(0x920A, 5, 100), (0xA405, 3, 26, 0)], 26),
        ([(0x920A, 5, 100), (0xA405, 3, 0, 0)], 4.25),
        ([(0x920A, 5, 100)], 4.25),
        ([(0x920A, 5, 9999)], 0),
        ([], 0),
    ],
    ids=["of 35 mm film", "not known for film", "the lens's own", "cut short", "none"],
)
def test_focal_length_is_read_of_exif_and_kept_with_the_frame(tmp_path, entries, focal):
    exif, jpeg = exif_of(*entries), cv2.imencode(".jpg", made.photo())[1].tobytes()
    segment = b"Exif\0\0" + exif
    (tmp_path / "a.jpg").write_bytes(jpeg[:2] + b"\xff\xe1" + struct.pack(">H", len(segment) + 2) + segment + jpeg[2:])
    (frame,) = ingested(open_scene(tmp_path))
    assert frame.focal == focal


def test_focal_length_of_a_tiff_is_read_too():
    photo = photo_files.inspect(exif_of((0x920A, 5, 100)), "a.tif")
    assert (photo.focal, photo.orientation) == (4.25, 1)
    assert photo_files.inspect(b"BM", "a.bmp").focal == 0


def test_focal_length_of_heic_is_read_too(tmp_path, monkeypatch):
    """As pi_heif gives EXIF; the files here have none."""
    found = SimpleNamespace(size=(32, 24), info={"exif": b"Exif\0\0" + exif_of((0xA405, 3, 13, 0))})
    monkeypatch.setattr(photo_files, "_open_heic", lambda data: found)
    assert read_photo(SUPPORT / "quarters.heic").focal == 13


def test_a_jpeg_with_a_thumbnail_and_bytes_after_its_end_is_whole(tmp_path):
    jpeg = cv2.imencode(".jpg", made.photo())[1].tobytes()
    thumbnail = b"JFXX\0\x10" + jpeg
    segment = b"\xff\xe0" + struct.pack(">H", len(thumbnail) + 2) + thumbnail
    (tmp_path / "a.jpg").write_bytes(jpeg[:2] + segment + jpeg[2:] + b"maker notes")
    assert read_photo(tmp_path / "a.jpg").width == 32
    progressive = cv2.imencode(".jpg", made.photo(), [cv2.IMWRITE_JPEG_PROGRESSIVE, 1])[1].tobytes()
    (tmp_path / "b.jpg").write_bytes(progressive)
    assert read_photo(tmp_path / "b.jpg").height == 24
