"""Depth that came with the photos: its units, its place in the photo, and where it is unknown."""

import re

import capture_folders as made
import cv2
import numpy as np
import pytest
from capture_folders import ingested, refs

from ss_flow.errors import InputError
from ss_flow.tasks.capture.lens import Lens, depth_to_color_map
from ss_flow.tasks.capture.scene import open_scene
from ss_flow.tasks.capture.sensor_depth import depth


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
    matrix = np.loadtxt(tmp_path / "intrinsic" / "intrinsic_depth.txt")
    matrix[0, 2] *= 2
    np.savetxt(tmp_path / "intrinsic" / "intrinsic_depth.txt", matrix)
    scene = open_scene(tmp_path)
    with pytest.raises(InputError, match="far from the middle"):
        read_depth(scene, ingested(scene))


def test_the_depth_lens_of_scaled_depth_is_scaled_with_it(tmp_path):
    made.scannet(tmp_path)
    scene = open_scene(tmp_path)
    as_it_was = read_depth(scene, ingested(scene))[0].depth
    stored = cv2.imread(str(tmp_path / "depth" / "2.png"), cv2.IMREAD_UNCHANGED)
    made.write(tmp_path / "depth" / "2.png", stored.repeat(2, axis=0).repeat(2, axis=1))
    scene = open_scene(tmp_path)
    with pytest.warns(
        UserWarning, match=r"scaled to its images.*: 1 of . views, the first of 32 x 24 instead of about 16 x 12"
    ):
        twice = read_depth(scene, ingested(scene))[0].depth
    np.testing.assert_array_equal(twice, as_it_was.repeat(2, axis=0).repeat(2, axis=1))


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
