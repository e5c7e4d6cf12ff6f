"""One contract for all executors; then which process a call gets."""

from __future__ import annotations

import os
import sys
import time
from dataclasses import replace

import psutil
import pytest
import ss_flow_toy as toy
from dask_clusters import SUPPORT, at
from executor_calls import PATIENCE, Opened, call, pid_in, wait_for
from toy_runs import value

from ss_flow.cache.errors import Gone
from ss_flow.engine import run_flow
from ss_flow.errors import InputError
from ss_flow.execute import Cancelled
from ss_flow.executors import open_executor
from ss_flow.executors.worker import WorkerDied
from ss_flow.task import Resources

IN_THIS_PROCESS = ("mixed", "threads")
"""Executors that run a call which has nothing beside it here."""


@pytest.fixture(params=["mixed", "threads", "processes", "dask", "dask://HOST:PORT"])
def executor(request, store):
    name = request.param
    if name == "dask":
        pytest.importorskip("distributed")
    elif name == "dask://HOST:PORT":
        name = at(request.getfixturevalue("cluster"))
    opened = Opened(name, store)
    opened.name = request.param
    yield opened
    opened.pool.close()


def test_a_call_leaves_its_result_and_its_record_in_the_store(store, executor):
    invocation = call(store, toy.square, 3.0)
    action = executor.run(invocation)
    assert value(store, action.outputs[0]) == 9.0
    assert store.action(invocation.key) == action


def test_what_a_task_raises_comes_back_as_itself(store, executor):
    error = executor.error(call(store, toy.half, -1.0))
    assert type(error) is ValueError
    assert str(error) == "negative"


@pytest.mark.parametrize(("task", "raised"), [(toy.unsayable, ValueError), (toy.unmade, toy.Unmade)])
def test_what_cannot_travel_comes_back_as_its_text(store, executor, task, raised):
    error = executor.error(call(store, task, 2.0))
    assert type(error) is (raised if executor.name in IN_THIS_PROCESS else RuntimeError)
    assert "two is too much" in str(error)
    assert value(store, executor.run(call(store, toy.square, 3.0)).outputs[0]) == 9.0


@pytest.mark.parametrize("isolated", [True, False])
def test_a_task_that_raises_what_a_lost_process_does_has_failed_of_itself(store, executor, isolated):
    error = executor.error(replace(call(store, toy.raising, 2.0, error="EOFError"), isolate=isolated))
    assert type(error) is EOFError and str(error) == "two is too much"


@pytest.mark.parametrize("name", ["SystemExit", "KeyboardInterrupt", "GeneratorExit"])
def test_a_task_that_raises_what_ends_a_program_has_failed_and_the_next_one_is_run(store, executor, name):
    error = executor.error(call(store, toy.raising, 2.0, error=name))
    if executor.name in IN_THIS_PROCESS:
        assert type(error).__name__ == name
    else:
        assert type(error) is RuntimeError and str(error) == f"{name}: two is too much"
    assert value(store, executor.run(call(store, toy.square, 3.0)).outputs[0]) == 9.0


def test_an_isolated_call_has_a_process_of_its_own_which_ends_with_it(store, executor):
    pids = [int(value(store, executor.run(call(store, toy.own_process, x)).outputs[0])) for x in (1.0, 2.0)]
    assert len({*pids, os.getpid()}) == 3
    assert not any(map(psutil.pid_exists, pids))


def test_progress_of_a_call_is_heard(store, executor):
    invocation = call(store, toy.crawl, 1.0, seconds=1.0)
    executor.run(invocation)
    wait_for(lambda: len(executor.heard) >= 3)
    assert executor.heard[0] == (invocation.key, 0, 20, "")
    assert [done for _, done, _, _ in executor.heard] == sorted({done for _, done, _, _ in executor.heard})


def test_cancel_ends_calls_at_their_next_progress_and_lets_no_other_start(store, executor):
    calls = [call(store, toy.slow, float(x)) for x in range(4)]
    futures = [executor.pool.submit(c) for c in calls]
    wait_for(lambda: len({key for key, *_ in executor.heard}) == 2)
    executor.pool.cancel()
    started = time.monotonic()
    assert {type(future.exception(PATIENCE)) for future in futures} == {Cancelled}
    assert type(executor.error(call(store, toy.square, 2.0))) is Cancelled
    assert time.monotonic() - started < 5
    assert len({key for key, *_ in executor.heard}) == 2


def test_cancel_lets_an_isolated_call_keep_what_it_has(store, executor, tmp_path):
    invocation = call(store, toy.slow_elsewhere, 1.0, pid_file=str(tmp_path / "pid"))
    future = executor.pool.submit(invocation)
    wait_for(lambda: executor.heard)
    executor.pool.cancel()
    assert type(future.exception(PATIENCE)) is Cancelled
    assert store.checkpoint(invocation.key).exists()
    assert not psutil.pid_exists(pid_in(tmp_path / "pid"))


