from __future__ import annotations

from dataclasses import replace

import numpy as np

from ss_flow.tasks.artifacts import Gaussians
from ss_flow.tasks.evaluate.objects import (
    Likeness,
    cameras_beside,
    change_elsewhere,
    dark_fringe,
    floaters,
    fringe_share,
    needles,
)
from ss_flow.tasks.gaussians.initialise import concatenate, initialise
from ss_flow.tasks.geometry.cameras import Camera, pixels_in_view

CAMERA = Camera(64, 64, 64.0, 64.0, 32.0, 32.0, np.eye(4))
ROW, COLUMN = np.mgrid[:64, :64]
FROM_CENTRE = np.hypot(ROW - 31.5, COLUMN - 31.5)


def disc(rim: float) -> tuple[np.ndarray, np.ndarray]:
    """A disc of radius 20 with a soft outline, grey inside, of tone `rim` in its outer 2 pixels; premultiplied."""
    alpha = np.clip(20.5 - FROM_CENTRE, 0, 1).astype(np.float32)
    tone = np.where(FROM_CENTRE < 18, 0.6, rim).astype(np.float32)
    return (tone * alpha)[..., None].repeat(3, axis=2), alpha


def test_a_dark_rim_is_a_fringe_and_a_rim_like_the_inside_is_none():
    dark = dark_fringe(*disc(0.1))
    assert dark[(FROM_CENTRE > 18) & (FROM_CENTRE < 20)].all()
    assert not dark[FROM_CENTRE < 17].any() and not dark[FROM_CENTRE > 21].any()
    assert not dark_fringe(*disc(0.6)).any()
    assert not dark_fringe(*disc(0.9)).any()


def test_an_object_that_is_dark_inside_has_no_fringe():
    rgb, alpha = disc(0.1)
    assert not dark_fringe(np.minimum(rgb, 0.1), alpha).any()


def square(side: float, depth: float, instance_id: int, at: float = 0.0) -> Gaussians:
    places = np.linspace(-side, side, 25)
    x, y = np.meshgrid(places + at, places)
    points = np.stack([x.ravel(), y.ravel(), np.full(x.size, depth)], axis=1).astype(np.float32)
    return initialise(points, np.full((x.size, 3), 150, np.uint8), instance_id, 1.0, opacity=0.99)


def test_the_share_of_fringe_counts_the_pixels_that_show_the_object():
    dark, shown = fringe_share(square(0.5, 2, 1), CAMERA)
    assert dark == 0
    assert 32**2 <= shown < 44**2  # the square, and what its outermost Gaussians reach beyond it


def test_what_lies_off_the_points_is_a_floater():
    points = square(0.5, 2, 1).means
    spacing = 1 / 24
    off = points[:3] + np.float32([[0, 0, 2.9 * spacing], [0, 0, 3.1 * spacing], [0, 0, 1]])
    gaussians = initialise(np.concatenate([points, off]), np.zeros((len(points) + 3, 3), np.uint8), 1, 1.0)
    assert np.flatnonzero(floaters(gaussians, points)).tolist() == [len(points) + 1, len(points) + 2]
    assert not floaters(gaussians, points[:1]).any()


def test_taking_an_object_away_changes_what_its_mask_leaves_out():
    left, right = square(0.3, 2, 1, at=-0.6), square(0.3, 2, 2, at=0.6)
    scene = concatenate([left, right])
    around = np.abs(COLUMN - 51) < 14
    assert change_elsewhere(scene, 2, CAMERA, around) < 1e-4
    assert change_elsewhere(scene, 2, CAMERA, ~around) > 0.1
    assert change_elsewhere(scene, 2, CAMERA, np.ones((64, 64), bool)) == 0


def test_a_needle_is_long_in_one_direction_only():
    gaussians = square(0.5, 2, 1)
    scales = np.full((len(gaussians), 3), 0.01, np.float32)
    scales[0] = 0.011, 0.12, 0.01  # a needle
    scales[1] = 0.12, 0.001, 0.12  # a disc
    scales[2] = 0.09, 0.01, 0.001  # nine times as long as wide
    long = replace(gaussians, log_scales=np.log(scales))
    assert np.flatnonzero(needles(long)).tolist() == [0]


