"""Gaussians whose place shows another instance get its label."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from ball_and_box import VIEWS, SmallScene

from ss_flow.tasks.artifacts import Gaussians, LabelMap
from ss_flow.tasks.gaussians.initialise import select
from ss_flow.tasks.gaussians.render import render
from ss_flow.tasks.gaussians.views import SceneViews
from ss_flow.tasks.geometry.images import encode_png, size_within
from ss_flow.tasks.geometry.visibility import VisibilityParams
from ss_flow.tasks.masks.overlap import iou
from ss_flow.tasks.splat import relabel
from ss_flow.tasks.splat.relabel import relabelled, shown_masks

FLOOR, BOX, BALL = 0, 1, 2


def compared(small: SmallScene) -> SceneViews:
    return small.views.compared(VisibilityParams())


def mislabelled(scene: Gaussians) -> tuple[Gaussians, np.ndarray]:
    """A fifth of the ball given to the box."""
    rows = np.flatnonzero(scene.instance_id == BALL)[::5]
    wrong = scene.instance_id.copy()
    wrong[rows] = BOX
    return replace(scene, instance_id=wrong), rows


def seen_from(small: SmallScene, maps: list[LabelMap], instance: int, other: int, every: int) -> list[LabelMap]:
    """The maps, of which every so many show an instance as another one."""
    return [
        replace(m, ids=np.where(m.ids == instance, other, m.ids).astype(np.uint16)) if k % every == 0 else m
        for k, m in enumerate(maps)
    ]


def test_a_gaussian_joins_the_instance_that_its_place_shows(small, scene):
    wrong, rows = mislabelled(scene)
    found = relabelled(compared(small), wrong, small.maps)
    joined = found.instance_id[rows] == BALL
    assert joined.mean() > 0.9  # those at the outline show as something else from half of the views
    assert (found.part_id[rows][joined] == 0).all()
    assert (found.instance_conf[rows][joined] >= np.float32(2 / 3)).all()
    rest = np.ones(len(scene), bool)
    rest[rows] = False
    kept = found.instance_id[rest] == wrong.instance_id[rest]
    assert kept.mean() > 0.99
    assert (found.part_id[rest][kept] == 3).all() and (found.instance_conf[rest][kept] == np.float32(0.9)).all()
    assert found.means is wrong.means and found.log_scales is wrong.log_scales


@pytest.mark.parametrize(("every", "joins"), [(4, True), (2, False)])
def test_two_thirds_of_the_views_must_agree(small, scene, every, joins):
    wrong, rows = mislabelled(scene)
    maps = seen_from(small, small.maps, BALL, BOX, every)
    share = (relabelled(compared(small), wrong, maps).instance_id[rows] == BALL).mean()
    assert share > 0.6 if joins else share < 0.3


def test_labels_stay_where_no_view_sees_a_gaussian_and_where_its_new_label_has_none(small, scene):
    wrong, rows = mislabelled(scene)
    blind = replace(compared(small), depths=[replace(d, depth=np.zeros_like(d.depth)) for d in small.depths])
    assert np.array_equal(relabelled(blind, wrong, small.maps).instance_id, wrong.instance_id)
    without_ball = select(wrong, wrong.instance_id != BALL)
    found = relabelled(compared(small), without_ball, small.maps)
    assert BALL not in found.instance_id
    assert len(rows) > 10 and (without_ball.instance_id == BOX).sum() - (found.instance_id == BOX).sum() < 10


def test_the_scene_shows_its_masks(small, scene, monkeypatch):
    unknown = [replace(m, ids=np.full_like(m.ids, 7)) for m in small.maps]
    whole = shown_masks(small.views, scene, unknown)
    monkeypatch.setattr(relabel, "MOST_PIXELS", 48)
    half = shown_masks(small.views, scene, unknown)
    for view in range(VIEWS):
        assert whole[view].name == small.frames[view].name and whole[view].ids.dtype == np.uint16
        assert iou(whole[view].ids == BOX, small.ids[view] == BOX) > 0.75
        assert iou(half[view].ids == BOX, small.ids[view] == BOX) > 0.55
        for shown in (whole[view], half[view]):
            assert (shown.ids == small.ids[view]).mean() > 0.93


def test_a_pixel_shows_what_the_coarse_rendering_has_at_its_centre(small, scene, monkeypatch):
    nothing = [replace(m, ids=np.zeros_like(m.ids)) for m in small.maps]
    monkeypatch.setattr(relabel, "MOST_PIXELS", 45)
    for camera, shown in zip(small.views.cameras, shown_masks(small.views, scene, nothing), strict=True):
        coarse = camera.scaled(*size_within(45, camera.width, camera.height))
        drawn = render(scene, coarse, label_ids=[FLOOR, BOX, BALL])
        sure = (drawn.alpha >= 0.5) & (drawn.label_masks.max(axis=0) >= 0.5 * drawn.alpha)
        v, u = (np.indices(shown.ids.shape) + 0.5) / [[[camera.height]], [[camera.width]]]
        at = (v * coarse.height).astype(int), (u * coarse.width).astype(int)
        assert np.array_equal(shown.ids, np.where(sure[at], drawn.label_masks.argmax(axis=0)[at], 0))


def test_masks_stay_where_the_scene_has_a_hole_and_where_a_frame_is_not_valid(small, scene):
    no_box = select(scene, scene.instance_id != BOX)
    valid = np.ones(small.maps[0].ids.shape, np.uint8)
    valid[:, :40] = 0
    views = replace(small.views, frames=[replace(f, valid=encode_png(255 * valid)) for f in small.frames])
    known = [replace(m, ids=m.ids + np.uint16(5)) for m in small.maps]
    for view, shown in enumerate(shown_masks(views, no_box, known)):
        assert np.array_equal(shown.ids[:, :40], known[view].ids[:, :40])
        assert BOX not in shown.ids
        ball = small.ids[view][:, 40:] == BALL
        assert ball.sum() < 30 or (shown.ids[:, 40:][ball] == BALL).mean() > 0.85
