"""Calls on this machine: in threads of this process (native code releases the GIL), or in processes of their own."""

from __future__ import annotations

import contextvars
import functools
import threading
import time
from concurrent.futures import Future, ThreadPoolExecutor

from ss_flow.cache.store import Action, Store
from ss_flow.execute import Cancelled, Invocation, execute
from ss_flow.executors import OnProgress
from ss_flow.executors.worker import Worker
from ss_flow.task import Resources

START_SECONDS = 1.0
"""About what a process takes to start and to load what a task needs."""
LOOK_SECONDS = 0.01
"""How often a call that waits for room looks whether it should have a process."""
IDLE_SECONDS = 20.0
"""After so long without a call a process is ended: it holds what its tasks have loaded, a network of a gigabyte say."""


class LocalPool:
    """Executors of this machine: as many calls at once as there are workers.

    processes: how many of them may have processes of their own, which are kept for the next call; the others run in
    threads of this process. Where there are both, one call runs here, those beside it apart, and only what these have
    no room for beside the first. No process is started before calls have waited for room here as long as its start
    takes: short runs need none. A task marked `isolate` always gets a process to itself.
    """

    capacity: Resources | None = None

    def __init__(self, workers: int, store: Store, on_progress: OnProgress, *, processes: int) -> None:
        self._pool = ThreadPoolExecutor(workers, thread_name_prefix="task")
        self._store = store
        self._on_progress = on_progress
        self._threads, self._processes = workers - processes, processes
        self._here = self._apart = 0
        """Calls that run in threads, and in processes, but for those of isolated tasks."""
        self._waited = 0.0
        """Seconds of calls, together, since a process was last given instead."""
        self._lock = threading.Lock()
        self._ended = threading.Condition(self._lock)
        self._idle: list[tuple[Worker, float]] = []
        """Processes without a call, and since when: those that had one last at the end."""
        self._busy: set[Worker] = set()
        self._cancelled = False

    def submit(self, invocation: Invocation) -> Future[Action]:
        self._end_idle()
        return self._pool.submit(contextvars.Context().run, self._run, invocation)

    def _run(self, invocation: Invocation) -> Action:
        if invocation.isolate:
            return self._run_in_process(invocation)
        here = self._finds_room_here()
        try:
            return self._run_here(invocation) if here else self._run_in_process(invocation)
        finally:
            with self._ended:
                self._here -= here
                self._apart -= not here
                self._ended.notify()

    def _finds_room_here(self) -> bool:
        """Whether a call got room in this process; else it got that of a process of its own."""
        since = time.monotonic()
        with self._ended:
            while True:
                apart = self._apart < self._processes
                if self._here < self._threads and not (self._here and apart):
                    self._here += 1
                    return True
                now = time.monotonic()
                self._waited += now - since
                since = now
                if apart and (self._idle or self._waited > START_SECONDS or not self._threads):
                    self._waited = 0.0
                    self._apart += 1
                    return False
                self._ended.wait(LOOK_SECONDS)

    def _run_here(self, invocation: Invocation) -> Action:
        def listener(done: int, total: int, note: str) -> None:
            if self._cancelled:
                raise Cancelled(invocation.label)
            self._progressed(invocation.key, done, total, note)

        if self._cancelled:
            raise Cancelled(invocation.label)
        return execute(invocation, self._store, listener)

    def _run_in_process(self, invocation: Invocation) -> Action:
        worker = self._take_worker(invocation)
        whole = False
        try:
            action = worker.run(invocation, functools.partial(self._progressed, invocation.key))
            whole = True
            return action
        finally:
            with self._lock:
                self._busy.discard(worker)
                # After a fault the process may be damaged.
                keep = whole and not invocation.isolate and not self._cancelled
                if keep:
                    self._idle.append((worker, time.monotonic()))
            if not keep:
                worker.stop()

    def _take_worker(self, invocation: Invocation) -> Worker:
        with self._lock:
            if self._cancelled:
                raise Cancelled(invocation.label)
            worker = self._idle.pop()[0] if self._idle and not invocation.isolate else Worker()
            self._busy.add(worker)
        return worker

    def _progressed(self, key: str, done: int, total: int, note: str) -> None:
        self._end_idle()
        self._on_progress(key, done, total, note)

    def _end_idle(self) -> None:
        with self._lock:
            kept = time.monotonic() - IDLE_SECONDS
            ended = [worker for worker, since in self._idle if since < kept]
            self._idle = self._idle[len(ended) :]
        for worker in ended:
            worker.stop()

    def cancel(self) -> None:
        with self._lock:
            self._cancelled = True
            busy = list(self._busy)
        for worker in busy:
            worker.cancel()

    def kill(self) -> None:
        self.cancel()
        with self._lock:
            workers = [*self._busy, *(worker for worker, _ in self._idle)]
        for worker in workers:
            worker.kill()
        self._pool.shutdown(wait=False, cancel_futures=True)

    def close(self) -> None:
        self._pool.shutdown(wait=True)
        for worker, _ in self._idle:
            worker.stop()