def test_kill_ends_a_call_that_gives_no_sign(store, executor, tmp_path):
    if executor.name == "dask://HOST:PORT":
        pytest.skip("the processes of another cluster are not ours to end")
    future = executor.pool.submit(call(store, toy.deaf, 1.0, pid_file=str(tmp_path / "pid")))
    pid = pid_in(tmp_path / "pid")
    executor.pool.kill()
    assert isinstance(future.exception(PATIENCE), WorkerDied | Cancelled)
    wait_for(lambda: not psutil.pid_exists(pid))


def test_a_missing_input_is_gone(store, executor):
    error = executor.error(replace(call(store, toy.square, 3.0), inputs={"x": "0" * 64}))
    assert isinstance(error, Gone)
    assert error.digest == "0" * 64


def test_a_call_is_told_how_many_cores_it_has(store, executor):
    invocation = replace(call(store, toy.given_cores, 1.0), resources=Resources(cores=3))
    cores = value(store, executor.run(invocation).outputs[0])
    assert cores == (1 if executor.name == "dask://HOST:PORT" else 3)  # no more than a worker's threads


@pytest.mark.parametrize("isolated", [True, False])
def test_a_call_whose_process_dies_says_so_and_the_next_one_is_run(store, executor, isolated):
    if executor.name in IN_THIS_PROCESS and not isolated:
        pytest.skip("it would be this process")
    error = executor.error(replace(call(store, toy.abort, 1.0), isolate=isolated))
    assert type(error) is WorkerDied
    assert "ss_flow_toy.abort" in str(error)
    assert value(store, executor.run(call(store, toy.square, 3.0)).outputs[0]) == 9.0


def test_a_call_that_failed_may_be_tried_again(store, executor, tmp_path):
    falls_at = tmp_path / "falls_at"
    falls_at.write_text("3")
    invocation = call(store, toy.climb, 1.0, top=5, falls_at=str(falls_at))
    assert str(executor.error(invocation)) == "fell"
    falls_at.unlink()
    assert value(store, executor.run(invocation).outputs[0]) == 3.0


@pytest.mark.parametrize("name", ["dask:", "dask://", "daskk", "mesos"])
def test_an_unknown_executor_is_refused(store, name):
    with pytest.raises(InputError, match="dask://HOST:PORT"):
        open_executor(name, 1, store, print)


def test_a_run_that_is_refused_its_executor_leaves_no_record_and_no_claim(store):
    with pytest.raises(InputError, match="is unknown"):
        run_flow(toy.flow, store, scene="toy", executor="thread")
    assert list(store.runs.iterdir()) == list((store.root / "claims").iterdir()) == []


def located(store, seconds, count, **options):
    """In which process each of some calls was that begin at once, two at a time if not told otherwise."""
    opened = Opened("mixed", store, **options)
    futures = [opened.pool.submit(call(store, toy.located, float(x), seconds=seconds)) for x in range(count)]
    for future in futures:
        future.result(PATIENCE)
    opened.pool.close()
    return [int(note) for _, _, _, note in opened.heard]


def test_calls_that_are_soon_done_start_no_process(store):
    assert set(located(store, 0.05, 6)) == {os.getpid()}


def test_what_runs_beside_a_long_call_gets_a_process_which_the_next_one_has_too(store):
    where = located(store, 2.5, 4)
    assert where.count(os.getpid()) == 2
    assert len(set(where)) == 2


@pytest.mark.parametrize(("processes", "here"), [(0, 3), (1, 2), (5, 1)])
def test_calls_that_there_are_no_processes_for_run_here(store, processes, here):
    where = located(store, 4.0, 3, workers=3, processes=processes)
    assert where.count(os.getpid()) == here


def test_a_process_without_a_call_for_a_while_is_ended_when_another_call_says_how_far_it_is(store, monkeypatch):
    monkeypatch.setattr("ss_flow.executors.local.IDLE_SECONDS", 0.5)
    opened = Opened("processes", store)
    running = [opened.pool.submit(call(store, toy.located, float(x), seconds=1.0)) for x in range(2)]
    for future in running:
        future.result(PATIENCE)
    first = {int(note) for _, _, _, note in opened.heard}
    assert all(map(psutil.pid_exists, first)) and len(first) == 2
    opened.run(call(store, toy.crawl, 3.0, seconds=3.0))
    assert sum(map(psutil.pid_exists, first)) == 1
    opened.pool.close()


def test_a_worker_finds_what_a_prompt_finds_in_its_folder(store, monkeypatch):
    monkeypatch.chdir(SUPPORT)
    monkeypatch.setattr(sys, "path", ["", *(place for place in sys.path if place not in ("", SUPPORT))])
    report = run_flow(toy.flow, store, scene="toy", executor="processes", jobs=1)
    assert report.failures == []
