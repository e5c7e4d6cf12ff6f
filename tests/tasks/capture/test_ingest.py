import re
import struct
import zlib
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import capture_folders as made
import cv2
import numpy as np
import pytest
from capture_folders import ref, refs
from PIL import Image

from ss_flow.errors import InputError
from ss_flow.tasks.capture import photo_files
from ss_flow.tasks.capture.id_images import ground_truth, ready_masks
from ss_flow.tasks.capture.ingest import IngestParams, cameras, frames
from ss_flow.tasks.capture.lens import Lens, depth_to_color_map
from ss_flow.tasks.capture.photo_files import read_photo
from ss_flow.tasks.capture.scene import open_scene
from ss_flow.tasks.capture.sensor_depth import depth
from ss_flow.tasks.capture.sfm import registered
from ss_flow.tasks.geometry.images import decode_rgb, decode_valid

SUPPORT = Path(__file__).parents[2] / "support"


def ingested(scene, **changes):
    return frames(
        names=scene.names,
        photos=refs(scene.photos),
        valid=refs(scene.valid),
        lenses=scene.lenses,
        params=IngestParams(**changes),
    )


def tiff_of(orientation: int) -> bytes:
    """EXIF that says how a photo is to be turned, and no more."""
    return b"MM\0*" + struct.pack(">IHHHIHHI", 8, 1, 0x0112, 3, 1, orientation, 0, 0)


def with_orientation(jpeg: bytes, orientation: int) -> bytes:
    segment = b"Exif\0\0" + tiff_of(orientation)
    return jpeg[:2] + b"\xff\xe1" + struct.pack(">H", len(segment) + 2) + segment + jpeg[2:]


def test_a_photo_that_needs_no_change_keeps_its_bytes(tmp_path):
    scene = open_scene(made.photos(tmp_path))
    result = ingested(scene)
    assert [f.name for f in result] == ["2", "10", "11"]
    assert result[0].encoded.tobytes() == scene.photos[0].read_bytes()
    assert (result[0].width, result[0].height, result[0].source_width) == (32, 24, 32)
    assert result[0].valid.size == 0


def test_a_large_photo_is_scaled_down_and_remembers_its_size(tmp_path):
    frame = ingested(open_scene(made.photos(tmp_path)), max_side=16)[0]
    assert (frame.width, frame.height, frame.source_width, frame.source_height) == (16, 12, 32, 24)
    assert decode_rgb(frame).shape == (12, 16, 3)


def test_png_is_lossless_where_it_is_asked_for(tmp_path):
    made.write(tmp_path / "a.bmp", made.photo())
    frame = ingested(open_scene(tmp_path), jpeg_quality=0)[0]
    np.testing.assert_array_equal(decode_rgb(frame), made.photo()[..., ::-1])


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


def test_undistortion_makes_a_pinhole_of_the_same_intrinsics(tmp_path):
    """A white dot at a distorted place lands where the pinhole sees it; by hand: r' = r (1 + k r^2)."""
    k, focal = 0.5, 100.0
    image = np.zeros((101, 101, 3), np.uint8)
    distorted = 0.3 * (1 + k * 0.3**2) * focal
    column = int(np.floor(50.5 + distorted))
    image[49:52, column - 1 : column + 2] = 255
    made.write(tmp_path / "a.png", image)
    lens = Lens(101, 101, focal, focal, 50.5, 50.5, (k, 0.0, 0.0, 0.0))
    frame = frames(
        names=("a",), photos=(ref(tmp_path / "a.png"),), lenses=(lens,), params=IngestParams(jpeg_quality=0)
    )[0]
    bright = np.argwhere(decode_rgb(frame)[..., 0] > 128) + 0.5
    assert bright.mean(axis=0) == pytest.approx([50.5, 50.5 + 0.3 * focal], abs=0.6)
    valid = decode_valid(frame)
    assert valid[50, 50] and not valid[0, 0]


