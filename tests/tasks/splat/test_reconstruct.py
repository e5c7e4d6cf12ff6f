"""One instance is trained alone, and again where its masks changed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from ball_and_box import VIEWS
from trained_ball_and_box import TRAIN, same
from view_masks import as_fields

from ss_flow.tasks.gaussians.densification import Schedule
from ss_flow.tasks.gaussians.initialise import NO_GAUSSIANS, initialise
from ss_flow.tasks.gaussians.trainer import TrainResult
from ss_flow.tasks.geometry.images import encode_png
from ss_flow.tasks.splat import reconstruct as reconstruct_module
from ss_flow.tasks.splat.merge import MergeParams
from ss_flow.tasks.splat.reconstruct import ReconstructParams, reconstruct, retrain, thin


def test_a_weak_instance_and_one_without_masks_or_points_give_no_gaussians(built):
    few = built.scene.instance(2)
    empty = replace(few, points=few.points[:0], colors=few.colors[:0], point_confidence=few.point_confidence[:0])
    for instance in (replace(few, weak=True), built.scene.instance(2, views=()), empty):
        assert len(reconstruct(built.views, instance, params=TRAIN)) == 0


@pytest.mark.parametrize(("instance_id", "rows"), [(2, [0]), (2, [0, 0, 0]), (0, [0])])
def test_an_instance_of_points_at_one_place_is_trained(built, instance_id, rows):
    whole = built.scene.instance(instance_id)
    own = ("points", "colors", "point_confidence", "point_part")
    few = replace(whole, **{name: getattr(whole, name)[rows] for name in own})
    params = replace(TRAIN, min_iterations=20, max_iterations=20, tau_agree=0.0)
    assert len(reconstruct(built.views, few, params=params))


@pytest.mark.parametrize(("steps", "expected"), [(3, [0, 4, 7]), (8, range(8)), (30, range(8))])
def test_of_more_views_than_steps_as_many_are_trained_on_evenly_spread(built, monkeypatch, steps, expected):
    heard = []

    def listening(initial, views, **_):
        heard.extend(view.camera.world_to_camera for view in views)
        return TrainResult(initial, 0, np.zeros(0, np.float32))

    monkeypatch.setattr(reconstruct_module, "train", listening)
    params = replace(TRAIN, min_iterations=1, max_iterations=steps)
    whole = built.scene.instance(1)
    reconstruct(built.views, whole, params=params)
    np.testing.assert_array_equal(heard, built.scene.cameras.world_to_camera[list(expected)])

    heard.clear()
    again = replace(params, max_iterations=4 * steps, min_iterations=4 * steps, retrain_share=0.25)
    retrain(built.views, whole, built.scene.instance(1, views=(0,)), built.box, params=again)
    np.testing.assert_array_equal(heard, built.scene.cameras.world_to_camera[list(expected)])


@pytest.mark.parametrize(("steps", "background_scale", "read"), [(120, 1.0, False), (60, 2.0, False), (120, 2.0, True)])
def test_how_clones_and_splits_come_enters_the_key_only_where_a_training_is_long_enough_for_them(
    built, steps, background_scale, read
):
    plain = replace(TRAIN, min_iterations=steps, max_iterations=steps, background_scale=background_scale)
    for changed in ({"max_gaussians": 7}, {"densify": "none"}, {"schedule": Schedule(start=0)}):
        assert (replace(plain, **changed).of_first() != plain.of_first()) == read


def test_steps_grow_with_the_views_within_their_limits(built):
    params = ReconstructParams(iterations_per_view=8, min_iterations=30, max_iterations=60, background_scale=2.0)

    def steps(instance_id: int, views: int) -> int:
        return params.iterations(built.scene.instance(instance_id, views=tuple(range(views))))

    assert [steps(1, views) for views in (2, 5, 8)] == [30, 40, 60]
    assert [steps(0, views) for views in (2, 5, 8)] == [60, 80, 120]
    merging = MergeParams(iterations_per_view=6, min_iterations=20, max_iterations=40)
    assert [merging.iterations(views) for views in (2, 5, 8)] == [20, 30, 40]


def test_the_background_gets_more_steps_points_and_gaussians_and_things_the_surface_that_joins_them(built, monkeypatch):
    asked, free = [], []

    def listening(initial, views, params, **_):
        asked.append((len(initial), params.iterations, params.max_gaussians))
        free.append(max(view.free.mean() for view in views))
        return TrainResult(initial, 0, np.zeros(0, np.float32))

    monkeypatch.setattr(reconstruct_module, "train", listening)
    params = ReconstructParams(max_points=200, max_gaussians=500, background_scale=2.0, max_iterations=40)
    for instance_id in (0, 1):
        reconstruct(built.views, built.scene.instance(instance_id), params=params)
    assert free[0] < 0.005 < 0.1 < free[1], "the background goes on unseen behind all else"
    assert 200 < asked[0][0] <= 400 and asked[0][1:] == (80, 1000)
    assert 100 < asked[1][0] <= 200 and asked[1][1:] == (40, 500)
    half = built.scene.instance(1)
    rows = np.flatnonzero(half.points[:, 0] > 0)
    own = ("points", "colors", "point_confidence", "point_part")
    half = replace(half, **{name: getattr(half, name)[rows] for name in own})
    for share in (0.7, 0.0):
        reconstruct(built.views, half, params=replace(params, max_points=0, tau_agree=share))
    assert asked[2][0] > 1.2 * len(rows) and asked[3][0] == len(rows)


def test_retraining_happens_only_where_refinement_changed_a_mask(built):
    instance = built.scene.instance(2)
    again = replace(TRAIN, retrain_share=0.1)
    assert retrain(built.views, instance, instance, built.ball, params=again) is built.ball
    smaller = np.array(instance.dense())
    smaller[3, :, ::2] = False
    without_one = built.scene.instance(2, views=tuple(range(1, VIEWS)))
    for changed in (replace(instance, **as_fields(smaller)), without_one):
        assert retrain(built.views, changed, instance, built.ball, params=TRAIN) is built.ball, "a share of 0"
        result = retrain(built.views, changed, instance, built.ball, params=again)
        assert not same(result, built.ball) and len(result)
        assert len(retrain(built.views, changed, instance, NO_GAUSSIANS, params=again)), "from the points"


def test_what_was_first_trained_on_dilated_masks_is_trained_again_on_the_masks_themselves(built):
    instance = built.scene.instance(2)
    params = replace(TRAIN, min_iterations=40, max_iterations=40, retrain_share=1.0, warm_start=False)
    dilated = replace(params, dilation=1)
    first = reconstruct(built.views, instance, params=dilated)
    assert not same(first, reconstruct(built.views, instance, params=params))
    result = retrain(built.views, instance, instance, first, params=dilated)
    assert same(result, reconstruct(built.views, instance, params=params))


def test_thinning_keeps_points_spread_over_the_whole_surface():
    points = np.random.default_rng(0).random((20_000, 3)).astype(np.float32) * [1, 1, 0.01]
    rows = thin(points.astype(np.float32), 500)
    assert 250 < len(rows) <= 500 and (np.diff(rows) > 0).all()
    cells = np.histogram2d(*points[rows, :2].T, bins=5, range=[[0, 1], [0, 1]])[0]
    assert cells.min() > 5
    assert len(thin(points.astype(np.float32), 0)) == len(points)


def test_no_gaussian_becomes_much_longer_than_those_of_its_instance_start_and_a_stray_point_makes_no_blob(built):
    instance = built.scene.instance(1)
    instance = replace(instance, points=np.concatenate([instance.points[:-1], instance.points[-1:] + 0.3]))
    start = np.exp(initialise(instance.points, instance.colors, 1, 1.0).log_scales).max(axis=1)
    for times in (3.0, 1.5):
        params = replace(TRAIN, max_length=times, max_points=len(instance.points), tau_agree=0.0)
        longest = float(np.exp(reconstruct(built.views, instance, params=params).log_scales).max())
        limit = times * float(np.median(start))
        assert 0.9 * limit < longest <= limit * (1 + 1e-5) < start.max()


def test_an_instance_that_only_excluded_pixels_show_stays_as_its_points_and_is_told(built):
    instance = built.scene.instance(1)
    nothing = encode_png(np.zeros(built.scene.maps[0].ids.shape, np.uint8))
    views = replace(built.views, frames=tuple(replace(frame, valid=nothing) for frame in built.scene.frames))
    with pytest.warns(UserWarning, match="No view shows instance 1"):
        kept = reconstruct(views, instance, params=replace(TRAIN, max_points=0))
    np.testing.assert_array_equal(kept.means, instance.points)


def test_an_instance_of_which_training_leaves_nothing_stays_as_its_points_and_is_told(built, monkeypatch):
    instance, nothing = built.scene.instance(1), TrainResult(NO_GAUSSIANS, 0, np.zeros(0, np.float32))
    monkeypatch.setattr(reconstruct_module, "train", lambda *_, **__: nothing)
    with pytest.warns(UserWarning, match="Training left nothing of instance 1"):
        kept = reconstruct(built.views, instance, params=replace(TRAIN, max_points=0, tau_agree=0.0))
    np.testing.assert_array_equal(kept.means, instance.points)
