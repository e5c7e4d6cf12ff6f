from __future__ import annotations

import copy
from dataclasses import replace

import cv2
import numpy as np
import pytest
from ball_and_box import VIEWS, SmallScene
from view_masks import as_fields

from ss_flow.tasks.artifacts import DRAWN, REFINED, Gaussians, InstanceMasks
from ss_flow.tasks.gaussians.initialise import initialise, select
from ss_flow.tasks.gaussians.render import render
from ss_flow.tasks.geometry.cameras import pixels_in_view
from ss_flow.tasks.geometry.images import encode_png
from ss_flow.tasks.geometry.visibility import VisibilityParams
from ss_flow.tasks.models.catalogue import Model
from ss_flow.tasks.splat import refine as module
from ss_flow.tasks.splat.refine import RefineParams, refine, render_mask, rendered

PARAMS = RefineParams()
NAMES = tuple(f"v{k}" for k in range(VIEWS))
SEGMENTER = Model("stand-in", "segmenter", (), (), ())


@pytest.fixture(scope="module")
def box(small: SmallScene) -> Gaussians:
    """The box's surface points as thin, solid Gaussians."""
    mine = small.labels == 1
    points = initialise(small.points[mine], small.colors[mine], 1, 0.9, opacity=0.6)
    return replace(points, log_scales=np.full_like(points.log_scales, np.log(0.01)))


class Scripted:
    """A segmenter that answers a prompt by what the test says of the view; a view's embedding is its number."""

    answer = staticmethod(lambda view, points: np.zeros((0, 0), bool))
    score = 1.0

    def __init__(self, model):
        pass

    def image(self, embedding, *, few):
        self.view = embedding
        return self

    def predict_prompt(self, points):
        return type(self).answer(self.view, points), type(self).score


def refined(small: SmallScene, box: Gaussians, instance: InstanceMasks, monkeypatch=None, answer=None, **params):
    """Refine with a segmenter that gives `answer(view, points)`, or without one."""
    model, embeddings = (None, ()) if answer is None else (SEGMENTER, tuple(range(VIEWS)))
    if answer is not None:
        monkeypatch.setattr(module, "Sam", Scripted)
        monkeypatch.setattr(Scripted, "answer", staticmethod(answer))
    return refine(small.views, instance, box, embeddings, params=RefineParams(**params), model=model)


