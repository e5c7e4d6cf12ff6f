"""What is kept and what ends when a Dask worker, scheduler or client is lost, interrupted or killed."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time

import psutil
import pytest
import ss_flow_toy as toy
from dask_clusters import SUPPORT, at, dask_cluster
from executor_calls import PATIENCE, Opened, call, pid_in, wait_for
from toy_runs import value

from ss_flow.engine import run_flow
from ss_flow.errors import ExecutorLost
from ss_flow.events import Reporter
from ss_flow.execute import Cancelled
from ss_flow.graph import each


def test_a_call_that_dask_lost_with_its_worker_is_run_by_another(store):

    begun = []

    class Killer(Reporter):
        def progressed(self, label, done, total, note):
            if "located" not in label:
                return
            begun.append(label)
            if len(begun) == 1:
                os.kill(int(note), signal.SIGKILL)

    def build():
        return {"total": toy.total(each(toy.source(values=(1.0, 2.0)), build=lambda x: toy.located(x, seconds=2.0)))}

    with dask_cluster() as cluster:
        report = run_flow(build, store, scene="toy", executor=at(cluster), reporter=Killer())
    assert value(store, report.values["total"]) == 3.0
    assert len(begun) == 3, "two calls, and one of them again"


def test_a_lost_scheduler_ends_the_run_with_one_sentence_and_what_was_finished_is_kept(store, servers):
    class Killer(Reporter):
        def progressed(self, label, done, total, note):
            servers.scheduler.kill()

    def build():
        return {"end": toy.crawl(toy.square(toy.source(values=(2.0,))[0]), seconds=5.0)}

    with pytest.raises(ExecutorLost) as lost:
        run_flow(build, store, scene="toy", executor=f"dask://{servers.address}", reporter=Killer())
    assert str(lost.value) == (
        f"the Dask scheduler at tcp://{servers.address} was lost. What was finished is kept: run again to go on."
    )
    assert list((store.root / "claims").iterdir()) == []
    again = run_flow(build, store, scene="toy", until="end")
    assert [node["label"] for node in again.nodes if node["event"] == "finished"] == ["ss_flow_toy.crawl"]


def test_a_call_after_the_scheduler_was_lost_fails_at_once(store, servers):
    executor = Opened(f"dask://{servers.address}", store)
    servers.scheduler.kill()
    error = executor.error(call(store, toy.slow, 1.0))
    assert isinstance(error, ExecutorLost)
    assert isinstance(executor.error(call(store, toy.square, 1.0)), ExecutorLost)
    started = time.monotonic()
    executor.pool.kill()
    assert time.monotonic() - started < 10


def test_a_run_goes_on_where_a_killed_client_was(store, servers):
    program = f"""
import ss_flow_toy as toy
from pathlib import Path
from ss_flow.cache.store import Store
from ss_flow.engine import run_flow
build = lambda: {{"end": toy.crawl(toy.square(toy.source(values=(2.0,))[0]), seconds=3.0)}}
run_flow(build, Store(Path({str(store.root)!r})), scene="toy", executor="dask://{servers.address}")
"""
    client = subprocess.Popen([sys.executable, "-c", program], env=servers.environment)
    wait_for(lambda: len(list(store.actions())) == 2 and len(list((store.root / "claims").iterdir())) == 2)
    client.kill()
    client.wait()
    report = run_flow(
        lambda: {"end": toy.crawl(toy.square(toy.source(values=(2.0,))[0]), seconds=0.1)},
        store,
        scene="toy",
        executor=f"dask://{servers.address}",
    )
    assert [node["label"] for node in report.nodes if node["event"] == "hit"] == [
        "ss_flow_toy.source",
        "ss_flow_toy.square",
    ]
    assert value(store, report.values["end"]) == 4.0


def test_a_killed_call_of_another_cluster_leaves_its_worker_at_its_next_progress(store, servers):
    executor = Opened(f"dask://{servers.address}", store)
    future = executor.pool.submit(call(store, toy.slow, 1.0))
    wait_for(lambda: executor.heard)
    executor.pool.kill()
    assert isinstance(future.exception(PATIENCE), Cancelled)
    following = Opened(f"dask://{servers.address}", store)
    started = time.monotonic()
    following.run(call(store, toy.square, 3.0))  # there is but one worker
    assert time.monotonic() - started < 5
    following.pool.close()


PROGRAM = """
import sys
sys.path.insert(0, {support!r})
import ss_flow_toy as toy
from pathlib import Path
from ss_flow.cache.store import Store
from ss_flow.engine import run_flow
x = lambda: toy.source(values=(2.0,))[0]
try:
    run_flow(lambda: {{"out": {call}}}, Store(Path("store")), scene="toy", executor="dask", jobs=2)
    print("done")
except KeyboardInterrupt:
    print("interrupted")
"""


def start(folder, call):
    return subprocess.Popen(
        [sys.executable, "-c", PROGRAM.format(support=SUPPORT, call=call)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        cwd=folder,
        start_new_session=True,
    )


def test_a_run_on_a_cluster_of_its_own_prints_nothing_and_leaves_no_process(tmp_path):
    pytest.importorskip("distributed")
    process = start(tmp_path, "toy.crawl(toy.loud(x()), seconds=1.0)")
    wait_for(lambda: len(list(tmp_path.glob("store/actions/*/*"))) == 2)
    children = psutil.Process(process.pid).children(recursive=True)
    output, errors = process.communicate(timeout=PATIENCE)
    assert output == "done\n"
    assert sorted(errors.splitlines()) == ["noise", "noise of native code"]
    assert len(children) >= 2
    wait_for(lambda: not any(child.is_running() for child in children))


def test_ctrl_c_reaches_our_process_alone_and_leaves_no_other(tmp_path):
    pytest.importorskip("distributed")
    process = start(tmp_path, f"toy.slow_elsewhere(x(), pid_file={str(tmp_path / 'pid')!r})")
    wait_for(lambda: list(tmp_path.glob("store/checkpoints/*.npz")))
    children = psutil.Process(process.pid).children(recursive=True)
    os.killpg(process.pid, signal.SIGINT)  # as a terminal does
    output, errors = process.communicate(timeout=PATIENCE)
    assert (output, errors) == ("interrupted\n", "")
    assert list(tmp_path.glob("store/checkpoints/*.npz"))
    wait_for(lambda: not any(child.is_running() for child in children))


def test_the_workers_of_a_killed_run_end_with_it(tmp_path):
    pytest.importorskip("distributed")
    process = start(tmp_path, f"toy.deaf(x(), pid_file={str(tmp_path / 'pid')!r})")
    pid_in(tmp_path / "pid")
    children = psutil.Process(process.pid).children(recursive=True)
    process.kill()
    process.communicate()
    assert len(children) >= 3
    wait_for(lambda: not any(child.is_running() for child in children))
