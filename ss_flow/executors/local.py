"""Calls on this machine: in threads of this process (native code releases the GIL), or in processes of their own."""

from __future__ import annotations

import contextvars
import threading
from concurrent.futures import Future, ThreadPoolExecutor

from ss_flow.cache.store import Action, Store
from ss_flow.execute import Cancelled, Invocation, execute
from ss_flow.executors import OnProgress
from ss_flow.executors.worker import Worker
from ss_flow.task import Resources


class LocalPool:
    """The executors "threads" and "processes": as many calls at once as there are workers.

    A task marked `isolate` always gets a process to itself. Other processes are kept for the next call.
    """

    capacity: Resources | None = None

    def __init__(self, workers: int, store: Store, on_progress: OnProgress, *, processes: bool) -> None:
        self._pool = ThreadPoolExecutor(workers, thread_name_prefix="task")
        self._store = store
        self._on_progress = on_progress
        self._processes = processes
        self._lock = threading.Lock()
        self._idle: list[Worker] = []
        self._busy: set[Worker] = set()
        self._cancelled = False

    def submit(self, invocation: Invocation) -> Future[Action]:
        return self._pool.submit(contextvars.Context().run, self._run, invocation)

    def _run(self, invocation: Invocation) -> Action:
        def listener(done: int, total: int, note: str) -> None:
            if self._cancelled:
                raise Cancelled(invocation.label)
            self._on_progress(invocation.key, done, total, note)

        if self._processes or invocation.isolate:
            return self._run_in_process(invocation)
        if self._cancelled:
            raise Cancelled(invocation.label)
        return execute(invocation, self._store, listener)

    def _run_in_process(self, invocation: Invocation) -> Action:
        def listener(done: int, total: int, note: str) -> None:
            self._on_progress(invocation.key, done, total, note)

        worker = self._take_worker(invocation)
        whole = False
        try:
            action = worker.run(invocation, listener)
            whole = True
            return action
        finally:
            with self._lock:
                self._busy.discard(worker)
                # After a fault the process may be damaged.
                keep = whole and not invocation.isolate and not self._cancelled
                if keep:
                    self._idle.append(worker)
            if not keep:
                worker.stop()

    def _take_worker(self, invocation: Invocation) -> Worker:
        with self._lock:
            if self._cancelled:
                raise Cancelled(invocation.label)
            worker = self._idle.pop() if self._idle and not invocation.isolate else Worker()
            self._busy.add(worker)
        return worker

    def cancel(self) -> None:
        with self._lock:
            self._cancelled = True
            busy = list(self._busy)
        for worker in busy:
            worker.cancel()

    def kill(self) -> None:
        self.cancel()
        with self._lock:
            workers = [*self._busy, *self._idle]
        for worker in workers:
            worker.kill()
        self._pool.shutdown(wait=False, cancel_futures=True)

    def close(self) -> None:
        self._pool.shutdown(wait=True)
        for worker in self._idle:
            worker.stop()
