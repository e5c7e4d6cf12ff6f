"""Calls in threads of this process: native code releases the GIL. A task marked `isolate` gets a process of its own."""

from __future__ import annotations

import contextvars
import threading
from concurrent.futures import Future, ThreadPoolExecutor

from ss_flow.cache.store import Action, Store
from ss_flow.execute import Cancelled, Invocation, execute
from ss_flow.executors import OnProgress
from ss_flow.executors.worker import Worker


class Threads:
    """The default executor."""

    def __init__(self, workers: int, store: Store, on_progress: OnProgress) -> None:
        self._pool = ThreadPoolExecutor(workers, thread_name_prefix="task")
        self._store = store
        self._on_progress = on_progress
        self._cancelled = threading.Event()

    def submit(self, invocation: Invocation) -> Future[Action]:
        return self._pool.submit(contextvars.Context().run, self._run, invocation)

    def _run(self, invocation: Invocation) -> Action:
        def listener(done: int, total: int, note: str) -> None:
            if self._cancelled.is_set():
                raise Cancelled(invocation.label)
            self._on_progress(invocation.label, done, total, note)

        if not invocation.isolate:
            return execute(invocation, self._store, listener)
        worker = Worker(self._store.root)
        try:
            return worker.run(invocation, listener)
        finally:
            worker.stop()

    def cancel(self) -> None:
        self._cancelled.set()
        self._pool.shutdown(wait=False, cancel_futures=True)

    def close(self) -> None:
        self._pool.shutdown(wait=True)
