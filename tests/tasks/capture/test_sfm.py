import os
from dataclasses import replace

import numpy as np
import pytest
from generated_views import views

from ss_flow.errors import InputError
from ss_flow.tasks.artifacts import Cameras, Frame
from ss_flow.tasks.capture.sfm import registered, sfm
from ss_flow.tasks.geometry.images import decode_rgb, decode_valid, encode_png

EYES = [(x, y, 0.1 * x) for x in (-0.9, -0.3, 0.3, 0.9) for y in (-0.3, 0.3)]


@pytest.fixture(scope="module")
def scene():
    return views(EYES, width=320, height=240, focal=300.0)


@pytest.fixture(scope="module")
def found(scene):
    return sfm(scene[0])


def aligned_centers(estimated: Cameras, true: Cameras) -> tuple[np.ndarray, np.ndarray, float]:
    """Camera centres of both in the true frame after the best similarity (Umeyama 1991), and its scale."""

    def centers(poses):
        return -np.einsum("kji,kj->ki", poses[:, :3, :3], poses[:, :3, 3])

    a, b = centers(estimated.world_to_camera), centers(true.world_to_camera)
    a0, b0 = a - a.mean(0), b - b.mean(0)
    u, s, vt = np.linalg.svd(b0.T @ a0)
    sign = np.diag([1, 1, np.sign(np.linalg.det(u @ vt))])
    scale = np.trace(np.diag(s) @ sign) / (a0**2).sum()
    return scale * a0 @ (u @ sign @ vt).T, b0, float(scale)


def test_poses_of_a_generated_scene_are_found_up_to_a_similarity(scene, found):
    _, true, _ = scene
    estimated, expected, _ = aligned_centers(found, true)
    assert found.names == true.names
    assert not found.metric
    assert np.linalg.norm(estimated - expected, axis=1).max() < 0.02
    assert found.intrinsics[:, :2] == pytest.approx(300.0, rel=0.02)
    assert len(found.sparse_points) > 100


def test_two_runs_agree_to_the_bit(scene, found):
    again = sfm(scene[0])
    for field in ("intrinsics", "world_to_camera", "sparse_points", "radial"):
        np.testing.assert_array_equal(getattr(again, field), getattr(found, field))


def test_a_photo_of_something_else_is_left_out_and_dropped_from_the_frames(scene):
    frames = scene[0]
    noise = np.random.default_rng(0).integers(0, 255, (240, 320, 3), dtype=np.uint8)
    stray = Frame("stray", 320, 240, encode_png(noise), np.zeros(0, np.uint8), 320, 240)
    cameras = sfm((frames[0], stray, *frames[1:]))
    assert cameras.names == tuple(f.name for f in frames)
    assert tuple(f.name for f in registered((frames[0], stray, *frames[1:]), cameras)) == cameras.names


def test_photos_that_do_not_overlap_are_refused_with_their_number(scene, tmp_path, monkeypatch):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    random = np.random.default_rng(1)
    none = np.zeros(0, np.uint8)
    frames = tuple(
        Frame(f"n{i}", 160, 120, encode_png(random.integers(0, 255, (120, 160, 3), dtype=np.uint8)), none, 160, 120)
        for i in range(4)
    )
    with pytest.raises(InputError, match="only 0 of 4 photos found their pose") as refusal:
        sfm(frames)
    assert "\n" not in str(refusal.value)
    assert os.listdir(tmp_path) == []


def test_two_photos_are_too_few(scene):
    with pytest.raises(InputError, match="at least 3"):
        sfm(scene[0][:2])


def test_frames_of_a_pinhole_keep_their_bytes_and_others_are_straightened(scene):
    frames, true, _ = scene
    assert registered(frames, true)[0].encoded is frames[0].encoded
    bent = replace(true, radial=np.full(len(true), 0.2))
    straight = registered(frames, bent)[0]
    image, original = decode_rgb(straight), decode_rgb(frames[0])
    # By hand: a pixel 80.5 from the centre shows what lay at 80.5 (1 + 0.2 (80.5 / 300)^2) = 81.66 from it.
    expected = 0.16 * original[120, 242].astype(float) + 0.84 * original[120, 241]
    assert np.abs(image[120, 240] - expected).max() < 3
    assert np.abs(original[120, 240] - expected).max() > 3
    assert (straight.width, straight.height) == (320, 240)
    assert decode_valid(straight)[120, 160]
    assert not decode_valid(straight)[0, 0]