@pytest.mark.parametrize("k", [0.01, 0.05])
def test_undistortion_darkens_no_pixel_that_counts(tmp_path, k):
    made.write(tmp_path / "a.png", np.full((240, 320, 3), 200, np.uint8))
    lens = Lens(320, 240, 300, 300, 160, 120, (k, 0.0, 0.0, 0.0))
    photos, lossless = (ref(tmp_path / "a.png"),), IngestParams(jpeg_quality=0)
    (frame,) = frames(names=("a",), photos=photos, lenses=(lens,), params=lossless)
    valid = decode_valid(frame)
    assert 0.8 < valid.mean() < 1
    assert (decode_rgb(frame)[valid] == 200).all()
    plain = frames(names=("a",), photos=photos, params=lossless)
    found = replace(made.cameras_of(plain, k), intrinsics=np.array([[300.0, 300.0, 160.0, 120.0]]))
    (same,) = registered(plain, found)
    np.testing.assert_array_equal(decode_valid(same), valid)
    assert (decode_rgb(same)[valid] == 200).all()


def test_a_scaled_pixel_counts_only_when_all_of_it_does(tmp_path):
    made.scannet(tmp_path)
    mask = np.full((24, 32), 255, np.uint8)
    mask[0, 0] = 0
    made.write(tmp_path / "valid" / "2.png", mask)
    frame = ingested(open_scene(tmp_path), max_side=16)[0]
    valid = decode_valid(frame)
    assert not valid[0, 0] and valid.sum() == 12 * 16 - 1


def test_cameras_are_scaled_to_the_frames_and_carry_sparse_points(tmp_path):
    scene = open_scene(made.colmap(tmp_path))
    small = ingested(scene, max_side=16)
    result = cameras(
        small[1:], names=scene.names, lenses=scene.lenses, poses=scene.poses, metric=False, sparse=ref(scene.sparse)
    )
    assert result.names == ("10", "11")
    np.testing.assert_allclose(result.intrinsics, [[15, 15, 8, 6]] * 2)
    np.testing.assert_allclose(result.world_to_camera[0], np.linalg.inv(made.pose(1)), atol=1e-9)
    assert result.sparse_points.shape == (2, 3) and result.sizes.tolist() == [[16, 12]] * 2


def read_depth(scene, views):
    return depth(
        views,
        names=scene.names,
        files=refs(scene.depths),
        scale=scene.depth_scale,
        metric=scene.metric,
        lenses=scene.lenses,
        depth_lens=scene.depth_lens,
    )


def test_depth_is_in_metres_and_unknown_where_the_photo_is_ignored(tmp_path):
    made.scannet(tmp_path)
    mask = np.full((24, 32), 255, np.uint8)
    mask[:, :8] = 0
    made.write(tmp_path / "valid" / "10.png", mask)
    scene = open_scene(tmp_path)
    maps = read_depth(scene, ingested(scene))
    assert [m.name for m in maps] == ["2", "10", "11"] and maps[0].source == "sensor"
    np.testing.assert_allclose(maps[0].depth, np.full((12, 16), 1.0))
    np.testing.assert_allclose(maps[1].depth[:, 4:], 1.001)
    assert not maps[1].depth[:, :4].any()


def test_views_without_a_known_depth_are_warned_of_by_name(tmp_path):
    made.scannet(tmp_path)
    made.write(tmp_path / "depth" / "2.png", made.depth_image(0, 16, 12))
    made.write(tmp_path / "valid" / "11.png", np.zeros((24, 32), np.uint8))
    scene = open_scene(tmp_path)
    said = "2 views have no known depth, 0 everywhere or where the valid mask is not 0: 2, 11."
    with pytest.warns(UserWarning, match=re.escape(said)):
        maps = read_depth(scene, ingested(scene))
    assert [bool(m.depth.any()) for m in maps] == [False, True, False]


def test_depth_of_another_camera_is_registered_to_the_photo():
    """The depth camera sees twice the angle: its middle half fills the photo."""
    depth_lens, color = Lens(16, 12, 8, 8, 8, 6), Lens(32, 24, 32, 32, 16, 12)
    place = depth_to_color_map(depth_lens, color)
    assert place.shape == (12, 16, 2)
    np.testing.assert_allclose(place[0, 0], [8 - 7.5 / 2 - 0.5, 6 - 5.5 / 2 - 0.5])
    np.testing.assert_allclose(place[11, 15], [8 + 7.5 / 2 - 0.5, 6 + 5.5 / 2 - 0.5])


