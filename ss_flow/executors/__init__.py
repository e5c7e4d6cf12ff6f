"""Executors: who runs a call. One protocol, one contract test suite for all."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future
from typing import Protocol

from ss_flow.cache.store import Action, Store
from ss_flow.errors import InputError
from ss_flow.execute import Invocation

NAMES = ("threads", "processes")

OnProgress = Callable[[str, int, int, str], None]
"""Called with a node's label, how much is done, of how much, and a note."""


class Executor(Protocol):
    """Runs calls concurrently. Whoever submits holds back what the machine has no room for."""

    def submit(self, invocation: Invocation) -> Future[Action]:
        """Start a call; the future holds its action record, or what the task raised."""
        ...

    def cancel(self) -> None:
        """Make running calls stop as soon as they can, without waiting for them."""
        ...

    def close(self) -> None:
        """Wait for what runs, and release processes and threads."""
        ...


def open_executor(name: str, workers: int, store: Store, on_progress: OnProgress) -> Executor:
    """The executor "threads" or "processes". Raises InputError for another name."""
    from ss_flow.executors.local import LocalPool

    if name not in NAMES:
        raise InputError(f"executor {name!r} is unknown; choose one of: {', '.join(NAMES)}.")
    return LocalPool(workers, store, on_progress, processes=name == "processes")
