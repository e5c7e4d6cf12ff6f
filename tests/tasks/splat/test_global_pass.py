"""The last pass trains the whole scene and moves Gaussians to the instance that photos show there."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from ball_and_box import VIEWS
from trained_ball_and_box import MERGE, same

from ss_flow.running import Surroundings, running
from ss_flow.tasks.gaussians.initialise import NO_GAUSSIANS
from ss_flow.tasks.gaussians.trainer import TrainResult
from ss_flow.tasks.geometry.visibility import VisibilityParams
from ss_flow.tasks.splat import global_pass as global_module
from ss_flow.tasks.splat.global_pass import assemble, global_pass
from ss_flow.tasks.splat.merge import MergeParams


def test_what_has_no_gaussians_is_left_to_the_background_where_there_is_one(built, monkeypatch):
    asked = []

    def listening(initial, views, **_):
        asked.append([view.inside.mean() for view in views])
        return TrainResult(initial, 0, np.zeros(0, np.float32))

    monkeypatch.setattr(global_module, "train", listening)
    params = replace(MERGE, relabel_after=0, side_weight=0.0, guard_views=0)
    for scene in (assemble((built.background, built.box)), built.box):
        global_pass(built.views, scene, built.scene.maps, params=params)
    assert asked[0] == [1] * VIEWS and max(asked[1]) < 0.2


def test_a_last_pass_of_no_steps_and_of_nothing_changes_nothing(built):
    none = replace(MERGE, global_iterations=0)
    assert global_pass(built.views, built.ball, built.scene.maps, params=none) is built.ball
    assert len(global_pass(built.views, NO_GAUSSIANS, built.scene.maps, params=MERGE)) == 0


def test_what_no_mask_shows_comes_back_as_it_is(built):
    empty = tuple(replace(one, ids=np.zeros_like(one.ids)) for one in built.scene.maps)
    assert global_pass(built.views, built.ball, empty, params=MERGE) is built.ball


def test_the_last_pass_gives_gaussians_to_the_instance_that_photos_show_there(built):
    ball = replace(built.ball, instance_id=np.where(np.arange(len(built.ball)) % 6, 2, 1).astype(np.int32))
    scene = assemble((built.background, built.box, ball))
    params = replace(MERGE, prune_opacity=0.0, prune_contribution=0.0, prune_hidden=0.0)

    def gained(params: MergeParams) -> int:
        """Gaussians of the ball."""
        found = global_pass(built.views, scene, built.scene.maps, params=params)
        assert len(found) == len(scene) and (np.diff(found.instance_id) >= 0).all()
        return int((found.instance_id == 2).sum() - (scene.instance_id == 2).sum())

    lost = int((ball.instance_id == 1).sum())
    assert lost > 50
    assert 0.6 * lost < gained(params) < 1.2 * lost
    assert gained(replace(params, relabel_after=0)) == 0


def test_the_last_pass_leaves_a_thing_no_gaussian_far_off_that_photos_show_as_another(built):
    far = np.arange(len(built.box)) % 40 == 0
    box = replace(built.box, instance_id=np.where(far, 2, built.box.instance_id).astype(np.int32))
    scene = assemble((built.background, box, built.ball))
    # No label changes by what the scene shows at a place, so what is far off stays far off to the end.
    blind = tuple(replace(d, depth=np.zeros_like(d.depth)) for d in built.views.depths)
    views = replace(built.views, depths=blind)

    def ball(params: MergeParams) -> np.ndarray:
        found = global_pass(views, scene, built.scene.maps, params=params)
        assert (np.diff(found.instance_id) >= 0).all()
        return found.means[found.instance_id == 2]

    assert far.sum() > 10
    size = np.linalg.norm(np.ptp(built.ball.means, axis=0))
    assert np.linalg.norm(np.ptp(ball(replace(MERGE, relabel_after=0)), axis=0)) > 1.5 * size
    assert np.linalg.norm(np.ptp(ball(MERGE), axis=0)) < 1.2 * size


def test_the_last_pass_compares_depths_as_it_is_told(built):
    scene = assemble((built.background, built.box, built.ball))
    params = replace(MERGE, global_iterations=20, relabel_after=10, guard_views=0)

    def labels(**options) -> np.ndarray:
        return global_pass(built.views, scene, built.scene.maps, params=params, **options).instance_id

    usual = labels()
    np.testing.assert_array_equal(labels(visibility=VisibilityParams()), usual)
    assert not np.array_equal(labels(visibility=VisibilityParams(tau_depth=1e-6)), usual)


def test_a_last_pass_of_few_steps_keeps_its_labels(built):
    scene = assemble((built.background, replace(built.ball, instance_id=np.full(len(built.ball), 1, np.int32))))
    params = replace(MERGE, global_iterations=20, relabel_after=20, guard_views=0)
    found = global_pass(built.views, scene, built.scene.maps, params=params)
    same_steps = global_pass(built.views, scene, built.scene.maps, params=replace(params, relabel_after=0))
    assert same(found, same_steps)


def test_a_last_pass_that_was_interrupted_goes_on_to_the_same_bytes(built, tmp_path):
    class Interrupted(Exception):
        pass

    scene = assemble((built.background, built.box, built.ball))
    params = replace(MERGE, relabel_after=50)
    alone = global_pass(built.views, scene, built.scene.maps, params=params)
    told: list[tuple[int, int]] = []

    def stop(done: int, total: int, note: str) -> None:
        told.append((done, total))
        if done == 150:
            raise Interrupted

    here = Surroundings(stop, checkpoint=tmp_path / "kept.npz")
    with running(here), pytest.raises(Interrupted):
        global_pass(built.views, scene, built.scene.maps, params=params)
    again: list[tuple[int, int]] = []
    with running(replace(here, listener=lambda done, total, note: again.append((done, total)))):
        found = global_pass(built.views, scene, built.scene.maps, params=params)
    assert told == [(50, 200), (100, 200), (150, 200)]
    assert again == [(50, 200), (200, 200)]
    assert same(found, alone)
