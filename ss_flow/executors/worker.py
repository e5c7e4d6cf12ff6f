"""A worker: a spawned process that runs calls one after the other, and says how far it is.

Spawned, never forked: a fork after torch or OpenCV started their threads may hang.
"""

from __future__ import annotations

import multiprocessing
import signal
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from ss_flow.cache.store import Action, Store
from ss_flow.execute import Invocation, execute
from ss_flow.running import Listener

GRACE_SECONDS = 3.0


class WorkerDied(RuntimeError):
    """The process of a worker ended in the middle of a call (a library aborted, or memory ran out)."""


class Worker:
    """One process. Not for use from several threads at once."""

    def __init__(self, store: Path) -> None:
        context = multiprocessing.get_context("spawn")
        self._connection, remote = context.Pipe()
        self._process = context.Process(target=_serve, args=(remote, store), daemon=True)
        self._process.start()
        remote.close()

    def run(self, invocation: Invocation, listener: Listener) -> Action:
        """Run a call there; what it raises is raised here. Raises WorkerDied when the process ends."""
        try:
            self._connection.send(invocation)
            while True:
                kind, content = self._connection.recv()
                if kind == "progress":
                    listener(*content)
                elif kind == "raised":
                    raise content
                else:
                    return content
        except (EOFError, BrokenPipeError, ConnectionResetError):
            self._process.join(GRACE_SECONDS)
            raise WorkerDied(f"the process of {invocation.label} {_ending(self._process.exitcode)}") from None

    def kill(self) -> None:
        """End the process, whatever it does; a call that waits for it raises WorkerDied. From any thread."""
        self._process.terminate()

    def stop(self) -> None:
        """End the process, and release what it held: it leaves by itself when idle, and is ended when it does not."""
        self._connection.close()
        self._process.join(GRACE_SECONDS)
        self._process.terminate()
        self._process.join(GRACE_SECONDS)


def _serve(connection: Connection, root: Path) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the whole group; the parent decides
    store = Store(root)

    def listener(done: int, total: int, note: str) -> None:
        connection.send(("progress", (done, total, note)))

    while True:
        try:
            invocation = connection.recv()
        except EOFError:
            return
        try:
            reply: tuple[str, Any] = ("finished", execute(invocation, store, listener))
        except Exception as error:
            reply = ("raised", error)
        try:
            connection.send(reply)
        except Exception as error:  # what cannot be pickled travels as its text
            connection.send(("raised", RuntimeError(f"{type(reply[1]).__name__}: {reply[1]} ({error})")))


def _ending(exit_code: int | None) -> str:
    if exit_code is not None and exit_code < 0:
        return f"was ended by {signal.Signals(-exit_code).name}"
    return f"ended with exit code {exit_code}"
