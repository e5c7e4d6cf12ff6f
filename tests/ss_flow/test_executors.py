"""One contract for all executors; then what only a Dask cluster can do and suffer."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path

import psutil
import pytest
import ss_flow_toy as toy

from ss_flow.cache.errors import Gone, StoreFailure
from ss_flow.cache.store import Store
from ss_flow.engine import run_flow
from ss_flow.errors import ExecutorLost, InputError
from ss_flow.events import Reporter
from ss_flow.execute import Cancelled, Invocation
from ss_flow.executors import open_executor
from ss_flow.executors.worker import WorkerDied
from ss_flow.graph import each
from ss_flow.keys import Keys
from ss_flow.task import Resources

SUPPORT = str(Path(toy.__file__).parent)
PATIENCE = 30.0
IN_THIS_PROCESS = ("mixed", "threads")
"""Executors that run a call which has nothing beside it here."""


def dask_cluster(scheduler=None, **options):
    """A Dask cluster of somebody else."""
    distributed = pytest.importorskip("distributed")
    quiet = {"dashboard": False, "dashboard_address": "127.0.0.1:0"}
    return distributed.LocalCluster(
        **{"n_workers": 2, "threads_per_worker": 1, "memory_limit": None, "silence_logs": 51, **options},
        scheduler_kwargs={**quiet, **(scheduler or {})},
    )


def at(cluster):
    """The name of the executor for a cluster."""
    return cluster.scheduler_address.replace("tcp", "dask")


@pytest.fixture(scope="module")
def cluster():
    with dask_cluster({"allowed_failures": 0}) as cluster:
        yield cluster


class Opened:
    """An executor, and what was heard of its calls."""

    def __init__(self, name, store, workers=2, processes=None):
        self.heard = []
        self.pool = open_executor(name, workers, store, lambda *sign: self.heard.append(sign), processes=processes)

    def run(self, invocation):
        return self.pool.submit(invocation).result(PATIENCE)

    def error(self, invocation):
        return self.pool.submit(invocation).exception(PATIENCE)


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


def call(store, task, *inputs, **parameters):
    """A call of a task on numbers."""
    given = dict(zip(task.signature.parameters, (store.put(toy.number(x)) for x in inputs), strict=False))
    keys = Keys()
    return Invocation(
        key=keys.key(task, given, parameters),
        label=task.name,
        task=f"{task.function.__module__}:{task.function.__qualname__}",
        inputs=given,
        parameters=parameters,
        components=keys.components(task, given, parameters),
        resources=task.resources,
        isolate=task.isolate,
        store=store.location,
    )


def value(store, digest):
    return float(store.get(digest).value[0])


def wait_for(condition, seconds=PATIENCE):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.02)


def pid_in(path):
    """The process that said who it is in a file."""
    wait_for(lambda: path.exists() and path.read_text())
    return int(path.read_text())


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


# "mixed" alone


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


# Dask alone


def test_a_flow_on_dask_gives_the_digests_of_threads(store, cluster, tmp_path):
    expected = run_flow(toy.flow, store, scene="toy").values
    for folder, name in (("own", "dask"), ("other", at(cluster))):
        report = run_flow(toy.flow, Store(tmp_path / folder), scene="toy", executor=name, jobs=2)
        assert report.values == expected
        assert {node["event"] for node in report.nodes} == {"finished"}


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


class Servers:
    """A scheduler and a worker in processes of their own, as on other hosts."""

    def __init__(self, folder):
        self.environment = {**os.environ, "PYTHONPATH": os.pathsep.join([SUPPORT, os.environ.get("PYTHONPATH", "")])}
        self.file = folder / "scheduler.json"
        self.scheduler = self.start("scheduler", "--port", "0", "--scheduler-file", str(self.file))
        wait_for(lambda: self.file.exists() and self.file.read_text())
        self.address = json.loads(self.file.read_text())["address"].removeprefix("tcp://")
        self.worker = self.start("worker", self.address, "--nthreads", "1", "--no-nanny")

    def start(self, what, *options):
        command = [sys.executable, "-m", "distributed.cli.dask_" + what, *options, "--host", "127.0.0.1"]
        return subprocess.Popen(
            [*command, "--no-dashboard"], env=self.environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )

    def end(self):
        for process in (self.worker, self.scheduler):
            process.kill()
            process.wait()


@pytest.fixture
def servers(tmp_path):
    pytest.importorskip("distributed")
    started = Servers(tmp_path)
    yield started
    started.end()


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


def test_resources_that_workers_declare_bound_what_a_task_takes_of_them(store):
    with dask_cluster(threads_per_worker=4, resources={"cores": 2, "memory_mb": 1000, "GPU": 1}) as cluster:
        executor = Opened(at(cluster), store)
        assert executor.pool.capacity == Resources(cores=4, memory_mb=2000, gpus=2)
        too_much = Resources(cores=64, memory_mb=10**6, gpus=8)
        action = executor.run(replace(call(store, toy.given_cores, 1.0), resources=too_much))
        assert value(store, action.outputs[0]) == 2.0
        at_once = [replace(call(store, toy.slow, float(x)), resources=Resources(gpus=0.6)) for x in range(3)]
        futures = [executor.pool.submit(invocation) for invocation in at_once]
        wait_for(lambda: sum(done >= 20 for _, done, _, _ in executor.heard) >= 2)
        assert len({key for key, *_ in executor.heard}) == 2, "a third one does not fit onto two GPUs"
        executor.pool.cancel()
        assert {type(future.exception(PATIENCE)) for future in futures} == {Cancelled}
        executor.pool.close()


def worker(threads, **resources):
    """As Dask describes one."""
    return {"nthreads": threads, "memory_limit": 8 << 30, "resources": resources}


@pytest.mark.parametrize(
    ("workers", "asked", "cores"),
    [
        ([], {}, 4),
        ([worker(2), worker(3)], {}, 3),
        ([worker(8)], {}, 4),
        ([worker(1, cores=8)], {"cores": 4}, 4),
        ([worker(1, cores=2), worker(9, cores=3)], {"cores": 3}, 3),
        ([worker(1, cores=2), worker(9)], {"cores": 2}, 2),
        ([worker(8, GPU=1), worker(16)], {"GPU": 0.5}, 4),
        # Nobody has both: the GPU counts more than memory, and memory more than cores.
        ([worker(9, cores=9, memory_mb=9000), worker(2, cores=2, GPU=1)], {"cores": 2, "GPU": 0.5}, 2),
        ([worker(9, cores=9, memory_mb=10), worker(2, cores=2, memory_mb=500)], {"cores": 2, "memory_mb": 500}, 2),
        ([worker(4, other=1)], {}, 4),
    ],
)
def test_no_more_is_asked_of_dask_than_one_of_its_workers_declares(workers, asked, cores):
    from ss_flow.executors.dask import fitted

    assert fitted(Resources(cores=4, memory_mb=1000, gpus=0.5), workers) == (asked, cores)


def test_a_host_without_the_store_says_so_and_makes_none(store, cluster, tmp_path):
    executor = Opened(at(cluster), store)
    error = executor.error(replace(call(store, toy.square, 2.0), store=str(tmp_path / "elsewhere")))
    executor.pool.close()
    assert isinstance(error, StoreFailure)
    assert f"does not have the store {tmp_path / 'elsewhere'}" in str(error)
    assert not (tmp_path / "elsewhere").exists()


@pytest.mark.parametrize(
    ("part", "said"),
    [
        ({"code": "0" * 64}, "code of ss_flow_toy:square changed"),
        ({"packages": {"python": "2.7"}}, "package python 2.7 -> "),
        ({"environment": {"rasterizer": "abacus"}}, "rasterizer of this machine abacus -> "),
    ],
)
def test_a_worker_that_would_compute_something_else_refuses(store, cluster, part, said):
    executor = Opened(at(cluster), store)
    invocation = call(store, toy.square, 2.0)
    error = executor.error(replace(invocation, components={**invocation.components, **part}))
    executor.pool.close()
    assert isinstance(error, ExecutorLost)
    assert said in str(error)
    assert store.action(invocation.key) is None


def test_an_address_where_nobody_answers_is_refused_in_one_sentence(store, monkeypatch):
    pytest.importorskip("distributed")
    monkeypatch.setattr("ss_flow.executors.dask.CONNECT_SECONDS", 0.5)
    for address in ("127.0.0.1:1", "no.such.host.invalid:8786", "127.0.0.1:port", "127.0.0.1"):
        with pytest.raises(InputError, match="no Dask scheduler answers at"):
            run_flow(toy.flow, store, scene="toy", executor=f"dask://{address}")
    assert list((store.root / "claims").iterdir()) == []


def test_a_cluster_of_another_version_is_refused_in_one_sentence(store, servers, monkeypatch):
    monkeypatch.setattr("distributed.__version__", "2020.1.0")
    with pytest.raises(InputError, match=r"has distributed 20\d\d\.\d+\.\d+, not 2020\.1\.0"):
        open_executor(f"dask://{servers.address}", 1, store, print)


def test_a_cluster_without_workers_is_refused_in_one_sentence(store, monkeypatch):
    monkeypatch.setattr("ss_flow.executors.dask.CONNECT_SECONDS", 1.0)
    with dask_cluster(n_workers=0) as cluster, pytest.raises(InputError, match="has no workers"):
        run_flow(toy.flow, store, scene="toy", executor=at(cluster))


@pytest.mark.parametrize("at_once", [True, False], ids=["while we connect", "while we look for workers"])
def test_a_scheduler_that_goes_while_we_connect_is_refused_in_one_sentence(store, servers, monkeypatch, at_once):
    import distributed

    monkeypatch.setattr("ss_flow.executors.dask.CONNECT_SECONDS", 1.0)
    method = "__init__" if at_once else "wait_for_workers"
    real = getattr(distributed.Client, method)

    def bereft(self, *arguments, **options):
        servers.scheduler.kill()
        servers.scheduler.wait()
        return real(self, *arguments, **options)

    monkeypatch.setattr(distributed.Client, method, bereft)
    with pytest.raises(InputError, match="no Dask scheduler answers at"):
        open_executor(f"dask://{servers.address}", 1, store, print)


def test_without_the_package_the_refusal_says_what_to_install(store, monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(InputError, match=r"pip install 'ss-flow\[dask\]'"):
        run_flow(toy.flow, store, scene="toy", executor="dask")


@pytest.mark.parametrize("name", ["dask:", "dask://", "daskk", "mesos"])
def test_an_unknown_executor_is_refused(store, name):
    with pytest.raises(InputError, match="dask://HOST:PORT"):
        open_executor(name, 1, store, print)


def test_a_run_that_is_refused_its_executor_leaves_no_record_and_no_claim(store):
    with pytest.raises(InputError, match="is unknown"):
        run_flow(toy.flow, store, scene="toy", executor="thread")
    assert list(store.runs.iterdir()) == list((store.root / "claims").iterdir()) == []


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


def test_a_worker_finds_what_a_prompt_finds_in_its_folder(store, monkeypatch):
    monkeypatch.chdir(SUPPORT)
    monkeypatch.setattr(sys, "path", ["", *(place for place in sys.path if place not in ("", SUPPORT))])
    report = run_flow(toy.flow, store, scene="toy", executor="processes", jobs=1)
    assert report.failures == []


def test_threads_may_submit_to_dask_at_once(store, cluster):
    executor = Opened(at(cluster), store)
    results = []
    threads = [
        threading.Thread(target=lambda x=x: results.append(executor.run(call(store, toy.square, float(x)))))
        for x in range(8)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    executor.pool.close()
    assert sorted(value(store, action.outputs[0]) for action in results) == [float(x * x) for x in range(8)]