def arc(*degrees: float) -> list[Camera]:
    """Cameras at a distance of 2 round the origin, at its height, y down, that look at it."""
    cameras = []
    for angle in np.radians(degrees):
        out = np.array([np.sin(angle), 0, -np.cos(angle)])
        pose = np.eye(4)
        pose[:3, :3] = np.stack([np.cross((0, 1, 0), -out), (0, 1, 0), -out])
        pose[2, 3] = 2
        cameras.append(Camera(64, 48, 50.0, 50.0, 32.0, 24.0, pose))
    return cameras


def test_new_views_stand_beside_all_old_ones_and_show_the_object_whole():
    old = arc(-20, 0, 20)
    new = cameras_beside(old, np.zeros(3), 0.3, degrees=35, count=8)
    assert len(new) == 8
    seen = np.stack([camera.center / 2 for camera in old])
    for camera in new:
        np.testing.assert_allclose(np.linalg.norm(camera.center), 2)
        np.testing.assert_allclose(
            camera.world_to_camera[:3, :3] @ camera.world_to_camera[:3, :3].T, np.eye(3), atol=1e-9
        )
        assert abs(np.degrees(np.arccos((seen @ camera.center / 2).max())) - 35) < 2.1
        sphere = np.random.default_rng(0).normal(size=(200, 3))
        sphere *= 0.3 / np.linalg.norm(sphere, axis=1, keepdims=True)
        assert len(pixels_in_view(sphere, camera)[0]) == 200
        assert camera.world_to_camera[1, 1] > 0  # upright, as the old ones are
    places = np.stack([camera.center for camera in new])
    apart = np.linalg.norm(places[:, None] - places, axis=2) + 9 * np.eye(8)
    assert apart.min() > 0.5


def test_where_every_direction_was_seen_no_view_is_beside():
    around = arc(*range(0, 360, 30))
    poles = [replace(around[0], world_to_camera=around[0].world_to_camera @ np.array(
        [[1, 0, 0, 0], [0, 0, s, 0], [0, -s, 0, 0], [0, 0, 0, 1.0]])) for s in (1, -1)]  # fmt: skip
    assert cameras_beside([*around, *poles], np.zeros(3), 0.3, degrees=60) == []
    assert cameras_beside(around, np.zeros(3), 0.3, degrees=60)


def test_likeness_of_views_adds_up():
    rgb, alpha = disc(0.6)
    everywhere = np.ones(alpha.shape, bool)
    same = Likeness.of(rgb, alpha, rgb, alpha, everywhere)
    assert (same.psnr, same.iou) == (100, 1)
    nothing = Likeness.of(np.zeros_like(rgb), np.zeros_like(alpha), rgb, alpha, everywhere)
    solid = int((alpha > 0.5).sum())
    assert (nothing.both, nothing.either, nothing.channels, nothing.iou) == (0, solid, 3 * solid, 0)
    both = same + nothing
    assert both.iou == 0.5
    np.testing.assert_allclose(nothing.error, 3 * np.square(0.4 * alpha[alpha > 0.5]).sum(), rtol=1e-5)  # before white
    left = Likeness.of(np.zeros_like(rgb), np.zeros_like(alpha), rgb, alpha, COLUMN < 32)
    assert left.either * 2 == solid
    assert Likeness.of(rgb, alpha, rgb, alpha, ~everywhere).iou == 1


def test_a_dark_fringe_and_a_hole_cost_likeness():
    rgb, alpha = disc(0.6)
    everywhere = np.ones(alpha.shape, bool)
    fringe = Likeness.of(*disc(0.1), rgb, alpha, everywhere)
    assert fringe.iou == 1 and fringe.psnr < 20
    hole = np.where(FROM_CENTRE < 5, 0, alpha).astype(np.float32)
    holed = Likeness.of(0.6 * hole[..., None].repeat(3, axis=2), hole, rgb, alpha, everywhere)
    assert 0.9 < holed.iou < 1 and holed.psnr < 25
