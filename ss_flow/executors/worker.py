"""A worker: a process of its own that runs calls one after the other, and says how far it is.

A fresh interpreter, never a fork: a fork after torch or OpenCV started their threads may hang. It ends by itself when
whoever started it is gone.
"""

from __future__ import annotations

import contextlib
import gc
import os
import pickle
import queue
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from typing import Any, cast

from ss_flow.cache.store import Action
from ss_flow.execute import Cancelled, Invocation, execute_here
from ss_flow.running import Listener

GRACE_SECONDS = 3.0
LOOK_SECONDS = 1.0
"""How often a process that says nothing is looked after."""
_CANCEL = None


class WorkerDied(RuntimeError):
    """The process of a worker ended in the middle of a call (a library aborted, or memory ran out)."""


class Worker:
    """One process. One call at a time; `cancel` and `kill` may come from any thread."""

    def __init__(self) -> None:
        self._connection, remote = Pipe()
        self._sending = threading.Lock()
        program = f"from ss_flow.executors.worker import serve; serve({remote.fileno()})"
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-c", program],
            env={**os.environ, "PYTHONPATH": os.pathsep.join(map(os.path.abspath, sys.path))},
            stdin=subprocess.DEVNULL,
            stdout=2,  # what a library prints must not get between a document on stdout
            pass_fds=[remote.fileno()],
            start_new_session=True,  # Ctrl-C reaches the whole group; the parent decides
        )
        remote.close()

    def run(self, invocation: Invocation, listener: Listener) -> Action:
        """Run a call there; what it raises is raised here. Raises WorkerDied when the process ends."""
        with self._reaching(invocation.label):
            self._send(invocation)
        while True:
            with self._reaching(invocation.label):
                kind, content = self._heard()
            if kind == "progress":
                listener(*content)
            elif kind == "raised":
                raise content
            else:
                return cast(Action, content)

    def cancel(self) -> None:
        """Make the call that runs stop at its next sign of progress."""
        with contextlib.suppress(OSError):
            self._send(_CANCEL)

    def kill(self) -> None:
        """End the process, whatever it does; a call that waits for it raises WorkerDied."""
        self._process.kill()

    def stop(self) -> None:
        """End the process, and release what it held: it leaves by itself, and is ended when it does not."""
        self._connection.close()
        try:
            self._process.wait(GRACE_SECONDS)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    @contextlib.contextmanager
    def _reaching(self, label: str) -> Iterator[None]:
        """Within this, a connection that is gone becomes WorkerDied."""
        try:
            yield
        except (EOFError, BrokenPipeError, ConnectionResetError):
            raise WorkerDied(f"the process of {label} {self._ending()}") from None

    def _heard(self) -> tuple[str, Any]:
        """The next message. Raises EOFError when the process has ended."""
        while not self._connection.poll(LOOK_SECONDS):
            # A child that the task forked holds the other end open, for as long as it lives.
            if self._process.poll() is not None and not self._connection.poll():
                raise EOFError
        return cast(tuple[str, Any], self._connection.recv())

    def _send(self, message: Any) -> None:
        with self._sending:
            self._connection.send(message)

    def _ending(self) -> str:
        try:
            code = self._process.wait(GRACE_SECONDS)
        except subprocess.TimeoutExpired:
            return "no longer answers"
        if code == -signal.SIGKILL:
            return "was killed, as happens when memory runs out"
        return f"was ended by {signal.Signals(-code).name}" if code < 0 else f"ended with exit code {code}"


def serve(descriptor: int) -> None:
    """What the process does: calls come in over the pipe, signs of progress and results go out."""
    gc.set_threshold(20_000)  # as in the process that started this one
    connection = Connection(descriptor)
    inbox: queue.SimpleQueue[Invocation] = queue.SimpleQueue()
    cancelled = threading.Event()

    def read() -> None:
        while True:
            try:
                message = connection.recv()
            except (EOFError, OSError):
                os._exit(0)  # nobody waits for what runs here
            if message is _CANCEL:
                cancelled.set()
            else:
                inbox.put(message)

    def listener(done: int, total: int, note: str) -> None:
        if cancelled.is_set():
            raise Cancelled
        connection.send(("progress", (done, total, note)))

    threading.Thread(target=read, name="inbox", daemon=True).start()
    while True:
        invocation = inbox.get()
        try:
            reply: tuple[str, Any] = ("finished", execute_here(invocation, listener))
        except BaseException as error:
            reply = ("raised", portable(error))
        connection.send(reply)


def portable(error: BaseException) -> Exception:
    """What a task raised, as an exception that arrives as it is.

    What would end whoever raises it again (SystemExit, say), what cannot be pickled, and what cannot be made again from
    that becomes its text.
    """
    if not isinstance(error, Exception):
        return RuntimeError(f"{type(error).__name__}: {error}")
    try:
        pickle.loads(pickle.dumps(error))
    except Exception as fault:
        return RuntimeError(f"{type(error).__name__}: {error} ({fault})")
    return error
