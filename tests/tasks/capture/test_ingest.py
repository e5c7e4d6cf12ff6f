"""Photos become frames: scaled, without distortion, and with cameras of the same size."""

import shutil
from dataclasses import replace

import capture_folders as made
import numpy as np
import pytest
from capture_folders import ingested, ref

from ss_flow.tasks.capture.ingest import IngestParams, cameras, frames
from ss_flow.tasks.capture.lens import Lens
from ss_flow.tasks.capture.scene import open_scene
from ss_flow.tasks.capture.sfm import registered
from ss_flow.tasks.geometry.images import decode_rgb, decode_valid


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


def test_intrinsics_without_a_size_are_scaled_to_photos_that_were_scaled_since(tmp_path):
    made.scannet(tmp_path)
    shutil.rmtree(tmp_path / "valid")
    for name in made.NAMES:
        made.write(tmp_path / "color" / f"{name}.jpg", made.photo(width=48, height=36))
    scene = open_scene(tmp_path)
    given = {"names": scene.names, "lenses": scene.lenses, "poses": scene.poses, "metric": True}
    with pytest.warns(UserWarning, match=r"3 of 3 views, the first of 48 x 36, though .* of about 32 x 24"):
        result = cameras(ingested(scene), **given)
    np.testing.assert_allclose(result.intrinsics, [[45, 45, 24, 18]] * 3)


@pytest.mark.parametrize(
    "lens",
    [
        Lens(0, 0, 30, 30, 20, 15),  # a quarter beside the middle: no other size
        Lens(0, 0, 30, 30, 24, 12),  # one axis alone
        Lens(32, 24, 30, 30, 24, 18),  # a size that is stated holds
    ],
)
def test_a_principal_point_beside_the_middle_is_taken_as_it_is(lens):
    assert lens.of_photo(32, 24) == (32, 24) and lens.scaled(32, 24) == replace(lens, width=32, height=24)
