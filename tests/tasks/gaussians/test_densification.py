"""When Gaussians are cloned, split and dropped, and what becomes of their momenta."""

from __future__ import annotations

import numpy as np
import pytest

from ss_flow.tasks.artifacts import Gaussians
from ss_flow.tasks.gaussians.backends import NativeBackend
from ss_flow.tasks.gaussians.densification import (
    REFERENCE_ROWS,
    AdaptiveControl,
    GradientRecord,
    Schedule,
    Seen,
    densify,
)
from ss_flow.tasks.gaussians.initialise import initialise
from ss_flow.tasks.gaussians.optimizer import Parameters


def three_gaussians() -> Gaussians:
    return initialise(np.eye(3, dtype=np.float32), np.zeros((3, 3), np.uint8), 1, 1.0)


def test_large_gaussians_are_split_and_small_ones_cloned():
    points = three_gaussians()
    parameters = {"means": points.means, "quaternions": points.quaternions, "log_scales": points.log_scales.copy()}
    parameters["log_scales"][0] = np.log(0.001)
    values, source, fresh = densify(
        parameters, np.array([1.0, 1.0, 0.0]), threshold=0.5, extent=1.0, most=10, generator=np.random.default_rng(0),
        backend=NativeBackend(1),
    )  # fmt: skip
    assert source.tolist() == [0, 2, 0, 1, 1] and fresh.tolist() == [False, False, True, True, True]
    assert np.array_equal(values["means"][2], points.means[0])
    assert np.allclose(np.exp(values["log_scales"][3:]), np.exp(points.log_scales[1]) / 1.6)
    assert not np.array_equal(values["means"][3], values["means"][4])


@pytest.mark.parametrize(("most", "sources"), [(8, [0, 1, 2, 3, 4, 5, 1, 3]), (4, [0, 1, 2, 3, 4, 5])])
def test_densification_ends_at_the_limit_with_the_largest_gradients_first(most, sources):
    points = initialise(np.random.default_rng(0).random((6, 3)).astype(np.float32), np.zeros((6, 3), np.uint8), 1, 1.0)
    parameters = {"means": points.means, "quaternions": points.quaternions, "log_scales": points.log_scales - 9}
    gradient = np.array([1, 6, 2, 5, 3, 4.0])
    _, source, _ = densify(
        parameters, gradient, threshold=0.5, extent=1, most=most, generator=np.random.default_rng(0),
        backend=NativeBackend(1),
    )  # fmt: skip
    assert source.tolist() == sources


def test_the_halves_of_a_split_gaussian_lie_along_it_as_it_is_turned():
    half = np.sqrt(0.5)
    needle = {
        "means": np.zeros((1, 3), np.float32),
        "quaternions": np.array([[half, 0, 0, half]], np.float32),  # a quarter turn about z: x becomes y
        "log_scales": np.log(np.array([[1, 1e-4, 1e-4]], np.float32)),
    }
    values, *_ = densify(
        needle, np.ones(1), threshold=0.5, extent=1.0, most=9, generator=np.random.default_rng(0),
        backend=NativeBackend(1),
    )  # fmt: skip
    away = np.abs(values["means"])
    assert (away[:, 1] > 0.05).all() and (away[:, [0, 2]] < 1e-3).all()


def densified(given: Gaussians, step: int, **changes) -> list[int]:
    """Which of three Gaussians are left after a step, when they are looked at every 10, and reset every 20."""
    backend = NativeBackend(1)
    rules = {"threshold": 1.0, "extent": 2.0, "most": 9, "prune_opacity": 0.0, **changes}
    control = AdaptiveControl(GradientRecord(3, backend), Schedule(0, 100, 10, 20), **rules)
    parameters, nothing = Parameters(given, 0, backend), Seen(np.zeros((3, 2), np.float32), np.ones(3, np.float32), 1)
    control.after(step, parameters, nothing, np.random.default_rng(0))
    return parameters.origin.tolist()


@pytest.mark.parametrize(("step", "kept"), [(20, [0, 1, 2]), (30, [0, 1])])
def test_what_is_larger_than_a_tenth_of_the_scene_is_dropped_once_opacities_have_been_reset(step, kept):
    given = three_gaussians()
    given.log_scales[:] = np.log([[0.01], [0.19], [0.21]])
    assert densified(given, step) == kept