def test_registering_moves_pixels_only_where_the_cameras_differ(tmp_path):
    made.scannet(tmp_path)
    ramp = (1000 + np.arange(16, dtype=np.uint16))[None].repeat(12, axis=0)
    made.write(tmp_path / "depth" / "2.png", ramp)
    scene = open_scene(tmp_path)
    views = ingested(scene)
    np.testing.assert_allclose(read_depth(scene, views)[0].depth * 1000, ramp, rtol=1e-6)
    matrix = np.loadtxt(tmp_path / "intrinsic" / "intrinsic_depth.txt")
    matrix[0, 2] += 2
    np.savetxt(tmp_path / "intrinsic" / "intrinsic_depth.txt", matrix)
    scene = open_scene(tmp_path)
    moved = read_depth(scene, views)[0].depth
    np.testing.assert_allclose(moved[:, :14] * 1000, ramp[:, 2:], rtol=1e-6)
    assert not moved[:, 14:].any()


def test_the_depth_lens_of_another_size_is_refused(tmp_path):
    made.scannet(tmp_path)
    made.write(tmp_path / "depth" / "2.png", np.full((24, 32), 1000, np.uint16))
    scene = open_scene(tmp_path)
    with pytest.raises(InputError, match="far from the middle"):
        read_depth(scene, ingested(scene))


def test_float_depth_is_in_world_units_and_what_is_not_finite_is_unknown(tmp_path):
    made.scannet(tmp_path)
    values = np.full((12, 16), 2.5, np.float32)
    values[0, 0], values[0, 1], values[0, 2] = np.nan, np.inf, -1
    (tmp_path / "depth" / "2.png").unlink()
    made.write(tmp_path / "depth" / "2.tiff", values)
    scene = open_scene(tmp_path)
    found = read_depth(scene, ingested(scene))[0].depth
    assert not found[0, :3].any() and (found[1:] == 2.5).all()


@pytest.mark.parametrize("nothing", [65504, 1e10])
def test_what_a_renderer_writes_for_the_sky_is_no_depth(tmp_path, nothing):
    made.scannet(tmp_path)
    values = np.full((12, 16), 2.5, np.float32)
    values[:8], values[8, 0] = nothing, 200  # far, but there
    (tmp_path / "depth" / "2.png").unlink()
    made.write(tmp_path / "depth" / "2.tiff", values)
    scene = open_scene(tmp_path)
    frames = ingested(scene)
    with pytest.warns(UserWarning, match=r"for the sky: in 1 of 3 views, 2\."):
        found = read_depth(scene, frames)[0].depth
    assert not found[:8].any() and found[8, 0] == 200 and (found[9:] == 2.5).all()


def test_the_largest_number_of_sixteen_bits_is_no_depth(tmp_path):
    made.scannet(tmp_path)
    values = np.full((12, 16), 1000, np.uint16)
    values[0, :3] = 65535
    made.write(tmp_path / "depth" / "2.png", values)
    scene = open_scene(tmp_path)
    found = read_depth(scene, ingested(scene))[0].depth
    assert not found[0, :3].any() and (found[1:] == 1).all()


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


def test_ready_masks_become_one_mask_an_id_at_the_frames_size(tmp_path):
    made.photos(tmp_path)
    ids = np.zeros((24, 32), np.uint16)
    ids[:12, :16], ids[12:, 16:] = 700, 2
    for name in made.NAMES:
        made.write(tmp_path / "instance_masks" / f"{name}.png", ids if name != "11" else ids * 0)
    scene = open_scene(tmp_path)
    views = ingested(scene, max_side=16)
    first, _, empty = ready_masks(views, made.cameras_of(views), names=scene.names, files=refs(scene.ready_masks))
    assert first.dense().shape == (2, 12, 16)
    assert first.dense()[0, 6:, 8:].all() and first.dense()[0].sum() == 48
    assert first.dense()[1, :6, :8].all() and first.dense()[1].sum() == 48
    assert first.parent.tolist() == [-1, -1] and len(empty) == 0 and empty.dense().shape == (0, 12, 16)


