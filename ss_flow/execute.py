"""Running one call of a task: load the inputs, run the function, store the outputs, record the action.

Only digests and parameters travel to whoever runs a call; inputs are read from the store and outputs written to it.
"""

from __future__ import annotations

import importlib
import threading
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import psutil

from ss_flow.cache.store import Action, Store
from ss_flow.keys import Components, Value
from ss_flow.running import Listener, Surroundings, remove_checkpoint, running
from ss_flow.task import Resources, Task

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
    store: Path


class Cancelled(Exception):
    """The run was interrupted; the task stopped at its next sign of progress."""


def execute(invocation: Invocation, store: Store, listener: Listener) -> Action:
    """Run a call in this thread. Whatever the task raises passes through; nothing is then stored under the key."""
    task = find_task(invocation.task)
    arguments = {
        name: store.get(value) if isinstance(value, str) else tuple(store.get(item) for item in value)
        for name, value in invocation.inputs.items()
    }
    checkpoint = store.root / "checkpoints" / f"{invocation.key}.npz"
    started = time.monotonic()
    surroundings = Surroundings(listener, max(1, invocation.resources.cores), checkpoint)
    with running(surroundings), _peak_memory() as peak_mb, warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", UserWarning)
        result = task.function(**arguments, **invocation.parameters)
    seconds = time.monotonic() - started
    items = result if task.returns_list else (result,)
    action = Action(
        key=invocation.key,
        step=task.name,
        outputs=tuple(store.put(item) for item in items),
        is_list=task.returns_list,
        components=invocation.components,
        seconds=round(seconds, 3),
        peak_rss_mb=round(peak_mb(), 1),
        warnings=tuple(dict.fromkeys(str(w.message) for w in caught if w.category is UserWarning)),
    )
    store.record(action)
    remove_checkpoint(checkpoint)
    return action


def find_task(reference: str) -> Task[..., Any]:
    """The task that "module:function" names."""
    module, _, name = reference.partition(":")
    found: Any = getattr(importlib.import_module(module), name)
    return found


@contextmanager
def _peak_memory() -> Iterator[Callable[[], float]]:
    """Sample this process's resident memory; the caller gets the peak in MB. Neighbours in the process count too."""
    process = psutil.Process()
    peak = process.memory_info().rss
    done = threading.Event()

    def sample() -> None:
        nonlocal peak
        while not done.wait(SAMPLE_SECONDS):
            peak = max(peak, process.memory_info().rss)

    sampler = threading.Thread(target=sample, name="peak-memory", daemon=True)
    sampler.start()
    try:
        yield lambda: max(peak, process.memory_info().rss) / 2**20
    finally:
        done.set()
