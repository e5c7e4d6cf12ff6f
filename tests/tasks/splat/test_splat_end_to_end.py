"""Reconstruction, refinement and merging of the ray-cast scene, with a few seconds of training."""

from __future__ import annotations

import numpy as np
from ball_and_box import VIEWS
from trained_ball_and_box import MERGE, TRAIN, same

from ss_flow.tasks.artifacts import Appearances
from ss_flow.tasks.gaussians.initialise import select
from ss_flow.tasks.gaussians.render import render
from ss_flow.tasks.geometry.cameras import camera_of
from ss_flow.tasks.masks.overlap import iou
from ss_flow.tasks.splat import merge as module
from ss_flow.tasks.splat.global_pass import assemble, global_pass
from ss_flow.tasks.splat.merge import MergeParams, merge_pair
from ss_flow.tasks.splat.plan import PlanParams, plan
from ss_flow.tasks.splat.reconstruct import ReconstructParams, reconstruct


def psnr(a, b) -> float:
    return float(-10 * np.log10(np.mean((a - b) ** 2)))


def test_an_instance_alone_shows_its_own_pixels_and_nothing_where_it_is_not(built):
    for gaussians, instance_id in ((built.box, 1), (built.ball, 2)):
        assert (gaussians.instance_id == instance_id).all()
        for view in range(VIEWS):
            rendering = render(gaussians, camera_of(built.scene.cameras, view))
            own, floor = built.scene.ids[view] == instance_id, built.scene.ids[view] == 0
            assert psnr(rendering.rgb[own], built.scene.images[view][own] / 255) > 18
            assert rendering.alpha[own].mean() > 0.85
            assert rendering.alpha[floor].mean() < 0.05


def test_the_merged_scene_shows_the_photos_and_keeps_the_instances_apart(built, whole):
    assert set(np.unique(whole.instance_id)) == {0, 1, 2}
    assert (np.diff(whole.instance_id) >= 0).all()
    for view in range(VIEWS):
        rendering = render(whole, camera_of(built.scene.cameras, view), label_ids=[0, 1, 2])
        assert psnr(rendering.rgb, built.scene.images[view] / 255) > 26
        for label in (0, 1, 2):
            target = built.scene.ids[view] == label
            if target.sum() > 50:
                assert iou(rendering.label_masks[label] >= 0.5, target) > 0.8


def test_gaussians_keep_the_part_of_the_points_that_they_grew_from(whole):
    for instance_id, low, high in ((1, 0.15, 0.35), (2, 0.2, 0.3)):
        mine = select(whole, whole.instance_id == instance_id)
        assert set(np.unique(mine.part_id)) == {0, 1}
        assert (mine.part_id[mine.means[:, 2] > high] == 1).mean() > 0.9
        assert (mine.part_id[mine.means[:, 2] < low] == 0).mean() > 0.9
    assert not whole.part_id[whole.instance_id == 0].any()


def test_training_twice_gives_the_same_bytes_and_the_order_of_a_pair_does_not_matter(built, merged):
    again = reconstruct(built.views, built.scene.instance(2), params=TRAIN)
    assert same(again, built.ball)
    assert same(merge_pair(built.views, built.ball, built.box, built.scene.maps, params=MERGE, w_mask=0.05), merged)


def test_no_training_reads_a_parameter_that_is_kept_out_of_its_key(built):
    read: set[str] = set()

    def noted(kind, **values):
        def get(self, name):
            read.add(name)
            return super(kind, self).__getattribute__(name)

        return type("Noted", (kind,), {"__getattribute__": get})(**values)

    reconstruct(
        built.views, built.scene.instance(2), params=noted(ReconstructParams, min_iterations=2, max_iterations=2)
    )
    assert "max_iterations" in read and not read & {"retrain_share", "warm_start"}
    params = noted(
        MergeParams, min_iterations=2, max_iterations=2, global_iterations=4, relabel_after=2, reset_opacity=True
    )
    merge_pair(built.views, built.box, built.ball, built.scene.maps, params=params, w_mask=0.05)
    assert set(module._OF_PAIRS) <= read and not read & set(module._OF_LAST_PASS)
    read.clear()
    scene = assemble((built.box, built.ball, built.background))
    global_pass(built.views, scene, built.scene.maps, params=params)
    assert set(module._OF_LAST_PASS) <= read and not read & set(module._OF_PAIRS)


def test_touching_instances_collide_and_are_planned_as_a_pair(built):
    shown = Appearances(instance_id=np.array([0, 1, 2], np.int32), **Appearances.arrays([[0, 1, 2], [0], [0, 2]]))
    made = plan((built.ball, built.box), shown, params=PlanParams(max_rounds=1), round=0)
    assert made.pairs.tolist() == [[1, 0]] and made.views(0) == [0, 2]
