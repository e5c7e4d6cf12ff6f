"""Calls in worker processes: for tasks that hold the GIL, or whose libraries share state between threads."""

from __future__ import annotations

import queue
import threading
from concurrent.futures import Future, ThreadPoolExecutor

from ss_flow.cache.store import Action, Store
from ss_flow.execute import Cancelled, Invocation
from ss_flow.executors import OnProgress
from ss_flow.executors.worker import Worker


class Processes:
    """As many workers as calls run at once; each is started when first needed and then kept."""

    def __init__(self, workers: int, store: Store, on_progress: OnProgress) -> None:
        self._pool = ThreadPoolExecutor(workers, thread_name_prefix="worker")
        self._idle: queue.SimpleQueue[Worker] = queue.SimpleQueue()
        self._store = store
        self._on_progress = on_progress
        self._cancelled = threading.Event()

    def submit(self, invocation: Invocation) -> Future[Action]:
        return self._pool.submit(self._run, invocation)

    def _run(self, invocation: Invocation) -> Action:
        def listener(done: int, total: int, note: str) -> None:
            if self._cancelled.is_set():
                raise Cancelled(invocation.label)
            self._on_progress(invocation.label, done, total, note)

        try:
            worker = self._idle.get_nowait()
        except queue.Empty:
            worker = Worker(self._store.root)
        reusable = False
        try:
            action = worker.run(invocation, listener)
            reusable = not invocation.isolate
            return action
        finally:
            # After a fault the process may be damaged, or still at work on a cancelled call.
            if reusable:
                self._idle.put(worker)
            else:
                worker.stop()

    def cancel(self) -> None:
        self._cancelled.set()
        self._pool.shutdown(wait=False, cancel_futures=True)

    def close(self) -> None:
        self._pool.shutdown(wait=True)
        while not self._idle.empty():
            self._idle.get().stop()
