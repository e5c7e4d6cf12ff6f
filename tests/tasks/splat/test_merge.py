"""Two groups of instances are refined together, and nothing beyond their reach changes."""

from __future__ import annotations

import warnings
from dataclasses import replace

import numpy as np
import pytest
from trained_ball_and_box import MERGE, TRAIN, same

from ss_flow.tasks.gaussians.initialise import concatenate, extents, select
from ss_flow.tasks.gaussians.render import render
from ss_flow.tasks.gaussians.trainer import TrainResult
from ss_flow.tasks.gaussians.views import TrainView
from ss_flow.tasks.geometry.cameras import camera_of
from ss_flow.tasks.geometry.shape import box_diagonal
from ss_flow.tasks.splat import merge as module
from ss_flow.tasks.splat import reconstruct as reconstruct_module
from ss_flow.tasks.splat.global_pass import assemble
from ss_flow.tasks.splat.merge import MergeParams, extent, merge_pair
from ss_flow.tasks.splat.reconstruct import reconstruct


def test_a_merge_leaves_what_is_far_from_the_smaller_group_as_it_was(built):
    far = replace(built.box, means=built.box.means + np.float32(50), instance_id=np.full(len(built.box), 3, np.int32))
    merged = merge_pair(
        built.views, concatenate([built.box, far]), built.ball, built.scene.maps, params=MERGE, w_mask=0.05
    )
    assert same(select(merged, merged.instance_id == 3), far)
    assert not same(select(merged, merged.instance_id == 1), built.box)


def test_a_merge_keeps_what_it_does_not_reach_though_no_view_shows_it(built):
    away = replace(built.box, means=built.box.means + np.float32(50))
    whole = concatenate([built.box, away])
    merged = merge_pair(built.views, whole, built.ball, built.scene.maps, params=MERGE, w_mask=0.05)
    assert (merged.means > 25).all(axis=1).sum() == len(away)
    everywhere = replace(MERGE, local=False)
    merged = merge_pair(built.views, whole, built.ball, built.scene.maps, params=everywhere, w_mask=0.05)
    assert not (merged.means > 25).all(axis=1).any()


def test_a_refinement_that_ruins_the_pair_is_undone_with_a_warning(built, monkeypatch):
    trained = module.train

    def ruined(*args, **options):
        result = trained(*args, **options)
        return replace(result, gaussians=replace(result.gaussians, opacity_logits=result.gaussians.opacity_logits - 12))

    monkeypatch.setattr(module, "train", ruined)
    with pytest.warns(UserWarning, match="Refining instances 1, 2 together was undone"):
        result = merge_pair(built.views, built.box, built.ball, built.scene.maps, params=MERGE, w_mask=0.05)
    assert len(result) == len(built.box) + len(built.ball)
    np.testing.assert_array_equal(result.means[: len(built.box)], built.box.means)
    unguarded = replace(MERGE, guard_views=0, prune_opacity=0.0, prune_contribution=0.0)
    ruined_pair = merge_pair(built.views, built.box, built.ball, built.scene.maps, params=unguarded, w_mask=0.05)
    assert ruined_pair.opacities.max() < 0.05


def test_a_merge_keeps_of_what_it_trained_what_is_neither_faint_nor_unseen(built):
    rows = np.argsort(render(built.ball, camera_of(built.scene.cameras, 0)).max_contribution)[-3:]
    shown, faint, unseen = (select(built.ball, rows[[i]]) for i in range(3))
    alone = concatenate([
        shown,
        replace(faint, means=faint.means + np.float32([0, 0, 0.5]), opacity_logits=np.float32([np.log(0.0045)])),
        replace(unseen, means=unseen.means + 50),
    ])  # fmt: skip
    views = [TrainView(camera, *[np.zeros((1, 1))] * 4) for camera in built.views.cameras]
    assert module._shows(alone, views, MergeParams()).tolist() == [True, False, False]
    assert module._shows(alone, views, MergeParams(prune_opacity=0.0)).tolist() == [True, True, False]


def test_merging_with_nothing_or_without_views_is_the_plain_union(built):
    nothing = module.NO_GAUSSIANS
    assert same(merge_pair(built.views, nothing, built.ball, built.scene.maps, params=MERGE, w_mask=0.05), built.ball)
    unseen = tuple(replace(m, ids=np.zeros_like(m.ids)) for m in built.scene.maps)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        union = merge_pair(built.views, built.box, built.ball, unseen, params=MERGE, w_mask=0.05)
    assert same(union, assemble((built.ball, built.box)))
    assert len(assemble(())) == 0


def test_cameras_at_one_place_leave_lengths_to_the_size_of_the_instance(built, monkeypatch):
    views = [TrainView(camera, *[np.zeros((1, 1))] * 4) for camera in built.views.cameras]
    params = replace(MERGE, extent="cameras")
    assert extent(built.box, views, params) == pytest.approx(1.1 * 2.2)
    np.testing.assert_array_equal(extent(built.box, views[:1], params), extents(built.box))
    asked = []

    def listening(initial, views, extent, **_):
        asked.append(extent)
        return TrainResult(initial, 0, np.zeros(0, np.float32))

    monkeypatch.setattr(reconstruct_module, "train", listening)
    instance = built.scene.instance(1, views=(0,))
    for measured in ("cameras", "instance"):
        reconstruct(built.views, instance, params=replace(TRAIN, extent=measured, tau_agree=0.0))
    assert asked[0] == asked[1] > 0


def test_each_instance_of_a_pair_moves_at_the_pace_of_its_own_size(built):
    sizes = extents(concatenate([built.box, built.ball]))
    assert np.unique(sizes).size == 2
    assert sizes[0] == pytest.approx(box_diagonal(built.box.means))
    assert sizes[-1] == pytest.approx(box_diagonal(built.ball.means))
