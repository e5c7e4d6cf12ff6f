"""Tasks whose memory runs out, and processes that are killed or forked."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import psutil
import pytest
import ss_flow_toy as toy
from fresh_stores import computed, one, run

from ss_flow.cache.store import Store
from ss_flow.errors import InputError
from ss_flow.events import Reporter
from ss_flow.graph import each


def test_tasks_never_declare_more_memory_together_than_the_run_may_use(store):
    running, most = set(), []

    class Watch(Reporter):
        def event(self, kind, **details):
            if kind == "started" and "hungry" in details["step"]:
                running.add(details["label"])
                most.append(len(running))
            elif kind == "finished":
                running.discard(details["label"])

    def build():
        return {"all": each(toy.source(values=tuple(map(float, range(4)))), build=toy.hungry)}

    run(store, build, memory_mb=1500, jobs=4, reporter=Watch())
    assert max(most) == 1
    with pytest.raises(InputError, match="needs 1000 MB of memory, but the run may use 500 MB"):
        raise run(Store(store.root.parent / "b"), build, memory_mb=500).failures[0].error


def test_a_task_whose_process_was_killed_is_tried_once_more_alone(store, tmp_path):
    told = []

    class Watch(Reporter):
        def event(self, kind, **details):
            if kind in ("retried", "failed"):
                told.append((kind, details.get("because", details.get("error"))))

    marker = str(tmp_path / "marker")
    report = run(store, one(lambda x: toy.killed_once(x, marker=marker)), reporter=Watch())
    assert computed(report) == ["ss_flow_toy.killed_once", "ss_flow_toy.source"]
    assert told == [
        ("retried", "WorkerDied: the process of ss_flow_toy.killed_once was killed, as happens when memory runs out")
    ]
    told.clear()
    run(store, one(toy.killed), reporter=Watch())
    assert [kind for kind, _ in told] == ["retried", "failed"]
    assert all("memory runs out" in because for _, because in told)


@pytest.mark.parametrize("executor", ["threads", "processes"])
def test_a_task_whose_memory_ran_out_knows_its_last_try(store, executor):
    report = run(store, one(toy.makes_do), executor=executor)
    assert computed(report) == ["ss_flow_toy.makes_do", "ss_flow_toy.source"]


def test_a_killed_process_is_not_waited_for_until_a_child_that_its_task_forked_ends(store, tmp_path):
    child = tmp_path / "child"
    report = run(store, one(lambda x: toy.killed_beside_its_child(x, child_file=str(child))))
    assert computed(report) == ["ss_flow_toy.killed_beside_its_child", "ss_flow_toy.source"]
    left = psutil.Process(int(child.read_text()))
    assert left.status() != psutil.STATUS_ZOMBIE
    left.kill()


AFTER_A_FORK = """
import os, sys, threading
sys.path.insert(0, {support!r})
import ss_flow_toy as toy
from ss_flow import execute
from ss_flow.cache.store import Store
from ss_flow.engine import run_flow
run_flow(toy.flow, Store({store!r}), scene="toy")
end, held = os.pipe()
execute._peaks._lock.acquire()
if os.fork():
    os._exit(0)
os.close(held)
os.read(end, 1)  # until the parent has gone
report = run_flow(lambda: toy.flow(values=(5.0, 6.0)), Store({store!r}), scene="toy")
print(report.failures, any(thread.name == "peak-memory" for thread in threading.enumerate()), flush=True)
"""


def test_a_forked_process_runs_flows_when_its_parent_has_gone(store):
    program = AFTER_A_FORK.format(support=str(Path(toy.__file__).parent), store=str(store.root))
    ran = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=120)
    assert (ran.stdout, ran.stderr) == ("[] True\n", "")
