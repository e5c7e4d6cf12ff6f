"""Colours that a view kept back is expected to have: from the photos beside it and from how bright a rendering is."""

from dataclasses import replace

import numpy as np
import pytest

from ss_flow.tasks.artifacts import ColourTransform, Gaussians
from ss_flow.tasks.evaluate.neighbour_colours import NeighbourColours
from ss_flow.tasks.gaussians.initialise import initialise
from ss_flow.tasks.gaussians.render import render
from ss_flow.tasks.geometry.cameras import Camera

ACROSS = np.linspace(0.0, 7.0, 8)


def wall() -> Gaussians:
    """Opaque, two units before the cameras, dark on the left and bright on the right."""
    x, y = np.meshgrid(np.linspace(-3, 10, 131), np.linspace(-2, 2, 41))
    points = np.stack([x.ravel(), y.ravel(), np.full(x.size, 2.0)], axis=1).astype(np.float32)
    grey = np.clip(40 + 15 * (points[:, :1] + 3), 0, 255).astype(np.uint8)
    return initialise(points, np.repeat(grey, 3, axis=1), 1, 1.0, opacity=0.99)


def camera_at(x: float) -> Camera:
    pose = np.eye(4)
    pose[0, 3] = -x
    return Camera(64, 48, 60.0, 60.0, 32.0, 24.0, pose)


def transforms(gains: np.ndarray) -> list[ColourTransform]:
    """Of photos that are brighter than the scene by their gains."""
    matrices = [np.hstack([np.eye(3) / gain, np.zeros((3, 1))]) for gain in gains]
    return [ColourTransform(f"frame{i}", "frame0", matrix) for i, matrix in enumerate(matrices)]


def test_a_view_between_two_photos_has_the_mean_of_their_colours() -> None:
    even = replace(wall(), sh=np.zeros_like(wall().sh))  # as bright everywhere, so there is nothing to meter
    gains = np.linspace(0.6, 1.3, 8)
    beside = NeighbourColours.of(even, [camera_at(x) for x in ACROSS], transforms(gains))
    image = np.full((4, 4, 3), 0.5, np.float32)
    between = beside.applied(image, "frame2b", even, camera_at(2.5))
    np.testing.assert_allclose(between, 0.5 * (gains[2] + gains[3]) / 2, atol=1e-3)
    for name, row in (("frame", 0), ("frame99", 7)):
        np.testing.assert_allclose(beside.applied(image, name, even, camera_at(0)), 0.5 * gains[row], atol=1e-3)


def test_frames_are_ordered_by_their_numbers() -> None:
    even = replace(wall(), sh=np.zeros_like(wall().sh))
    named = [replace(one, name=name) for one, name in zip(transforms(np.array([0.5, 1.0])), ("9", "10"), strict=True)]
    beside = NeighbourColours.of(even, [camera_at(0), camera_at(1)], named)
    image = np.full((2, 2, 3), 0.4, np.float32)
    np.testing.assert_allclose(beside.applied(image, "8", even, camera_at(0)), 0.2, atol=1e-3)
    np.testing.assert_allclose(beside.applied(image, "11", even, camera_at(0)), 0.4, atol=1e-3)


def test_a_camera_that_holds_the_mean_brightness_is_followed_to_a_bright_view() -> None:
    scene, cameras = wall(), [camera_at(x) for x in ACROSS[[0, 2, 1, 4, 3, 6, 5, 7]]]
    means = np.array([render(scene, camera).rgb.mean() for camera in cameras])
    beside = NeighbourColours.of(scene, cameras, transforms(0.4 / means))
    assert beside.metering == pytest.approx(-1, abs=0.1)
    there = camera_at(6.5)
    rendering = render(scene, there).rgb
    metered = beside.applied(rendering, "frame1b", scene, there).mean()
    of_neighbours = replace(beside, metering=0.0).applied(rendering, "frame1b", scene, there).mean()
    assert abs(metered - 0.4) < 0.02 < 0.1 < abs(of_neighbours - 0.4)


def test_photos_of_one_exposure_change_nothing() -> None:
    scene = wall()
    beside = NeighbourColours.of(scene, [camera_at(x) for x in ACROSS], transforms(np.ones(8)))
    assert beside.metering == 0
    image = np.random.default_rng(0).random((4, 6, 3)).astype(np.float32)
    np.testing.assert_allclose(beside.applied(image, "frame3b", scene, camera_at(3.5)), image, atol=1e-6)


def test_a_single_photo_gives_its_colours_to_all_others() -> None:
    scene = wall()
    beside = NeighbourColours.of(scene, [camera_at(0)], transforms(np.array([0.5])))
    image = np.full((2, 2, 3), 0.6, np.float32)
    np.testing.assert_allclose(beside.applied(image, "other", scene, camera_at(5)), 0.3, atol=1e-6)
