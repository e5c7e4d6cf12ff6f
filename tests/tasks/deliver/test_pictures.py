"""Pictures of Gaussians, and films of them."""

from __future__ import annotations

import resource
from dataclasses import replace

import cv2
import numpy as np
import pytest
from made_gaussians import made_cameras, made_gaussians

from ss_flow.errors import InputError
from ss_flow.tasks.artifacts import Gaussians
from ss_flow.tasks.deliver.export.content import FileContent
from ss_flow.tasks.deliver.pictures import film, picture
from ss_flow.tasks.gaussians.initialise import SH_ZERO, select
from ss_flow.tasks.geometry.cameras import camera_of
from ss_flow.tasks.geometry.images import encode_png

CAMERA = camera_of(made_cameras(), 0)


def disc() -> Gaussians:
    """One wide, opaque, red Gaussian of instance 7 in front of the camera, 3.2 units away."""
    one = made_gaussians(1, 0)
    return replace(
        one,
        means=np.zeros((1, 3), np.float32),
        log_scales=np.full((1, 3), -1.0, np.float32),
        opacity_logits=np.full(1, 9.0, np.float32),
        sh=np.array([[[0.5, -0.5, -0.5]]], np.float32) / SH_ZERO,
        instance_id=np.array([7], np.int32),
    )


def pixels_of(file) -> np.ndarray:
    return cv2.imdecode(file.content, cv2.IMREAD_UNCHANGED)


def shown(gaussians, what, width=0, camera=CAMERA):
    return picture(gaussians, camera, what=what, width=width, depth_unit=0.001)


def test_colour_is_that_of_the_gaussian_over_white():
    pixels = pixels_of(shown(disc(), "colour"))[..., ::-1]
    np.testing.assert_allclose(pixels[48, 48], (255, 3, 3), atol=3)
    np.testing.assert_array_equal(pixels_of(shown(select(disc(), np.zeros(0, int)), "colour")), 255)


def test_labels_are_ids_where_the_scene_is_solid():
    ids = pixels_of(shown(disc(), "labels"))
    assert ids.dtype == np.uint16 and ids[48, 48] == 7 and ids[0, 0] == 0


@pytest.mark.parametrize(("front", "label"), [(0.45, 7), (0.55, 0)])
def test_a_label_is_of_the_instance_that_weighs_most_not_of_the_heaviest_gaussian(front, label):
    """A Gaussian of the background before two of an instance, which make up .28 and .22 of a pixel, or .23 and .18."""
    three = select(disc(), np.zeros(3, int))
    opacity = np.array([front, 0.5, 0.8], np.float32)
    scene = replace(
        three,
        means=np.outer([0, 0.05, 0.1], CAMERA.world_to_camera[2, :3]).astype(np.float32),
        opacity_logits=np.log(opacity / (1 - opacity)),
        instance_id=np.array([0, 7, 7], np.int32),
    )
    assert pixels_of(shown(scene, "labels"))[48, 48] == label


def test_depth_is_in_thousandths_and_zero_where_there_is_none():
    depth = pixels_of(shown(disc(), "depth"))
    assert depth.dtype == np.uint16 and abs(int(depth[48, 48]) - 3200) <= 1 and depth[0, 0] == 0


def test_alpha_is_the_share_of_the_scene():
    alpha = pixels_of(shown(disc(), "alpha"))
    assert alpha.dtype == np.uint8 and alpha[48, 48] >= 250 and alpha[0, 0] < 40


def test_a_width_scales_the_whole_picture():
    assert pixels_of(shown(disc(), "alpha", width=30)).shape == (30, 30)


@pytest.mark.parametrize("what", ["colour", "labels", "depth", "alpha"])
def test_a_film_has_all_frames_even_sizes_and_the_same_bytes_again(tmp_path, what):
    scene = made_gaussians(200, 0)
    pictures = [shown(scene, what, 33, camera_of(made_cameras(), view)) for view in (0, 1, 0)]
    first, second = film(pictures, what=what, fps=5), film(pictures, what=what, fps=5)
    np.testing.assert_array_equal(first.content, second.content)
    (tmp_path / "a.mp4").write_bytes(first.content.tobytes())
    video = cv2.VideoCapture(str(tmp_path / "a.mp4"))
    frames = []
    while (read := video.read())[0]:
        frames.append(read[1].astype(int))
    assert [frame.shape for frame in frames] == [(34, 34, 3)] * 3
    same, other = np.abs(frames[0] - frames[2]).mean(), np.abs(frames[0] - frames[1]).mean()
    assert 2 * same < other  # the code loses colour at the edges of so small a picture


def test_pictures_of_several_sizes_make_no_film():
    with pytest.raises(InputError, match="pictures of 2 sizes"):
        film([shown(disc(), "alpha", 20), shown(disc(), "alpha", 30)], what="alpha", fps=5)


def test_a_film_that_finds_no_room_is_no_film():
    noise = np.random.default_rng(0).integers(0, 256, (12, 96, 96, 3), np.uint8)
    frames = [FileContent(encode_png(one)) for one in noise]
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (16384, hard))  # as a disk of so many bytes
    try:
        with pytest.raises(OSError, match=r"could not be written whole to .*; is there room\?"):
            film(frames, what="colour", fps=24)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert len(film(frames, what="colour", fps=24).content) > 16384
