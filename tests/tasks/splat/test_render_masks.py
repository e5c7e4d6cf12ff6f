"""The masks that a finished scene shows, and where they give way to those it was trained with."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from made_gaussians import made_cameras, made_gaussians

from ss_flow.tasks.gaussians import render as drawing
from ss_flow.tasks.gaussians.initialise import select
from ss_flow.tasks.gaussians.render import render
from ss_flow.tasks.geometry.cameras import camera_of
from ss_flow.tasks.geometry.images import encode_png
from ss_flow.tasks.masks.overlap import iou
from ss_flow.tasks.splat import render_masks as module
from ss_flow.tasks.splat.render_masks import RenderMasksParams, render_masks


def drawn(built, scene, maps=None, frames=None, depths=None, **params):
    """The masks that a finished scene shows."""
    params = RenderMasksParams(**params)
    views = (frames or built.scene.frames, built.views.cameras, depths or built.scene.depths, maps or built.scene.maps)
    return [render_masks(f, c, d, scene, known, params=params) for f, c, d, known in zip(*views, strict=True)]


def test_the_merged_scene_draws_the_masks_it_was_trained_with(built, whole):
    for mine, truth in zip(drawn(built, whole), built.scene.maps, strict=True):
        assert mine.name == truth.name and mine.ids.dtype == np.uint16
        assert all(iou(mine.ids == i, truth.ids == i) > 0.9 for i in (0, 1, 2) if (truth.ids == i).sum() > 100)


def test_an_instance_without_gaussians_keeps_its_masks_where_the_scene_shows_background(built, whole):
    without = select(whole, whole.instance_id != 2)
    for mine, truth in zip(drawn(built, without, background="anywhere"), built.scene.maps, strict=True):
        np.testing.assert_array_equal(mine.ids == 2, (truth.ids == 2) & (mine.ids != 1))
    assert not any((m.ids == 9).any() for m in drawn(built, whole))


def test_masks_that_end_where_the_photo_changes_lose_less_to_the_scene_by_the_photo(built, whole):
    def wrong(**options) -> int:
        return sum(
            (m.ids != t.ids).sum() for m, t in zip(drawn(built, whole, **options), built.scene.maps, strict=True)
        )

    assert wrong() == wrong(strips="photo") < 0.9 * wrong(strips="scene")


def test_where_the_scene_shows_nothing_there_is_no_instance(built, whole):
    scene = select(whole, whole.instance_id > 0)
    far = scene.means + np.float32([0, 0, 90]) * (scene.instance_id == 1)[:, None]
    options = {"background": "anywhere", "strips": "scene", "most": 1.0}
    for mine, truth in zip(drawn(built, replace(scene, means=far), **options), built.scene.maps, strict=True):
        assert not (mine.ids == 1).any() and (mine.ids[truth.ids == 2] == 2).mean() > 0.8


def test_the_background_takes_no_more_of_a_mask_than_its_fringe_and_only_where_depth_is_known(built, whole):
    few = whole.instance_id == 1
    few[np.flatnonzero(few)[:5]] = False
    thin = select(whole, ~few)
    truth = built.scene.maps

    def lost(**options):
        pairs = zip(drawn(built, thin, **options), truth, strict=True)
        return [(t.ids == 1) & (m.ids == 0) for m, t in pairs]

    anywhere, fringe = lost(background="anywhere"), lost()
    assert sum(m.sum() for m in anywhere) > 2 * sum(m.sum() for m in fringe) > 0
    for taken, maps in zip(fringe, truth, strict=True):
        # 5 pixels of 800 are one of this picture's 120.
        assert not (taken & (cv2.erode(maps.ids, np.ones((3, 3))) == cv2.dilate(maps.ids, np.ones((3, 3))))).any()
    blind = tuple(replace(d, depth=np.zeros_like(d.depth)) for d in built.scene.depths)
    assert not any(m.any() for m in lost(depths=blind))


def test_an_instance_takes_a_pixel_from_another_only_where_it_makes_up_most_of_it(built, whole):
    nothing = [replace(m, ids=np.zeros_like(m.ids)) for m in built.scene.maps]
    left = 0
    for view, (sure, any_) in enumerate(
        zip(drawn(built, whole, nothing), drawn(built, whole, nothing, share=0.0), strict=True)
    ):
        rendering = render(whole, camera_of(built.scene.cameras, view), label_ids=[1, 2])
        strong = (rendering.label_masks >= 0.65 * rendering.alpha).any(axis=0)
        np.testing.assert_array_equal(sure.ids, np.where(strong, any_.ids, 0))
        left += (any_.ids != sure.ids).sum()
    assert left


def test_a_mask_of_which_others_would_take_most_loses_nothing_to_them_unless_it_is_a_crumb(built, whole):
    swallowed = replace(whole, instance_id=np.where(whole.instance_id == 2, 1, whole.instance_id))
    swallowed.instance_id[np.flatnonzero(whole.instance_id == 2)[:5]] = 2
    crumbs = []
    for map in built.scene.maps:
        mask = map.ids == 2
        mask[:, np.flatnonzero(mask.any(axis=0))[4:]] = False  # four columns: less than a hundredth of the picture
        crumbs.append(replace(map, ids=np.where(mask, 2, 0).astype(np.uint16)))
    pairs = zip(drawn(built, swallowed), drawn(built, swallowed, most=1.0), built.scene.maps, strict=True)
    cases = [(ours.ids, scene.ids, truth.ids == 2) for ours, scene, truth in pairs]
    whole_ones = [mask for *_, mask in cases if mask.mean() >= 0.01]
    assert len(whole_ones) > 2
    for ours, scene, mask in cases:
        assert mask.mean() < 0.01 or not (ours[mask] == 1).any()
        assert not mask.any() or (scene[mask] == 1).mean() > 0.5
        np.testing.assert_array_equal(ours[~mask], scene[~mask])
    for ours, crumb in zip(drawn(built, swallowed, crumbs), crumbs, strict=True):
        mask = crumb.ids == 2
        assert not mask.any() or (mask.mean() < 0.01 and (ours.ids[mask] == 1).mean() > 0.5)


def test_no_mask_covers_what_a_frame_excludes(built, whole):
    valid = np.full(built.scene.maps[0].ids.shape, 255, np.uint8)
    valid[:, 40:] = 0
    frames = tuple(replace(f, valid=encode_png(valid)) for f in built.scene.frames)
    for mine, free in zip(drawn(built, whole, frames=frames), drawn(built, whole), strict=True):
        assert not mine.ids[:, 40:].any() and free.ids[:, 40:].any()
        np.testing.assert_array_equal(mine.ids[:, :40], free.ids[:, :40])


def test_it_is_the_same_however_many_mask_images_are_held_at_once(monkeypatch):
    scene, camera = made_gaussians(300, 0), camera_of(made_cameras(), 0)
    known = np.zeros((camera.height, camera.width), np.uint16)
    at_once = module._ids_of_view(scene, camera, known, 0.0)
    rendered = []
    monkeypatch.setattr(drawing, "render", lambda *a, **k: rendered.append(k) or render(*a, **k))
    monkeypatch.setattr(drawing, "_MASK_BYTES", 1)
    one_by_one = module._ids_of_view(scene, camera, known, 0.0)
    assert [len(k.get("label_ids", ())) for k in rendered] == [0, 1, 1, 1, 1]
    assert np.array_equal(at_once, one_by_one) and len(np.unique(at_once)) == 4
