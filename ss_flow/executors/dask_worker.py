"""What a Dask worker runs: one call after the other, as many at once as it has threads."""

from __future__ import annotations

import os
import pickle
import socket
import time
from pathlib import Path
from typing import Any

from ss_flow.cache.errors import StoreFailure
from ss_flow.cache.location import is_url
from ss_flow.cache.store import Action
from ss_flow.execute import Cancelled, Invocation, execute_here
from ss_flow.executors.worker import Worker, portable

PROGRESS_SECONDS = 0.25
TOPIC = "ss-flow"
"""The Dask topic of signs of progress. One for all runs: its scheduler keeps the latest of each topic for ever."""

_running: set[tuple[str, str]] = set()
"""The calls that this process runs, each after the run that it belongs to."""
_stopped: set[str] = set()
"""The runs that were cancelled."""


def run_call(packed: bytes, run: str, call: str) -> bytes:
    """Run a packed call. Returns its action, or what was raised, packed."""
    _running.add((run, call))
    try:
        return pickle.dumps((_execute(pickle.loads(packed), run), None))
    except BaseException as error:
        return pickle.dumps((None, portable(error)))
    finally:
        _running.discard((run, call))


def _execute(invocation: Invocation, run: str) -> Action:
    from distributed import get_worker

    worker = get_worker()
    process: Worker | None = None
    told = -PROGRESS_SECONDS

    def listener(done: int, total: int, note: str) -> None:
        nonlocal told
        if run in _stopped:
            if process is None:
                raise Cancelled(invocation.label)
            process.cancel()
        elif time.monotonic() - told >= PROGRESS_SECONDS:
            told = time.monotonic()
            worker.log_event(TOPIC, (run, invocation.key, done, total, note))

    if run in _stopped:
        raise Cancelled(invocation.label)
    _check_store(invocation.store)
    if not invocation.isolate:
        return execute_here(invocation, listener)
    process = Worker()
    try:
        return process.run(invocation, listener)
    finally:
        process.stop()


def _check_store(location: str) -> None:
    """Raises StoreFailure when this host does not have the store; it must not make an empty one in its place."""
    if not is_url(location) and not Path(location, "objects").is_dir():
        raise StoreFailure(
            f"the host {socket.gethostname()} does not have the store {location}: every worker of a Dask cluster must "
            "find it in the same place. Put it on a shared file system (--cache DIR), and run again."
        )


def stop_calls(run: str) -> list[str]:
    """Let no call of a run start here any more. Returns those that have started, which stop at their next progress."""
    _stopped.add(run)
    return [call for of, call in tuple(_running) if of == run]


def dask_setup(worker: Any) -> None:
    """Called by Dask in each worker process of a cluster on this machine, when it starts."""
    os.setsid()  # Ctrl-C reaches the whole group; the parent decides
    os.dup2(2, 1)  # what a library prints must not get between a document on stdout