def test_what_is_faint_is_dropped_whenever_gaussians_are_cloned_and_split():
    given = three_gaussians()
    given.opacity_logits[:] = np.log([0.1 / 0.9, 0.01 / 0.99, 0.1 / 0.9])
    assert densified(given, 10, prune_opacity=0.05) == [0, 2]


def moving() -> Parameters:
    """Three Gaussians, with momenta of 1 in everything."""
    parameters = Parameters(three_gaussians(), 0, NativeBackend(1))
    state = parameters.state()
    parameters.restore({name: np.ones_like(a) if is_momentum(name) else a for name, a in state.items()})
    return parameters


def is_momentum(name: str) -> bool:
    return name.startswith(("first.", "second."))


def test_new_rows_start_without_momentum_and_old_ones_keep_theirs():
    parameters, rows = moving(), np.array([2, 0, 0])
    parameters.rearrange({n: a[rows] for n, a in parameters.values.items()}, rows, np.array([False, False, True]))
    state = parameters.state()
    assert state["origin"].tolist() == [2, 0, 0]
    assert all(a[:2].all() and not a[2].any() for name, a in state.items() if is_momentum(name))


def test_opacities_that_are_reset_lose_their_momentum_and_nothing_else_does():
    parameters = moving()
    parameters.limit_opacity(0.01)
    assert parameters.opacities() == pytest.approx(0.01)
    momenta = {name: a.any() for name, a in parameters.state().items() if is_momentum(name)}
    assert {name for name, kept in momenta.items() if not kept} == {"first.opacity_logits", "second.opacity_logits"}


def test_the_gradient_record_averages_over_the_views_that_saw():
    record = GradientRecord(2, NativeBackend(1))
    record.add(np.array([[3, 4], [0, 0]], np.float32), np.array([1, 0], np.float32), 2 * REFERENCE_ROWS)
    record.add(np.array([[0, 1], [0, 2]], np.float32), np.array([1, 1], np.float32), 2 * REFERENCE_ROWS)
    assert record.mean().tolist() == [3, 2]


def test_a_long_training_densifies_as_3dgs_does():
    assert Schedule().of(30_000) == Schedule(500, 15_000, 100, 3_000)


@pytest.mark.parametrize(
    ("stop", "reset_every", "iterations", "densified", "resets"),
    [
        (15_000, 3_000, 1_000, (600, 900), []),  # paper
        (10_000, 1_000, 1_000, (600, 900), []),  # the code of its authors: the reset of step 1,000 comes too late
        (15_000, 3_000, 10_000, (600, 9_900), [3_000, 6_000, 9_000]),  # paper, LERF
        (10_000, 1_000, 10_000, (600, 9_900), list(range(1_000, 10_000, 1_000))),
    ],
)
def test_a_schedule_that_is_not_shortened_ends_before_the_last_step(stop, reset_every, iterations, densified, resets):
    schedule = Schedule(500, stop, 100, reset_every, shorten=False).of(iterations)
    steps = [step for step in range(1, iterations + 1) if schedule.densifies(step)]
    assert (steps[0], steps[-1], len(steps)) == (*densified, 1 + (densified[1] - densified[0]) // 100)
    assert [step for step in range(1, iterations + 1) if schedule.resets(step)] == resets


@pytest.mark.parametrize("most", [99, 120, 199, 200, 201, 1_000])
@pytest.mark.parametrize("shorten", [True, False])
@pytest.mark.parametrize(("every", "reset_every"), [(100, 3_000), (3_000, 100), (3_000, 4_000)])
def test_a_schedule_that_is_not_reached_does_nothing_in_any_training_that_short(most, shorten, every, reset_every):
    schedule = Schedule(0, every=every, reset_every=reset_every, shorten=shorten)
    acts = [
        schedule.of(steps).densifies(step) or schedule.of(steps).resets(step)
        for steps in range(1, most + 1)
        for step in range(100, steps + 1, 100)
    ]
    assert schedule.reached(most) or not any(acts)
    if reset_every > every:  # a reset comes before the step after which nothing comes
        assert schedule.reached(most) == any(acts)
