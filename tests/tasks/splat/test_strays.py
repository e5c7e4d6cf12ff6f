"""What stands apart from its instance, where views show others, becomes the background's."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from ball_and_box import SmallScene

from ss_flow.tasks.artifacts import Gaussians, LabelMap
from ss_flow.tasks.gaussians.initialise import NO_GAUSSIANS, concatenate, initialise, select
from ss_flow.tasks.gaussians.render import render
from ss_flow.tasks.geometry.cameras import Camera, project
from ss_flow.tasks.splat.strays import without_strays

FLOOR, BOX, BALL = 0, 1, 2


def far_from_ball(scene: Gaussians, count: int) -> np.ndarray:
    """[count] neighbouring rows of the floor, from the one that lies farthest from the ball on."""
    middle = scene.means[scene.instance_id == BALL].mean(axis=0)
    floor = np.flatnonzero(scene.instance_id == FLOOR)
    places = scene.means[floor]
    farthest = places[np.linalg.norm(places - middle, axis=1).argmax()]
    return floor[np.argsort(np.linalg.norm(places - farthest, axis=1))[:count]]


def clump(of: Gaussians, middle: np.ndarray) -> Gaussians:
    """Six faint Gaussians beside each other."""
    six = select(of, np.arange(6))
    places = middle + 0.01 * np.random.default_rng(0).normal(size=(6, 3))
    return replace(six, means=places.astype(np.float32), log_scales=np.full((6, 3), -9, np.float32))


def given(scene: Gaussians, rows: np.ndarray, instance: int) -> Gaussians:
    labels = scene.instance_id.copy()
    labels[rows] = instance
    return replace(scene, instance_id=labels)


def cleaned(small: SmallScene, scene: Gaussians, maps: list[LabelMap] | None = None) -> Gaussians:
    return without_strays(small.views.cameras, scene, small.maps if maps is None else maps)


def shown_as(small: SmallScene, instance: int, places: np.ndarray, reach: float) -> list[LabelMap]:
    """The maps of all views, in which what is within so many pixels of these projected places is the instance's."""
    maps = []
    for camera, shown in zip(small.views.cameras, small.maps, strict=True):
        ids = shown.ids.copy()
        y, x = np.indices(ids.shape) + 0.5
        for u, v in project(places, camera)[0]:
            ids[np.hypot(x - u, y - v) < reach] = instance
        maps.append(replace(shown, ids=ids))
    return maps


def test_a_scene_whose_instances_are_whole_stays_as_it_is(small, scene):
    found = cleaned(small, scene)
    assert np.array_equal(found.instance_id, scene.instance_id)
    assert np.array_equal(found.part_id, scene.part_id)


def test_gaussians_far_off_that_views_show_as_something_else_become_the_background(small, scene):
    rows = far_from_ball(scene, 6)
    found = cleaned(small, given(scene, rows, BALL))
    assert (found.instance_id[rows] == FLOOR).all() and (found.part_id[rows] == 0).all()
    rest = np.setdiff1d(np.arange(len(scene)), rows)
    assert np.array_equal(found.instance_id[rest], scene.instance_id[rest])
    assert np.array_equal(found.part_id[rest], scene.part_id[rest])
    for name in ("means", "quaternions", "log_scales", "opacity_logits", "sh"):
        assert getattr(found, name) is getattr(scene, name)


def test_a_piece_far_off_stays_where_views_show_it_as_the_instance(small, scene):
    rows = far_from_ball(scene, 6)
    piece = given(scene, rows, BALL)
    maps = shown_as(small, BALL, scene.means[rows], 8)
    assert (cleaned(small, piece, maps).instance_id[rows] == BALL).all()


def test_the_piece_that_weighs_most_in_its_own_pixels_stays_however_little_that_is(small, scene):
    rows = far_from_ball(scene, 6)
    nowhere = [replace(m, ids=np.where(m.ids == BALL, BOX, m.ids).astype(np.uint16)) for m in small.maps]
    nowhere[0] = small.maps[0]
    found = cleaned(small, given(scene, rows, BALL), nowhere)
    assert (found.instance_id[rows] == FLOOR).all()
    assert (found.instance_id[scene.instance_id == BALL] == BALL).all()


