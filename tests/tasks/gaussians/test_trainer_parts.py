"""Parts that are seen without the others, from where there is no photo."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from ray_cast_ball import VIEWS, ball_points, ball_view, part_view, same_bytes

from ss_flow.tasks.gaussians.initialise import concatenate, initialise, select
from ss_flow.tasks.gaussians.render import render
from ss_flow.tasks.gaussians.trainer import TrainParams, train


def test_what_no_photo_shows_goes_where_it_is_seen_alone_from_the_side(native):
    ball, behind = ball_points(), np.array([[0, 0, 1.3]], np.float32)
    hidden = initialise(np.repeat(behind, 5, axis=0), np.zeros((5, 3), np.uint8), 4, 0.5, opacity=0.9)
    hidden = replace(hidden, log_scales=np.full((5, 3), np.log(0.1), np.float32))
    both, front = concatenate([ball, hidden]), VIEWS[:1]
    params = TrainParams(iterations=150, densify="none", part_weight=0.5, prune_contribution=0.0)
    side = ball_view(np.pi / 2)

    def beside(gaussians) -> float:
        return float(render(gaussians, side.camera).alpha[~side.inside].mean())

    parts = [part_view(0, len(both), np.pi / 2)]
    with_parts = train(both, front, params=params, extent=1.6, seed=1, parts=parts).gaussians
    without = train(both, front, params=replace(params, part_weight=0.0), extent=1.6, seed=1, parts=parts).gaussians
    assert same_bytes(without, train(both, front, params=params, extent=1.6, seed=1).gaussians)
    assert beside(with_parts) < 0.3 * beside(without)


def test_a_part_is_seen_without_the_others_and_moves_them_by_nothing():
    ball = ball_points()
    params = TrainParams(iterations=1, densify="none", part_weight=0.5, prune_contribution=0.0, prune_opacity=0.0)
    alone = train(ball, VIEWS, params=params, extent=1.6, seed=1, parts=[part_view(0, 300, 0.3)]).gaussians
    none = train(ball, VIEWS, params=params, extent=1.6, seed=1).gaussians
    out_of_sight = initialise(np.full((1, 3), 50, np.float32), np.zeros((1, 3), np.uint8), 5, 0.5)
    for both, rows, others in (
        (concatenate([ball, out_of_sight]), slice(0, 300), slice(300, 301)),
        (concatenate([out_of_sight, ball]), slice(1, 301), slice(0, 1)),
    ):
        part = part_view(rows.start, rows.stop, 0.3)
        found = train(both, VIEWS, params=params, extent=1.6, seed=1, parts=[part]).gaussians
        assert same_bytes(select(found, np.arange(len(both))[rows]), alone)
        assert np.array_equal(found.log_scales[others], both.log_scales[others])
    assert not np.array_equal(alone.log_scales, none.log_scales)
    assert np.array_equal(alone.sh, none.sh)  # its colours do not count


def test_a_step_sees_as_many_parts_as_asked_for_one_after_the_other():
    ball, behind = ball_points(), np.array([[0, 0, 1.3]], np.float32)
    hidden = initialise(np.repeat(behind, 5, axis=0), np.zeros((5, 3), np.uint8), 4, 0.5, opacity=0.9)
    both = concatenate([ball, replace(hidden, log_scales=np.full((5, 3), np.log(0.1), np.float32))])
    parts = [part_view(0, 300, 0.3), part_view(300, 305, np.pi / 2)]

    def moved(parts_per_step: int, iterations: int) -> tuple[bool, bool]:
        params = TrainParams(
            iterations=iterations, densify="none", part_weight=0.5, parts_per_step=parts_per_step,
            prune_contribution=0.0, prune_opacity=0.0,
        )  # fmt: skip
        found, without = (
            train(both, VIEWS[:1], params=params, extent=1.6, seed=1, parts=some).gaussians.log_scales
            for some in (parts, [])
        )
        return tuple(not np.array_equal(found[rows], without[rows]) for rows in (slice(300), slice(300, 305)))

    assert sorted(moved(1, 1)) == [False, True]
    assert moved(2, 1) == (True, True) == moved(1, 2)


def test_views_of_parts_need_rows_that_stay():
    with pytest.raises(ValueError, match="densify must be none"):
        train(ball_points(), VIEWS, params=TrainParams(iterations=1), extent=1.6, seed=1, parts=[part_view(0, 9, 0.3)])
