"""Calls on a Dask cluster: one on this machine, or one that is there already.

Only digests and parameters travel, packed as bytes: the Dask scheduler unpacks what it is given, and need not know the
tasks. A worker opens the store where the call says it is, so all hosts must find it there.

Notes
-----
*A lost worker.* Dask runs its calls elsewhere; when it gives up, they raise WorkerDied. The cluster on this machine
gives up at once: our own scheduler then tries the call again, with nothing beside it.

*A lost scheduler.* Every call raises ExecutorLost. What the workers still finish is kept in the store.

*A lost client.* Dask drops the calls that wait; those that run go on to their end.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import pickle
import signal
import threading
import time
import uuid
from collections.abc import Iterator, Mapping
from concurrent.futures import CancelledError, Future, ThreadPoolExecutor, wait
from dataclasses import replace
from functools import partial
from typing import Any

from ss_flow.cache.location import is_url
from ss_flow.cache.store import Action
from ss_flow.errors import ExecutorLost, InputError
from ss_flow.execute import Cancelled, Invocation
from ss_flow.executors import OnProgress, dask_worker
from ss_flow.executors.worker import WorkerDied
from ss_flow.task import Resources

CONNECT_SECONDS = 10.0
LEAVE_SECONDS = 2.0
REFRESH_SECONDS = 5.0
"""How long what is known of the workers of a cluster holds good."""
RESOURCES = {"GPU": "gpus", "memory_mb": "memory_mb", "cores": "cores"}
"""What the resources of a Dask worker are called and what a task calls them, the scarcest first."""
UNBOUNDED = 1 << 40
_MUTE = logging.CRITICAL + 1


def open_dask(address: str, workers: int, on_progress: OnProgress) -> DaskCluster:
    """The cluster at an address "HOST:PORT", or for "" a new one here, of so many processes with a thread each.

    Raises InputError when Dask is not installed, nobody answers at the address, or nobody works there.
    """
    try:
        import distributed
    except ImportError:
        raise InputError(
            "--executor dask needs a package that is not installed; run: pip install 'ss-flow[dask]'"
        ) from None
    with contextlib.ExitStack() as stack:
        stack.enter_context(_silence())
        if address:
            client = stack.enter_context(_connected(address))
        else:
            cluster = distributed.LocalCluster(
                n_workers=workers,
                threads_per_worker=1,
                memory_limit=None,  # our scheduler counts memory; Dask would end a worker for its share of the machine
                silence_logs=_MUTE,
                preload=[dask_worker.__name__],
                scheduler_kwargs={"allowed_failures": 0, "dashboard": False, "dashboard_address": "127.0.0.1:0"},
            )
            stack.callback(cluster.close, LEAVE_SECONDS)
            client = stack.enter_context(distributed.Client(cluster, set_as_default=False))
        return DaskCluster(client, on_progress, stack.pop_all())


@contextlib.contextmanager
def _connected(address: str) -> Iterator[Any]:
    """A client of the cluster at an address."""
    import distributed

    async def version() -> str:
        arguments = distributed.Security().get_connection_args("client")
        async with asyncio.timeout(CONNECT_SECONDS), distributed.rpc(address, connection_args=arguments) as scheduler:
            return str((await scheduler.versions())["packages"]["distributed"])

    unheard = InputError(
        f"no Dask scheduler answers at {address!r}; --executor dask://HOST:PORT takes the address that "
        "`dask scheduler` prints."
    )
    try:
        # First, since a client waits for ever for whoever gives no sensible answer; in a thread, since this one may
        # have a loop that runs.
        there = ThreadPoolExecutor(1).submit(asyncio.run, version()).result()
    except Exception as error:
        raise unheard from error
    if there != (here := distributed.__version__):
        raise InputError(f"the Dask cluster at {address!r} has distributed {there}, not {here} as this host has.")
    try:
        connected = distributed.Client(address, timeout=CONNECT_SECONDS, set_as_default=False)
    except OSError as error:  # it has gone since
        raise unheard from error
    with connected as client:
        try:
            client.wait_for_workers(1, CONNECT_SECONDS)
        except TimeoutError:
            raise InputError(
                f"the Dask cluster at {address!r} has no workers; start one, as with: dask worker {address}"
            ) from None
        except OSError as error:
            raise unheard from error
        yield client


class DaskCluster:
    """The executor "dask". client: of the cluster. held: what to release in the end.

    Nothing is asked of the workers of a cluster on this machine: they share its cores and its memory, which our own
    scheduler counts.
    """

    def __init__(self, client: Any, on_progress: OnProgress, held: contextlib.ExitStack) -> None:
        self._client, self._on_progress, self._held = client, on_progress, held
        self._address: str = client.scheduler.address
        self._run = uuid.uuid4().hex
        self._lock = threading.Lock()
        self._calls: dict[Future[Action], Any] = {}
        self._cancelled = False
        self._stopping: threading.Thread | None = None
        self._known: tuple[float, list[dict[str, Any]]] = (-REFRESH_SECONDS, [])
        client.subscribe_topic(dask_worker.TOPIC, self._heard)

    @property
    def capacity(self) -> Resources | None:
        """What the workers have together; None for a cluster on this machine."""
        if self._client.cluster is not None:
            return None
        workers = self._workers()
        offers = [_offer(worker, _declared(workers)) for worker in workers]
        memory = int(sum(offer["memory_mb"] for offer in offers))
        return Resources(
            cores=int(sum(offer["cores"] for offer in offers)),
            memory_mb=memory or UNBOUNDED,
            gpus=sum(offer["GPU"] for offer in offers),
        )

    def submit(self, invocation: Invocation) -> Future[Action]:
        promise: Future[Action] = Future()
        try:
            remote = self._send(invocation, promise)
        except Exception as error:
            promise.set_exception(error if self._client.status == "running" else self._lost())
        else:
            remote.add_done_callback(partial(self._settle, promise, invocation.label))
        return promise

    def _send(self, invocation: Invocation, promise: Future[Action]) -> Any:
        """Start a call; returns what Dask promises of it."""
        asked: Mapping[str, float] = {}
        if self._client.cluster is None:
            asked, cores = fitted(invocation.resources, self._workers())
            invocation = replace(invocation, resources=replace(invocation.resources, cores=cores))
        if not is_url(invocation.store):
            invocation = replace(invocation, store=os.path.abspath(invocation.store))
        call = f"{invocation.task}-{uuid.uuid4().hex}"  # not the key: a call that failed may be tried again
        with self._lock:
            if self._cancelled:
                raise Cancelled(invocation.label)
            if self._client.status != "running":
                raise self._lost()
            remote = self._client.submit(
                dask_worker.run_call, pickle.dumps(invocation), self._run, call, key=call, resources=asked, pure=False
            )
            self._calls[promise] = remote
        return remote

    def _settle(self, promise: Future[Action], label: str, remote: Any) -> None:
        """Pass on what a call came to."""
        from distributed import KilledWorker

        error: Exception | None
        try:
            action, error = pickle.loads(remote.result())
        except KilledWorker:
            error = WorkerDied(f"the Dask worker of {label} died, as happens when memory runs out")
        except (CancelledError, OSError):
            error = Cancelled(label) if self._cancelled else self._lost()
        except Exception as fault:
            error = fault
        with self._lock:
            if self._calls.pop(promise, None) is None:
                return
        if error is None:
            promise.set_result(action)
        else:
            promise.set_exception(error)

    def _lost(self) -> ExecutorLost:
        return ExecutorLost(
            f"the Dask scheduler at {self._address} was lost. What was finished is kept: run again to go on."
        )

    def _heard(self, event: tuple[float, tuple[str, str, int, int, str]]) -> None:
        run, key, done, total, note = event[1]
        if run == self._run:
            self._on_progress(key, done, total, note)

    def _workers(self) -> list[dict[str, Any]]:
        """What Dask knows of the workers that are there now."""
        since, workers = self._known
        if time.monotonic() - since > REFRESH_SECONDS:
            workers = list(self._client.scheduler_info(n_workers=-1)["workers"].values())
            self._known = time.monotonic(), workers
        return workers

    def cancel(self) -> None:
        with self._lock:
            if self._cancelled:
                return
            self._cancelled = True
        self._stopping = threading.Thread(target=self._stop, name="cancel", daemon=True)
        self._stopping.start()

    def _stop(self) -> None:
        """Tell the calls that run to stop, and drop those that wait."""
        if self._client.status != "running":  # every call has failed already
            return
        started: set[str] = set()
        with contextlib.suppress(Exception):
            started.update(*self._client.run(dask_worker.stop_calls, self._run, on_error="ignore").values())
        with self._lock:
            waiting = [remote for remote in self._calls.values() if remote.key not in started]
        with contextlib.suppress(Exception):
            self._client.cancel(waiting)

    def kill(self) -> None:
        self.cancel()
        for nanny in self._client.cluster.workers.values() if self._client.cluster else ():
            nanny.close_gracefully()  # it starts no other process
            with contextlib.suppress(OSError, TypeError):
                os.kill(nanny.pid, signal.SIGKILL)
        if self._stopping is not None:
            self._stopping.join(LEAVE_SECONDS)
        with self._lock:
            calls, self._calls = self._calls, {}
        for promise in calls:
            promise.set_exception(Cancelled())
        with contextlib.suppress(Exception):
            self._client.cancel(list(calls.values()))
        self._leave()

    def close(self) -> None:
        with self._lock:
            calls = list(self._calls)
        wait(calls)
        self._leave()

    def _leave(self) -> None:
        with contextlib.suppress(Exception):
            self._held.close()


def fitted(wanted: Resources, workers: list[dict[str, Any]]) -> tuple[dict[str, float], int]:
    """What to ask of Dask for a task, and how many threads it may use: no more than some worker has.

    workers: as `Client.scheduler_info` describes them. What no worker declares is not asked for.
    """
    declared = _declared(workers)

    def share(worker: dict[str, Any]) -> dict[str, float]:
        offer = _offer(worker, declared)
        return {name: min(getattr(wanted, kind), offer[name]) for name, kind in RESOURCES.items()}

    best = max(map(share, workers), key=lambda found: tuple(found.values()), default={"cores": float(wanted.cores)})
    return {name: best[name] for name in declared if best[name]}, max(1, int(best["cores"]))


def _declared(workers: list[dict[str, Any]]) -> set[str]:
    return {name for worker in workers for name in worker["resources"]} & RESOURCES.keys()


def _offer(worker: dict[str, Any], declared: set[str]) -> dict[str, float]:
    """What a worker has: as it declares; of a resource that no worker declares, what Dask knows of it."""
    known = {"GPU": 0, "memory_mb": (worker["memory_limit"] or 0) >> 20, "cores": worker["nthreads"]}
    return {name: worker["resources"].get(name, 0) if name in declared else known[name] for name in RESOURCES}


@contextlib.contextmanager
def _silence() -> Iterator[None]:
    """Within this, Dask logs nothing: what goes wrong is told once, by us."""
    loggers = [logging.getLogger(name) for name in ("distributed", "distributed.client", "tornado.application")]
    levels = [logger.level for logger in loggers]
    for logger in loggers:
        logger.setLevel(_MUTE)
    try:
        yield
    finally:
        for logger, level in zip(loggers, levels, strict=True):
            logger.setLevel(level)
