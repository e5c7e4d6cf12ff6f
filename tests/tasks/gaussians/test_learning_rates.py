"""How fast each parameter learns, and when."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from ray_cast_ball import VIEWS, ball_points, same_bytes

from ss_flow.tasks.gaussians.learning_rates import LearningRates
from ss_flow.tasks.gaussians.trainer import TrainParams, train


def test_rates_fall_along_half_a_cosine_to_the_share_that_is_left():
    rates = LearningRates(1.0, 0.01, 2.0, 4.0, 6.0, 8.0, final_share=0.1, fall="cosine")
    others = ("color", "opacity", "scale", "rotation")
    for share, position, left in ((0.0, 1.0, 1.0), (0.25, 0.855, 0.868), (0.5, 0.505, 0.55), (1.0, 0.01, 0.1)):
        now = rates.at(share)
        assert now.position == pytest.approx(position, abs=1e-3)
        for name in others:
            assert getattr(now, name) == pytest.approx(left * getattr(rates, name), rel=1e-3)


def test_the_means_alone_slow_down_in_3dgs():
    rates = LearningRates(1.0, 0.01, 0.1, 0.7, 0.3, 0.9)
    assert rates.at(0.5) == replace(rates, position=pytest.approx(0.1))


def test_colours_above_degree_0_learn_a_twentieth_as_fast():
    rates = LearningRates(1.0, 0.01, 2.0, 4.0, 6.0, 8.0).by_parameter(0.5)
    assert rates == {
        "means": 0.5, "quaternions": 8.0, "log_scales": 6.0, "opacity_logits": 4.0, "sh": 2.0, "sh_rest": 0.1
    }  # fmt: skip


def test_a_step_whose_rates_have_fallen_to_nothing_moves_nothing():
    ball = ball_points()
    params = TrainParams(iterations=1, densify="none", prune_contribution=0.0, prune_opacity=0.0)
    slow = replace(params, rates=LearningRates(final_share=0.0, position_final=0.0, fall="cosine"), iterations=2)
    first, both = (train(ball, VIEWS[:1], params=p, extent=1.6, seed=1).gaussians for p in (params, slow))
    assert same_bytes(first, both)
    assert not same_bytes(first, ball)


@pytest.mark.parametrize(("iterations", "coefficients"), [(19, 1), (20, 9), (29, 9), (30, 16)])
def test_colours_gain_a_degree_every_so_many_steps(iterations, coefficients):
    params = TrainParams(iterations=iterations, sh_degree=3, sh_every=10, densify="none")
    sh = train(ball_points(), VIEWS, params=params, extent=1.6, seed=1).gaussians.sh
    assert sh.shape[1] == coefficients
    used = np.abs(sh).max(axis=(0, 2)) > 0
    assert used.sum() == coefficients  # the last step is the first of the highest degree