def assert_outline(mask: np.ndarray, truth: np.ndarray) -> None:
    """The mask's border is at most two pixels outside and one inside the true one (full opacity widens)."""
    wide = cv2.dilate(truth.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    narrow = cv2.erode(truth.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    assert not (mask & ~wide).any()
    assert not (narrow & ~mask).any()


def test_the_rendered_mask_leaves_out_what_the_ball_hides(small, box):
    scene = small.views.compared(VisibilityParams())
    for view in range(VIEWS):
        rendered = render_mask(box, scene, view)
        assert_outline(rendered.mask, small.ids[view] == 1)
        assert rendered.support > 0.7
    blind = replace(scene, depths=tuple(replace(d, depth=np.zeros_like(d.depth)) for d in small.depths))
    hidden = small.ids[0] == 2
    assert (render_mask(box, blind, 0).mask & hidden).sum() > 5 * (render_mask(box, scene, 0).mask & hidden).sum()
    assert render_mask(box, blind, 0).support == 0
    whole = render_mask(box, scene, 0, RefineParams(cut_occluded=False)).mask
    np.testing.assert_array_equal(whole, render_mask(box, blind, 0).mask)


def test_the_rendered_mask_ends_a_margin_beyond_the_centres_or_with_the_photo_as_in_the_paper(small, box):
    scene, camera = small.views.compared(VisibilityParams()), small.views.cameras[0]
    large = replace(box, log_scales=np.full_like(box.log_scales, np.log(0.1)))
    covered = render(large, camera, opaque=True).alpha >= 0.5
    whole = render_mask(large, scene, 0, RefineParams(cut_occluded=False, box_margin=0)).mask
    np.testing.assert_array_equal(whole, covered)

    low, high = np.quantile(pixels_in_view(box.means, camera)[2], (0.005, 0.995))  # rows
    for margin, pixels in ((7, 1), (20, 3), (40, 6)):  # the photo's diagonal is 120
        cut = render_mask(large, scene, 0, RefineParams(cut_occluded=False, box_margin=margin)).mask
        rows = np.flatnonzero(cut.any(axis=1))
        assert rows[[0, -1]].tolist() == [int(low) - pixels, int(high) + pixels]


def test_without_a_segmenter_masks_stay_and_missing_ones_are_drawn_where_depth_confirms_them(small, box):
    result = refined(small, box, small.instance(1, views=(0, 3, 4)))
    assert result.views == NAMES
    assert result.origin.tolist() == [0, REFINED, REFINED, 0, 0, REFINED, REFINED, REFINED]
    for view, mask in enumerate(result.dense()):
        assert_outline(mask, small.ids[view] == 1)
    wrong = replace(small.depths[2], depth=small.depths[2].depth + np.float32(1))
    depths = (*small.depths[:2], wrong, *small.depths[3:])
    again = refine(replace(small.views, depths=depths), small.instance(1, views=(0, 3)), box, (), params=PARAMS)
    assert NAMES[2] not in again.views


def moved(instance: InstanceMasks, pixels: int, **fields) -> InstanceMasks:
    """With masks shifted to the right."""
    return replace(instance, **as_fields(np.roll(instance.dense(), pixels, axis=2)), **fields)


def test_a_mask_stays_unless_the_segmenters_agrees_better(small, box, monkeypatch):
    truth = small.instance(1)
    same = refined(small, box, truth, monkeypatch, lambda view, _: small.ids[view] == 1)
    assert same.same(truth)
    assert not same.origin.any()

    shifted = lambda view, _: np.roll(small.ids[view] == 1, 6, axis=1)  # noqa: E731
    worse = refined(small, box, truth, monkeypatch, shifted, margin=0.1)
    assert worse.same(truth)

    right = lambda view, _: small.ids[view] == 1  # noqa: E731
    better = refined(small, box, moved(truth, 6), monkeypatch, right, margin=0.1)
    assert better.same(truth)
    assert (better.origin == REFINED).all()


def test_a_mask_of_the_photo_gives_way_only_by_a_margin_and_one_drawn_from_points_to_anything_better(
    small, box, monkeypatch
):
    nearly = moved(small.instance(1), 1)
    right = lambda view, _: small.ids[view] == 1  # noqa: E731
    kept = refined(small, box, nearly, monkeypatch, right, margin=0.1)
    assert kept.same(nearly)
    for instance, params in (
        (replace(nearly, origin=np.full(VIEWS, DRAWN, np.uint8)), {}),
        (nearly, {"margin": 0.0}),
    ):
        replaced = refined(small, box, instance, monkeypatch, right, **params)
        assert (replaced.origin == REFINED).any()


@pytest.mark.parametrize("source", [0, DRAWN])
def test_of_two_masks_that_agree_equally_well_the_preset_says_which_stays(small, box, monkeypatch, source):
    held = replace(small.instance(1), origin=np.full(VIEWS, source, np.uint8))
    same = lambda view, _: small.ids[view] == 1  # noqa: E731
    old = refined(small, box, held, monkeypatch, same, margin=0.0)
    assert (old.origin == source).all()
    new = refined(small, box, held, monkeypatch, same, margin=0.0, tie="new")
    assert (new.origin == REFINED).all()


def test_a_mask_of_the_photo_is_not_replaced_by_one_of_quite_another_size(small, box, monkeypatch):
    truth = small.instance(1)
    masks = np.array(truth.dense())
    part = replace(truth, **as_fields(masks & (np.cumsum(masks, axis=2) <= masks.sum(axis=2, keepdims=True) // 2)))
    right = lambda view, _: small.ids[view] == 1  # noqa: E731
    for limit, expected in ((1.5, part), (0.0, truth)):
        found = refined(small, box, part, monkeypatch, right, margin=0.1, max_change=limit)
        assert found.same(expected)
    drawn = replace(part, origin=np.full(VIEWS, DRAWN, np.uint8))
    assert refined(small, box, drawn, monkeypatch, right).same(truth)
    around = [cv2.dilate(mask.astype(np.uint8), np.ones((9, 9), np.uint8)) > 0 for mask in masks]  # twice as large
    wide = replace(truth, **as_fields(np.array(around)))
    for limit, expected in ((1.5, wide), (3.0, truth)):
        assert refined(small, box, wide, monkeypatch, right, margin=0.0, max_change=limit).same(expected)


def test_the_segmenter_is_not_asked_where_no_answer_could_be_taken(small, box, monkeypatch):
    asked = []

    def right(view, _):
        asked.append(view)
        return small.ids[view] == 1

    def views_asked(instance, **params):
        asked.clear()
        refined(small, box, instance, monkeypatch, right, **params)
        return len(asked)

    truth = small.instance(1)
    assert views_asked(truth, margin=0.3) == 0  # none agrees better by so much
    assert views_asked(truth, margin=0.0) == VIEWS
    assert views_asked(replace(truth, origin=np.full(VIEWS, DRAWN, np.uint8))) == VIEWS
    assert views_asked(moved(truth, 6), margin=0.1) == VIEWS
    assert views_asked(moved(truth, 6)) == 0  # what the photo gave stays
    masks = np.array(truth.dense())
    sliver = replace(truth, **as_fields(masks & (np.cumsum(masks, axis=2) <= 2)))
    assert views_asked(sliver, margin=0.5) == 0  # what agrees so well has another size
    assert views_asked(sliver, margin=0.5, max_change=0.0) == VIEWS


def test_an_embedding_is_read_where_the_segmenter_is_asked_and_nowhere_else(small, box, monkeypatch):
    assert "embeddings" in refine.streamed

    class Stored(tuple):
        def __getitem__(self, view):
            read.append(view)
            return view

    monkeypatch.setattr(module, "Sam", Scripted)
    monkeypatch.setattr(Scripted, "answer", staticmethod(lambda view, _: small.ids[view] == 1))
    for margin, expected in ((1.0, [1, 2]), (0.0, list(range(VIEWS)))):
        read = []
        instance = small.instance(1, views=[view for view in range(VIEWS) if view not in (1, 2)])
        params = RefineParams(margin=margin)
        found = refine(small.views, instance, box, Stored(range(VIEWS)), params=params, model=SEGMENTER)
        assert found.views == NAMES and read == expected


def test_an_answer_that_the_segmenter_itself_doubts_is_not_taken(small, box, monkeypatch):
    monkeypatch.setattr(Scripted, "score", 0.7)
    right = lambda view, _: small.ids[view] == 1  # noqa: E731
    few = moved(small.instance(1, views=(0, 1)), 6)
    doubted = refined(small, box, few, monkeypatch, right)
    assert doubted.same(few)
    assert len(refined(small, box, few, monkeypatch, right, pred_iou=0.7).views) == VIEWS
    monkeypatch.setattr(Scripted, "score", -0.1)  # a network may predict that, too
    assert len(refined(small, box, few, monkeypatch, right, pred_iou=0.0).views) == VIEWS


def test_new_masks_leave_out_what_is_not_valid(small, box, monkeypatch):
    valid = np.full(small.ids[0].shape, 255, np.uint8)
    valid[:, 48:] = 0
    masked = copy.copy(small)
    masked.frames = tuple(replace(frame, valid=encode_png(valid)) for frame in small.frames)
    part = small.instance(1, views=(0, 1))
    for answer in (None, lambda view, _: small.ids[view] == 1):
        result = refined(masked, box, part, monkeypatch, answer)
        new = np.array(result.dense())[result.origin == REFINED]
        assert len(new) and new.any() and not new[:, :, 48:].any()
    shown = np.array(rendered(masked.views, small.instance(1), box, params=PARAMS).dense())
    assert shown.any() and not shown[:, :, 48:].any()


def test_a_missing_mask_is_added_only_above_tau_iou(small, box, monkeypatch):
    part = small.instance(1, views=(0, 1))
    good = refined(small, box, part, monkeypatch, lambda view, _: small.ids[view] == 1)
    assert good.views == NAMES
    strict = refined(small, box, part, monkeypatch, lambda view, _: small.ids[view] == 1, tau_iou=0.999)
    assert strict.views == NAMES[:2]
    bad = refined(small, box, part, monkeypatch, lambda view, _: small.ids[view] == 2)
    assert bad.views == NAMES[:2]


def test_an_answer_is_taken_without_its_speckles(small, box, monkeypatch):
    """Small networks answer with dots and pinholes where they waver."""
    truth = small.instance(1)
    rng = np.random.default_rng(0)
    spots = [(ids == 1) ^ (rng.random(ids.shape) < 0.03) for ids in small.ids]

    def wrong(**params) -> int:
        found = refined(small, box, small.instance(1, views=(0,)), monkeypatch, lambda view, _: spots[view], **params)
        assert found.views == NAMES
        return int((np.array(found.dense()) != truth.dense())[1:].sum())

    assert wrong() < 0.5 * wrong(speckle=0.0)


def test_an_answer_is_dilated_as_asked(small, box, monkeypatch):
    part, right = small.instance(1, views=(0, 1)), lambda view, _: small.ids[view] == 1
    plain, wide = (refined(small, box, part, monkeypatch, right, dilation=pixels) for pixels in (0, 1))
    cross = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
    for view in range(2, VIEWS):
        grown = cv2.dilate(right(view, None).astype(np.uint8), cross) > 0
        assert (wide.mask(view) & grown).sum() == grown.sum() > plain.mask(view).sum()


def test_prompts_are_chosen_as_asked_at_the_middles_of_pixels(small, box, monkeypatch):
    def asked(**params) -> np.ndarray:
        found = []
        nothing = lambda view, points: found.append(points) or np.zeros(small.ids[0].shape, bool)  # noqa: E731
        refined(small, box, small.instance(1), monkeypatch, nothing, margin=0.1, **params)
        return np.concatenate(found)

    usual = asked()
    assert (usual % 1 == 0.5).all()
    assert not np.array_equal(asked(drop_hull=False), usual) and not np.array_equal(asked(prompt_alpha=3.0), usual)


def test_prompts_lie_on_visible_parts_of_the_instance(small, box, monkeypatch):
    asked = {}

    def prompted(view, points):
        asked[view] = points
        return np.zeros(small.ids[0].shape, bool)

    refined(small, box, small.instance(1), monkeypatch, prompted, margin=0.1)
    assert sorted(asked) == list(range(VIEWS))
    for view, points in asked.items():
        column, row = points.astype(int).T
        assert len(points) == PARAMS.prompts
        assert (small.ids[view][row, column] == 1).mean() >= 0.8


def test_a_weak_instance_with_enough_masks_is_weak_no_more(small, box):
    weak = replace(small.instance(1, views=(0,)), weak=True)
    assert not refined(small, box, weak).weak
    assert refined(small, box, weak, min_views=20).weak
    assert not refined(small, box, replace(weak, weak=False), min_views=20).weak


def test_faint_and_huge_gaussians_do_not_draw(small, box):
    stray = replace(
        initialise(np.array([[0.0, 1.0, 0.3]] * 2, np.float32), np.zeros((2, 3), np.uint8), 1, 1.0),
        log_scales=np.log(np.array([[0.9] * 3, [0.05] * 3], np.float32)),
        opacity_logits=np.array([3.0, -4.0], np.float32),
    )
    fields = {name: np.concatenate([getattr(box, name), getattr(stray, name)]) for name in vars(box)}
    part = small.instance(1, views=(0, 3))
    cluttered = Gaussians(**fields)
    clean = refined(small, box, part)
    assert refined(small, cluttered, part).same(clean)
    for allowed in ({"min_opacity": 0.0}, {"max_scale": 0.0}):
        drawn = refined(small, cluttered, part, min_support=0.0, cut_occluded=False, **allowed)
        assert drawn.areas()[drawn.origin == REFINED].sum() > 1.02 * clean.areas()[clean.origin == REFINED].sum()


def test_faint_gaussians_alone_are_drawn_all_the_same(small, box):
    faint = replace(box, opacity_logits=np.full(len(box), -4, np.float32))
    assert refined(small, faint, small.instance(1, views=(0, 3)), min_support=0.0).views == NAMES


def test_a_view_that_sees_too_few_centres_is_not_looked_at(small, box):
    part = small.instance(1, views=(0, 3))
    assert refined(small, box, part, min_visible=10_000).views == part.views


@pytest.mark.parametrize("missing", [True, False])
def test_masks_are_drawn_with_what_is_hidden_and_as_solid_as_asked(small, box, missing):
    def drawn(**params) -> np.ndarray:
        if missing:
            return refined(small, box, small.instance(1, views=(3, 4)), min_support=0.0, **params).mask(0)
        return rendered(small.views, small.instance(1), box, params=RefineParams(**params)).mask(0)

    ball = small.ids[0] == 2
    assert (drawn(cut_occluded=False) & ball).sum() > 5 * (drawn() & ball).sum()
    assert drawn(alpha_threshold=0.99).sum() < drawn().sum()


def test_a_descriptor_may_be_shown_the_rendered_masks_in_the_views_that_have_one(small, box):
    wrong = replace(moved(small.instance(1, views=(0, 3)), 20), origin=np.array([0, DRAWN], np.uint8))
    shown = rendered(small.views, wrong, box, params=PARAMS)
    assert shown.views == (NAMES[0], NAMES[3]) and shown.origin.tolist() == [0, DRAWN]
    for view, mask in zip((0, 3), shown.dense(), strict=True):
        assert_outline(mask, small.ids[view] == 1)
    away = replace(box, means=box.means + np.float32(100))
    assert not len(rendered(small.views, wrong, away, params=PARAMS).views)
    background = small.instance(0)
    assert rendered(small.views, background, box, params=PARAMS) is background


def test_the_background_and_an_instance_without_gaussians_come_back_as_they_are(small, box):
    background, ball = small.instance(0), small.instance(2)
    assert refined(small, box, background) is background
    assert refined(small, select(box, np.zeros(0, int)), ball) is ball
