"""The same training gives the same bytes: on more threads, beside another one, and after an interrupt."""

from __future__ import annotations

import threading
from dataclasses import replace

import pytest
from ray_cast_ball import VIEWS, ball_points, part_view

from ss_flow.running import Surroundings, running
from ss_flow.tasks.gaussians.native_pass import PARAMETERS
from ss_flow.tasks.gaussians.trainer import TrainParams, train


def test_threads_beside_it_do_not_change_a_byte(native):
    params = TrainParams(iterations=60)
    alone = train(ball_points(), VIEWS, params=params, extent=1.6, seed=1)
    found = {}

    def work(seed: int) -> None:
        found[seed] = train(ball_points(), VIEWS, params=params, extent=1.6, seed=seed)

    threads = [threading.Thread(target=work, args=(seed,)) for seed in (1, 2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert found[1].gaussians.means.tobytes() == alone.gaussians.means.tobytes()
    assert found[2].gaussians.means.tobytes() != alone.gaussians.means.tobytes()


@pytest.mark.parametrize("with_parts", [False, True])
def test_the_number_of_threads_changes_no_byte(native, with_parts):
    params = TrainParams(iterations=240)
    parts = [part_view(0, 300, 0.3), part_view(0, 150, 2.0), part_view(100, 300, 4.0)] if with_parts else []
    if with_parts:
        params = replace(params, densify="none", part_weight=0.5, parts_per_step=2, max_length=1.5)
    trained = []
    for cores in (1, 2, 3):
        with running(Surroundings(cores=cores)):
            trained.append(train(ball_points(), VIEWS, params=params, extent=1.6, seed=1, parts=parts))
    assert with_parts or len(trained[0].gaussians) != 300
    for other in trained[1:]:
        assert all(
            getattr(other.gaussians, name).tobytes() == getattr(trained[0].gaussians, name).tobytes()
            for name in PARAMETERS
        )
        assert other.loss.tobytes() == trained[0].loss.tobytes()


@pytest.mark.parametrize("strategy", ["classic", "none"])
def test_a_training_that_was_interrupted_goes_on_to_the_same_bytes(native, strategy, tmp_path):
    params = TrainParams(iterations=320, densify=strategy, part_weight=0.1, parts_per_step=2)
    parts = [part_view(0, 200, angle) for angle in (0.3, 0.9, 1.8)] if strategy == "none" else []
    alone = train(ball_points(), VIEWS, params=params, extent=1.6, seed=1, parts=parts)

    class Interrupted(Exception):
        pass

    first_steps = []

    def stop_at_150(done, total, note):
        first_steps.append(done)
        if done == 150:
            raise Interrupted

    here = Surroundings(stop_at_150, checkpoint=tmp_path / "kept.npz")
    with running(here), pytest.raises(Interrupted):
        train(ball_points(), VIEWS, params=params, extent=1.6, seed=1, parts=parts)
    steps = []
    with running(replace(here, listener=lambda done, total, note: steps.append(done))):
        resumed = train(ball_points(), VIEWS, params=params, extent=1.6, seed=1, parts=parts)
    assert steps == [200, 250, 300, 320] and first_steps == [50, 100, 150]
    assert resumed.gaussians.means.tobytes() == alone.gaussians.means.tobytes()
    assert resumed.gaussians.sh.tobytes() == alone.gaussians.sh.tobytes()
    assert resumed.loss.tobytes() == alone.loss.tobytes()
