"""Executors: who runs a call. One protocol, one contract test suite for all."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future
from typing import Protocol

from ss_flow.cache.store import Action, Store
from ss_flow.execute import Invocation

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
    """The executor of that name. Raises InputError for an unknown one."""
    from ss_flow.errors import InputError
    from ss_flow.executors.processes import Processes
    from ss_flow.executors.threads import Threads

    kinds: dict[str, Callable[[int, Store, OnProgress], Executor]] = {"threads": Threads, "processes": Processes}
    if name not in kinds:
        raise InputError(f"executor {name!r} is unknown; choose one of: {', '.join(kinds)}.")
    return kinds[name](workers, store, on_progress)
