from __future__ import annotations

import numpy as np

from ss_flow.tasks.artifacts import Gaussians
from ss_flow.tasks.evaluate.objects import change_elsewhere, dark_fringe, floaters, fringe_share
from ss_flow.tasks.gaussians.initialise import concatenate, initialise
from ss_flow.tasks.geometry.cameras import Camera

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