def test_what_no_view_sees_far_off_becomes_the_background(small, scene):
    behind = select(scene, np.flatnonzero(scene.instance_id == BALL)[:5])
    unseen = replace(behind, means=behind.means + np.array([0, 0, 50], np.float32))
    found = cleaned(small, concatenate([scene, unseen]))
    assert (found.instance_id[len(scene) :] == FLOOR).all()
    assert np.array_equal(found.instance_id[: len(scene)], scene.instance_id)


def test_what_lies_in_the_box_of_its_instance_stays_though_views_show_something_else_there(small, scene):
    ball = select(scene, scene.instance_id == BALL)
    low, high = ball.means.min(axis=0), ball.means.max(axis=0)
    for middle, stays in (((low + high) / 2, True), ((low + high) / 2 + 1.5 * (high - low), False)):
        piece = clump(ball, middle)
        found = cleaned(small, concatenate([scene, piece]), shown_as(small, BOX, piece.means, 4))
        assert (found.instance_id[-6:] == (BALL if stays else FLOOR)).all()


def test_a_single_one_that_hangs_near_its_instance_becomes_the_background_wherever_it_shows(small, scene):
    ball = select(scene, scene.instance_id == BALL)
    above = ball.means[ball.means[:, 2].argmax()] + np.array([[0, 0, 0.12]], np.float32)
    many = replace(select(ball, np.arange(6)), means=above + np.float32(0.01) * np.eye(6, 3, dtype=np.float32))
    for some, stays in ((select(many, [0]), False), (many, True)):
        found = cleaned(small, concatenate([scene, some]), shown_as(small, BALL, some.means, 6))
        assert (found.instance_id[len(scene) :] == (BALL if stays else FLOOR)).all()
        assert np.array_equal(found.instance_id[: len(scene)], scene.instance_id)


@pytest.mark.parametrize(("view", "stays"), [(7, False), (1, True)])
def test_a_piece_stays_with_half_of_its_weight_in_pixels_of_its_instance(small, scene, view, stays):
    """Two views see the piece, with 45 and 55 % of its weight; one of them shows it as the instance."""
    rows = far_from_ball(scene, 6)
    shown = shown_as(small, BALL, scene.means[rows], 8)
    maps = [*small.maps[:view], shown[view], *small.maps[view + 1 :]]
    found = cleaned(small, given(scene, rows, BALL), maps)
    assert (found.instance_id[rows] == (BALL if stays else FLOOR)).all()


def test_few_gaussians_and_none_stay(small, scene):
    assert len(cleaned(small, NO_GAUSSIANS)) == 0
    few = select(scene, np.flatnonzero(scene.instance_id == BALL)[[0, -1]])
    assert np.array_equal(cleaned(small, few).instance_id, few.instance_id)


def square(middle: tuple[float, float, float], side: float, count: int, instance: int) -> Gaussians:
    """count x count solid Gaussians that face the camera."""
    x, y = np.meshgrid(*2 * [(np.arange(count) - (count - 1) / 2) * side / count])
    places = np.stack([x, y, np.zeros_like(x)], axis=-1).reshape(-1, 3).astype(np.float32) + np.float32(middle)
    return initialise(places, np.full(places.shape, 128, np.uint8), instance, 1.0, opacity=0.95)


@pytest.mark.parametrize("wide", [640, 1600])
def test_a_small_piece_that_lies_in_its_own_pixels_stays_however_large_the_photos_are(wide):
    pieces = [
        square((0, 0, 2.5), 2, 90, FLOOR),
        square((-0.3, 0, 2), 0.24, 30, BALL),
        square((0.3, 0.1, 2), 0.024, 3, BALL),
    ]
    scene = concatenate(pieces)
    cameras, maps = [], []
    for x, y in ((0, 0), (0.1, 0.03), (-0.1, 0.05), (0.05, -0.1)):
        pose = np.eye(4)
        pose[:2, 3] = x, y
        cameras.append(Camera(wide, wide * 3 // 4, 0.8 * wide, 0.8 * wide, wide / 2, wide * 3 / 8, pose))
        shown = render(scene, cameras[-1], label_ids=[FLOOR, BALL], winners=False).label_masks.argmax(axis=0)
        maps.append(LabelMap("v", np.where(shown == 1, BALL, FLOOR).astype(np.uint16)))
    assert np.array_equal(without_strays(cameras, scene, maps).instance_id, scene.instance_id)
