"""Executors: who runs a call. One protocol, one contract test suite for all."""

from __future__ import annotations

import re
from collections.abc import Callable
from concurrent.futures import Future
from typing import Protocol

from ss_flow.cache.store import Action, Store
from ss_flow.errors import InputError
from ss_flow.execute import Invocation
from ss_flow.task import Resources

NAMES = ("mixed", "threads", "processes", "dask", "dask://HOST:PORT")

OnProgress = Callable[[str, int, int, str], None]
"""Called from any thread with the key of a call, how much is done, of how much, and a note."""


class Executor(Protocol):
    """Runs calls concurrently. Whoever submits holds back what there is no room for."""

    @property
    def capacity(self) -> Resources | None:
        """What calls may hold together; None = what this machine has."""
        ...

    def submit(self, invocation: Invocation) -> Future[Action]:
        """Start a call; the future holds its action record, or what the task raised."""
        ...

    def cancel(self) -> None:
        """Ask running calls to stop at their next sign of progress, without waiting for them."""
        ...

    def kill(self) -> None:
        """End running calls at once, where that is possible, without waiting for them."""
        ...

    def close(self) -> None:
        """Wait for what runs, and release processes and threads."""
        ...


def open_executor(
    name: str, workers: int, store: Store, on_progress: OnProgress, *, processes: int | None = None
) -> Executor:
    """The executor "threads", "processes", "mixed" (one call in a thread of this process, and those beside it in
    processes of their own), "dask" (a cluster on this machine) or "dask://HOST:PORT".

    workers: how many calls may run at once on this machine; another cluster's `capacity` says it for itself. processes:
    how many of them may have processes of their own in "mixed", where the others run in threads; None = all but one.

    Raises InputError for another name, or when Dask is not installed or does not answer.
    """
    apart = {"threads": 0, "processes": workers, "mixed": workers - 1}
    if name in apart:
        from ss_flow.executors.local import LocalPool

        most = apart[name] if processes is None or name != "mixed" else min(processes, apart[name])
        return LocalPool(workers, store, on_progress, processes=most)
    if found := re.fullmatch(r"dask(?:://(.+))?", name):
        from ss_flow.executors.dask import open_dask

        return open_dask(found[1] or "", workers, on_progress)
    raise InputError(f"executor {name!r} is unknown; choose one of: {', '.join(NAMES)}.")
