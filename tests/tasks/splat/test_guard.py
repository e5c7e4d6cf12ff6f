"""When a refinement counts as a loss and is undone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from trained_ball_and_box import MERGE

from ss_flow.tasks.gaussians.initialise import concatenate
from ss_flow.tasks.gaussians.render import render
from ss_flow.tasks.gaussians.views import IGNORED, NONE_OF_MINE, TrainView
from ss_flow.tasks.geometry.cameras import camera_of
from ss_flow.tasks.splat import guard as guard_module
from ss_flow.tasks.splat.guard import Quality, acceptable, guarded, quality
from ss_flow.tasks.splat.merge import MergeParams


def test_a_loss_is_accepted_within_its_limit_or_when_the_other_gains_much_more():
    ours, always = MergeParams(), MergeParams(guard_trade=0.0)
    old = Quality(0.80, 12.0)
    for iou_, psnr_, weighed, strict in (
        (0.79, 11.5, True, True),
        (0.74, 21.0, True, False),  # three limits lost, nine gained
        (0.74, 17.9, False, False),
        (0.74, 12.0, False, False),
        (0.90, 10.0, True, False),  # two lost, five gained
        (0.83, 10.0, False, False),
        (0.70, 10.0, False, False),
    ):
        assert acceptable(old, Quality(iou_, psnr_), ours) == weighed
        assert acceptable(old, Quality(iou_, psnr_), always) == strict
    for limits in ({"guard_iou": 0.0}, {"guard_psnr": 0.0}, {"guard_iou": 0.0, "guard_psnr": 0.0}):
        assert not acceptable(old, Quality(0.7, 10.0), MergeParams(**limits))
        assert not acceptable(old, Quality(0.7, 30.0), MergeParams(**limits))
        assert not acceptable(old, Quality(1.0, 2.0), MergeParams(**limits))
        assert acceptable(old, old, MergeParams(**limits))


def test_the_quality_of_gaussians_is_that_counted_over_the_pixels_of_their_masks(built):
    both, camera = concatenate([built.box, built.ball]), camera_of(built.scene.cameras, 0)
    shown = render(both, camera, label_ids=[1, 2])
    box, ball = shown.label_masks >= 0.5
    ids = np.where(box, 0, np.where(ball, 1, NONE_OF_MINE))
    said, beside = np.flatnonzero(box)[: box.sum() // 4], np.flatnonzero(ball)[: ball.sum() // 3]
    ids.ravel()[said] = IGNORED  # no error, whatever is shown there
    ids.ravel()[beside] = NONE_OF_MINE
    inside, nothing = ids >= 0, np.zeros(ids.shape, bool)
    image = shown.rgb + np.where(inside, 0.1, 0.5)[..., None].astype(np.float32)
    view = TrainView(camera, image, inside, nothing, np.zeros(ids.shape, np.float32), ids)
    found = quality(both, [view, replace(view, inside=nothing)], np.int32([1, 2]))
    assert found.iou == pytest.approx((1 + 1 - len(beside) / ball.sum()) / 2)
    assert found.psnr == pytest.approx(20, abs=1e-3)
    assert quality(both, [replace(view, inside=nothing)], np.int32([1, 2])) == Quality(1.0, 100.0)


@pytest.mark.parametrize(("most", "looked_at"), [(3, [0, 3, 6]), (8, range(8)), (12, range(8))])
def test_the_guard_measures_before_and_after_on_as_many_views_evenly_spread(built, monkeypatch, most, looked_at):
    heard = []
    monkeypatch.setattr(guard_module, "quality", lambda *measured: heard.append(measured[:2]) or Quality(1.0, 30.0))
    params = replace(MERGE, guard_views=most)
    assert guarded(built.box, built.ball, list(range(8)), np.int32([1]), params) is built.ball
    assert heard == [(built.box, list(looked_at)), (built.ball, list(looked_at))]