@pytest.mark.parametrize(("colours", "bits"), [(3, 2), (200, 8)])
def test_ids_may_be_the_numbers_of_a_palettes_colours(tmp_path, colours, bits):
    made.photos(tmp_path)
    rng = np.random.default_rng(0)
    ids = rng.integers(0, colours, (24, 32), dtype=np.uint8)
    image = Image.fromarray(ids)
    image.putpalette(rng.integers(0, 256, 3 * colours, dtype=np.uint8).tobytes())
    (tmp_path / "instance").mkdir()
    image.save(tmp_path / "instance/2.png", transparency=0)
    assert (tmp_path / "instance/2.png").read_bytes()[24:26] == bytes([bits, 3])
    scene = open_scene(tmp_path)
    views = ingested(scene)
    (found,) = ground_truth(views, made.cameras_of(views), names=scene.names, files=refs(scene.ground_truth))
    np.testing.assert_array_equal(found.ids, ids)


def test_masks_of_photos_lose_the_distortion_that_structure_from_motion_found(tmp_path):
    """A square at a distorted place lands where the pinhole sees it; by hand: r' = r (1 + k r^2), focal length 101."""
    ids = np.zeros((101, 101), np.uint16)
    column = int(np.floor(50.5 + 0.3 * (1 + 0.5 * 0.3**2) * 101))
    ids[49:52, column - 1 : column + 2] = 7
    made.write(tmp_path / "a.png", made.photo(width=101, height=101))
    made.write(tmp_path / "instance_masks" / "a.png", ids)
    scene = open_scene(tmp_path)
    views = ingested(scene)
    given = made.cameras_of(views, radial=0.5), made.cameras_of(views)
    moved, kept = (ready_masks(views, c, names=scene.names, files=refs(scene.ready_masks))[0] for c in given)
    assert (np.argwhere(moved.dense()[0]) + 0.5).mean(axis=0) == pytest.approx([50.5, 50.5 + 0.3 * 101], abs=0.6)
    np.testing.assert_array_equal(kept.dense()[0], ids == 7)


def test_ground_truth_covers_the_annotated_views_only(tmp_path):
    scene = open_scene(made.scannet(tmp_path))
    (tmp_path / "instance" / "10.png").unlink()
    scene = open_scene(tmp_path)
    views = ingested(scene)
    maps = ground_truth(views, made.cameras_of(views), names=scene.names, files=refs(scene.ground_truth))
    assert [m.name for m in maps] == ["2", "11"]
    assert maps[0].ids.dtype == np.uint16 and (maps[0].ids == 3).all()


def test_ground_truth_without_an_instance_in_the_views_that_are_used_is_refused_before_all_else(tmp_path):
    made.scannet(tmp_path)
    for name in ("10", "11"):
        (tmp_path / "instance" / f"{name}.png").unlink()
    annotated = open_scene(tmp_path)
    made.write(tmp_path / "instance" / "2.png", np.zeros((made.HEIGHT, made.WIDTH), np.uint16))
    for scene in (annotated.pick([1, 2]), open_scene(tmp_path)):
        views = ingested(scene)
        with pytest.raises(InputError, match=rf"instance/ holds no instance in any of the {len(views)} views"):
            ground_truth(views, made.cameras_of(views), names=scene.names, files=refs(scene.ground_truth))


def test_a_jpeg_with_a_thumbnail_and_bytes_after_its_end_is_whole(tmp_path):
    jpeg = cv2.imencode(".jpg", made.photo())[1].tobytes()
    thumbnail = b"JFXX\0\x10" + jpeg
    segment = b"\xff\xe0" + struct.pack(">H", len(thumbnail) + 2) + thumbnail
    (tmp_path / "a.jpg").write_bytes(jpeg[:2] + segment + jpeg[2:] + b"maker notes")
    assert read_photo(tmp_path / "a.jpg").width == 32
    progressive = cv2.imencode(".jpg", made.photo(), [cv2.IMWRITE_JPEG_PROGRESSIVE, 1])[1].tobytes()
    (tmp_path / "b.jpg").write_bytes(progressive)
    assert read_photo(tmp_path / "b.jpg").height == 24
