from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from ball_and_box import VIEWS, SmallScene

from ss_flow.tasks.artifacts import REFINED, Gaussians, InstanceMasks
from ss_flow.tasks.gaussians.initialise import initialise, select
from ss_flow.tasks.models.catalogue import Model
from ss_flow.tasks.splat import refine as module
from ss_flow.tasks.splat.refine import RefineParams, refine, render_mask
from ss_flow.tasks.splat.views import SceneViews

PARAMS = RefineParams()
SEGMENTER = Model("stand-in", "segmenter", (), (), ())


@pytest.fixture(scope="module")
def small() -> SmallScene:
    return SmallScene()


@pytest.fixture(scope="module")
def box(small: SmallScene) -> Gaussians:
    """The box's surface points as thin, solid Gaussians."""
    mine = small.labels == 1
    points = initialise(small.points[mine], small.colors[mine], 1, 0.9, opacity=0.6)
    return replace(points, log_scales=np.full_like(points.log_scales, np.log(0.01)))


class Scripted:
    """A segmenter that answers a prompt by what the test says of the view; a view's embedding is its number."""

    answer = staticmethod(lambda view, points: np.zeros((0, 0), bool))

    def __init__(self, model):
        pass

    def predict_prompt(self, embedding, points):
        return type(self).answer(embedding, points), 1.0


def refined(small: SmallScene, box: Gaussians, instance: InstanceMasks, monkeypatch=None, answer=None, **params):
    """Refine with a segmenter that gives `answer(view, points)`, or without one."""
    model, embeddings = (None, ()) if answer is None else (SEGMENTER, tuple(range(VIEWS)))
    if answer is not None:
        monkeypatch.setattr(module, "Sam", Scripted)
        monkeypatch.setattr(Scripted, "answer", staticmethod(answer))
    views = (small.frames, small.cameras, small.depths)
    return refine(*views, instance, box, embeddings, params=RefineParams(**params), model=model)


def assert_outline(mask: np.ndarray, truth: np.ndarray) -> None:
    """The mask's border is at most two pixels outside and one inside the true one (full opacity widens)."""
    wide = cv2.dilate(truth.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    narrow = cv2.erode(truth.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    assert not (mask & ~wide).any()
    assert not (narrow & ~mask).any()


def test_the_rendered_mask_leaves_out_what_the_ball_hides(small, box):
    scene = SceneViews(small.frames, small.cameras, small.depths, 0.02, 0.0)
    for view in range(VIEWS):
        rendered = render_mask(box, scene, view)
        assert_outline(rendered.mask, small.ids[view] == 1)
        assert rendered.support > 0.7
    blind = replace(scene, depths=tuple(replace(d, depth=np.zeros_like(d.depth)) for d in small.depths))
    hidden = small.ids[0] == 2
    assert (render_mask(box, blind, 0).mask & hidden).sum() > 5 * (render_mask(box, scene, 0).mask & hidden).sum()
    assert render_mask(box, blind, 0).support == 0


def test_without_a_segmenter_masks_stay_and_missing_ones_are_drawn_where_depth_confirms_them(small, box):
    result = refined(small, box, small.instance(1, views=(0, 3, 4)))
    assert result.view.tolist() == list(range(VIEWS))
    assert result.prompted.tolist() == [0, REFINED, REFINED, 0, 0, REFINED, REFINED, REFINED]
    for view, mask in zip(result.view, result.dense(), strict=True):
        assert_outline(mask, small.ids[view] == 1)
    wrong = replace(small.depths[2], depth=small.depths[2].depth + np.float32(1))
    depths = (*small.depths[:2], wrong, *small.depths[3:])
    again = refine(small.frames, small.cameras, depths, small.instance(1, views=(0, 3)), box, (), params=PARAMS)
    assert 2 not in again.view


def test_a_mask_stays_unless_the_segmenters_agrees_better(small, box, monkeypatch):
    truth = small.instance(1)
    same = refined(small, box, truth, monkeypatch, lambda view, _: small.ids[view] == 1)
    np.testing.assert_array_equal(same.packed, truth.packed)
    assert not same.prompted.any()

    worse = refined(small, box, truth, monkeypatch, lambda view, _: np.roll(small.ids[view] == 1, 6, axis=1))
    np.testing.assert_array_equal(worse.packed, truth.packed)

    shifted = replace(truth, packed=np.packbits(np.roll(truth.dense(), 6, axis=2).reshape(VIEWS, -1), axis=1))
    better = refined(small, box, shifted, monkeypatch, lambda view, _: small.ids[view] == 1)
    np.testing.assert_array_equal(better.packed, truth.packed)
    assert (better.prompted == REFINED).all()


def test_a_missing_mask_is_added_only_above_tau_iou(small, box, monkeypatch):
    part = small.instance(1, views=(0, 1))
    good = refined(small, box, part, monkeypatch, lambda view, _: small.ids[view] == 1)
    assert good.view.tolist() == list(range(VIEWS))
    strict = refined(small, box, part, monkeypatch, lambda view, _: small.ids[view] == 1, tau_iou=0.999)
    assert strict.view.tolist() == [0, 1]
    bad = refined(small, box, part, monkeypatch, lambda view, _: small.ids[view] == 2)
    assert bad.view.tolist() == [0, 1]


def test_prompts_lie_on_visible_parts_of_the_instance(small, box, monkeypatch):
    asked = {}

    def prompted(view, points):
        asked[view] = points
        return np.zeros((small.instance(1).height, small.instance(1).width), bool)

    refined(small, box, small.instance(1), monkeypatch, prompted)
    assert sorted(asked) == list(range(VIEWS))
    for view, points in asked.items():
        column, row = points.astype(int).T
        assert len(points) == PARAMS.prompts
        assert (small.ids[view][row, column] == 1).mean() >= 0.8


def test_a_weak_instance_with_enough_masks_is_weak_no_more(small, box):
    weak = replace(small.instance(1, views=(0,)), weak=True)
    assert not refined(small, box, weak).weak
    assert refined(small, box, weak, min_views=20).weak


def test_faint_and_huge_gaussians_do_not_draw(small, box):
    stray = replace(
        initialise(np.array([[0.0, 1.0, 0.3]] * 2, np.float32), np.zeros((2, 3), np.uint8), 1, 1.0),
        log_scales=np.log(np.array([[0.9] * 3, [0.05] * 3], np.float32)),
        opacity_logits=np.array([3.0, -4.0], np.float32),
    )
    fields = {name: np.concatenate([getattr(box, name), getattr(stray, name)]) for name in vars(box)}
    part = small.instance(1, views=(0, 3))
    np.testing.assert_array_equal(refined(small, Gaussians(**fields), part).packed, refined(small, box, part).packed)


def test_the_background_and_an_instance_without_gaussians_come_back_as_they_are(small, box):
    background, ball = small.instance(0), small.instance(2)
    assert refined(small, box, background) is background
    assert refined(small, select(box, np.zeros(0, int)), ball) is ball
