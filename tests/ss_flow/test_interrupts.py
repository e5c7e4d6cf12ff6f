"""Runs that are interrupted or killed, and those that go on after them."""

from __future__ import annotations

import signal
import time

import psutil
import pytest
import ss_flow_toy as toy
from executor_calls import wait_for
from fresh_stores import computed, run
from toy_programs import claims, start

from ss_flow.runs import latest_runs


@pytest.mark.parametrize("executor", ["threads", "processes"])
def test_the_first_interrupt_lets_a_task_keep_what_it_has_and_leaves_neither_process_nor_claim(
    store, tmp_path, executor
):
    process = start(store, f"toy.slow_elsewhere(x(), pid_file={str(tmp_path / 'pid')!r})", executor)
    wait_for(lambda: list(store.root.glob("checkpoints/*.npz")))
    worker = int((tmp_path / "pid").read_text())
    process.send_signal(signal.SIGINT)
    _, error = process.communicate(timeout=20)
    assert error.strip().endswith("KeyboardInterrupt")
    assert not psutil.pid_exists(worker)
    assert claims(store) == []
    assert len(list(store.root.glob("checkpoints/*.npz"))) == 1
    events = [event["event"] for event in next(latest_runs(store.root / "roots" / "runs")).events()]
    assert events[-2:] == ["stopping", "run ended"]


def test_the_second_interrupt_does_not_wait(store, tmp_path):
    process = start(store, f"toy.deaf(x(), pid_file={str(tmp_path / 'pid')!r})")
    wait_for(lambda: (tmp_path / "pid").exists() and (tmp_path / "pid").read_text())
    worker = int((tmp_path / "pid").read_text())
    process.send_signal(signal.SIGINT)
    time.sleep(1)
    assert process.poll() is None
    process.send_signal(signal.SIGINT)
    process.communicate(timeout=10)
    wait_for(lambda: not psutil.pid_exists(worker))
    assert claims(store) == []


def test_a_killed_run_leaves_no_worker_behind(store, tmp_path):
    process = start(store, f"toy.slow_elsewhere(x(), pid_file={str(tmp_path / 'pid')!r})")
    wait_for(lambda: list(store.root.glob("checkpoints/*.npz")))
    worker = int((tmp_path / "pid").read_text())
    process.kill()
    process.communicate()
    wait_for(lambda: not psutil.pid_exists(worker))


def test_a_run_goes_on_where_a_killed_one_was(store, tmp_path):
    process = start(store, f"toy.slow_elsewhere(x(), pid_file={str(tmp_path / 'pid')!r})")
    wait_for(lambda: list(store.root.glob("checkpoints/*.npz")))
    process.kill()
    process.communicate()
    assert claims(store)
    report = run(store, lambda: {"source": toy.source(values=(2.0,))})
    assert computed(report) == []
    second = start(store, f"toy.slow_elsewhere(x(), pid_file={str(tmp_path / 'pid2')!r})")
    wait_for(lambda: (tmp_path / "pid2").exists())  # the claim of the dead holds nobody up
    second.kill()
    second.communicate()
