"""A flow on a Dask cluster gives what it gives here, within what the workers declare, or is refused."""

from __future__ import annotations

import sys
import threading
from dataclasses import replace

import pytest
import ss_flow_toy as toy
from dask_clusters import at, dask_cluster
from executor_calls import PATIENCE, Opened, call, wait_for
from toy_runs import value

from ss_flow.cache.errors import StoreFailure
from ss_flow.cache.store import Store
from ss_flow.engine import run_flow
from ss_flow.errors import ExecutorLost, InputError
from ss_flow.execute import Cancelled
from ss_flow.executors import open_executor
from ss_flow.task import Resources


def test_a_flow_on_dask_gives_the_digests_of_threads(store, cluster, tmp_path):
    expected = run_flow(toy.flow, store, scene="toy").values
    for folder, name in (("own", "dask"), ("other", at(cluster))):
        report = run_flow(toy.flow, Store(tmp_path / folder), scene="toy", executor=name, jobs=2)
        assert report.values == expected
        assert {node["event"] for node in report.nodes} == {"finished"}


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
