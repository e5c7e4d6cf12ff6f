"""Running one call of a task: load the inputs, run the function, store the outputs, record the action.

Only digests and parameters travel to whoever runs a call; inputs are read from the store and outputs written to it.
"""

from __future__ import annotations

import functools
import importlib
import os
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, overload

import psutil

from ss_flow.cache.location import open_store
from ss_flow.cache.store import MEMORY_BYTES, Action, Store
from ss_flow.control_groups import usable_cores
from ss_flow.errors import InputError
from ss_flow.keys import Components, Value
from ss_flow.own_copy import own_copy
from ss_flow.running import Listener, Surroundings, remove_checkpoint, running
from ss_flow.sameness import check_sameness
from ss_flow.task import FileRef, Resources, Task, files_in

SAMPLE_SECONDS = 0.2


@dataclass(frozen=True)
class Invocation:
    """One call of a task, ready to run anywhere."""

    key: str
    label: str
    task: str
    """Where the task is declared, "module:function"."""
    inputs: dict[str, Value]
    parameters: dict[str, Any]
    components: Components
    resources: Resources
    isolate: bool
    store: str
    """Where the store is, as `open_store` takes it."""
    alone: bool = False
    """Whether nothing may run beside it: it ran out of memory once."""


class Cancelled(Exception):
    """The run was interrupted; the task stopped at its next sign of progress."""


def execute(invocation: Invocation, store: Store, listener: Listener) -> Action:
    """Run a call in this thread. Whatever the task raises passes through; nothing is then stored under the key.

    Raises Gone when an input is no longer in the store, ExecutorLost when this process would compute, or has computed,
    something else than the key stands for; InputError when a file is not, or while the task ran was not, as its
    reference says.
    """
    task = find_task(invocation.task)
    check = functools.partial(check_sameness, task, invocation.components, invocation.label, store.closures)
    check()
    arguments = {name: _read(value, store, name in task.streamed) for name, value in invocation.inputs.items()}
    checkpoint = store.checkpoint(invocation.key)
    warned: list[str] = []
    cores = max(1, invocation.resources.cores)
    surroundings = Surroundings(listener, cores, checkpoint, warned, invocation.alone)
    # Whether a file was another one only in between, its stamp tells, and no later look at its content.
    stamps = {ref: ref.stamp_now() for ref in files_in(invocation.parameters)}
    _refuse([ref for ref in stamps if ref.has_changed()], invocation.label)
    started = time.monotonic()
    with running(surroundings), _peaks.watching() as peak:
        result = task.run(arguments, {name: own_copy(name, value) for name, value in invocation.parameters.items()})
    seconds = time.monotonic() - started
    check()  # a module that the task itself loaded may have been edited since its key was made
    _refuse([ref for ref, before in stamps.items() if ref.was_written(before)], invocation.label)
    if task.returns_list and not isinstance(result, tuple | list):  # of a generator, nothing has run yet
        raise TypeError(f"the task {task.name} declares a list and returned a {type(result).__name__}; return a tuple")
    items = result if task.returns_list else (result,)
    action = Action(
        key=invocation.key,
        step=task.name,
        outputs=tuple(store.put(item) for item in items),
        is_list=task.returns_list,
        components=invocation.components,
        seconds=round(seconds, 3),
        peak_rss_mb=round(peak.bytes / 2**20, 1),
        warnings=tuple(warned),
    )
    store.record(action)
    remove_checkpoint(checkpoint)
    return action


def _refuse(changed: Sequence[FileRef], label: str) -> None:
    if changed:
        raise InputError(f"{label} reads {changed[0].path}, which has changed since the run started; run again.")


def _read(value: Value, store: Store, streamed: bool) -> Any:
    if isinstance(value, str):
        return store.get(value)
    return Stream(store, value) if streamed else tuple(store.get(item) for item in value)


class Stream(Sequence[Any]):
    """Artifacts that are read from the store when they are looked at, and forgotten with the last reference to them.

    Reading raises Gone when the store no longer holds the item.
    """

    def __init__(self, store: Store, digests: Sequence[str]) -> None:
        self._store = store
        self._digests = digests

    def __len__(self) -> int:
        return len(self._digests)

    @overload
    def __getitem__(self, index: int) -> Any: ...
    @overload
    def __getitem__(self, index: slice) -> Stream: ...
    def __getitem__(self, index: int | slice) -> Any:
        if isinstance(index, slice):
            return Stream(self._store, self._digests[index])
        return self._store.get(self._digests[index])


def execute_here(invocation: Invocation, listener: Listener) -> Action:
    """The same in a process that has no store open yet."""
    return execute(invocation, _store_of_this_process(invocation.store), listener)


@functools.cache
def _store_of_this_process(location: str) -> Store:
    store = open_store(location)
    store.limit_memory(MEMORY_BYTES // usable_cores())  # a process a core
    return store


def reference_to(task: Task[..., Any]) -> str:
    """Where a task is declared, "module:function", as `find_task` takes it.

    Raises TypeError when it is not to be found there: another process could not run it.
    """
    reference = f"{task.function.__module__}:{task.function.__qualname__}"
    try:
        found: Any = find_task(reference)
    except (ImportError, AttributeError):
        found = None
    if not isinstance(found, Task) or found.name != task.name:
        raise TypeError(f"the task {task.name} must be declared at the top of its module, under its function's name")
    return reference


def find_task(reference: str) -> Task[..., Any]:
    """The task that "module:function" names."""
    module, _, name = reference.partition(":")
    found: Task[..., Any] = getattr(importlib.import_module(module), name)
    return found


@dataclass(eq=False)
class _Peak:
    bytes: int


class _Peaks:
    """Samples this process's resident memory while anyone wants to know; neighbours in the process count too."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._watched: set[_Peak] = set()
        self._sampler: threading.Thread | None = None

    @contextmanager
    def watching(self) -> Iterator[_Peak]:
        """The caller's peak, complete when the context ends."""
        peak = _Peak(_resident_bytes())
        with self._lock:
            self._watched.add(peak)
            if self._sampler is None:
                self._sampler = threading.Thread(target=self._sample, name="peak-memory", daemon=True)
                self._sampler.start()
        try:
            yield peak
        finally:
            with self._lock:
                self._watched.discard(peak)
            peak.bytes = max(peak.bytes, _resident_bytes())

    def _sample(self) -> None:
        while True:
            time.sleep(SAMPLE_SECONDS)
            with self._lock:
                now = _resident_bytes() if self._watched else 0
                for peak in self._watched:
                    peak.bytes = max(peak.bytes, now)


def _resident_bytes() -> int:
    return int(_process(os.getpid()).memory_info().rss)


@functools.cache
def _process(pid: int) -> psutil.Process:  # by its number, since a fork copies what is remembered
    return psutil.Process(pid)


_peaks = _Peaks()


def _after_fork() -> None:
    """A fork copies neither the thread that samples, nor whoever would release the lock."""
    global _peaks
    _peaks = _Peaks()


os.register_at_fork(after_in_child=_after_fork)
