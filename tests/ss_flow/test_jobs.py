"""Cores and GPUs: how many there are, and who gets them."""

from __future__ import annotations

import pytest
import ss_flow_toy as toy
from toy_runs import run, value

from ss_flow import engine
from ss_flow.execute import Invocation
from ss_flow.jobs import Job, Tokens
from ss_flow.task import Resources


@pytest.mark.parametrize(
    ("ready", "shares"), [(1, [8]), (2, [4, 4]), (3, [2, 3, 3]), (5, [1, 1, 2, 2, 2]), (8, [1] * 8)]
)
def test_jobs_that_are_ready_at_once_share_the_cores_fairly(ready, shares):
    tokens = Tokens(Resources(cores=8, memory_mb=1000))
    wanted = Resources(cores=1, most_cores=8, memory_mb=1)
    given = []
    for place in range(ready):
        job = Job(Invocation(str(place), "", "", {}, {}, {}, wanted, False, ""), [], "", (0, 0))
        tokens.take(job, waiting=ready - 1 - place)
        given.append(job.invocation.resources.cores)
    assert given == shares


def test_the_last_task_that_waits_gets_the_cores_that_nobody_wants(store):
    def flow():
        one, two, three = (toy.source(values=(v,))[0] for v in (1.0, 2.0, 3.0))
        return {"alone": toy.given_cores(one)}, {"first": toy.given_cores(two), "last": toy.given_cores(three)}

    alone = run(store, lambda: flow()[0], jobs=3)
    assert value(store, alone.values["alone"]) == 3
    both = run(store, lambda: flow()[1], jobs=3)
    assert sorted(value(store, d) for d in both.values.values()) == [1, 2]


def test_a_gpu_counts_where_the_driver_shows_one_unless_tasks_are_said_to_use_none(monkeypatch):
    monkeypatch.setattr(engine.glob, "glob", lambda pattern: ["/dev/nvidia0", "/dev/nvidia1"])
    assert [engine._this_machine(gpus).gpus for gpus in (None, 0, 1)] == [1, 0, 1]
