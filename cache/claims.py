"""Claims: who is computing a key now, so that no two processes compute it at once.

Notes
-----
*Concurrent claimants.* A claim is a file created exclusively: one of them wins, the others wait for the action record.

*Crash.* A holder touches its claims every few seconds. A claim that was not touched for `EXPIRY_SECONDS`, or whose
process on this host is gone, is stale and may be taken over. Two processes that take over the same stale claim at the
same moment may both compute: the results are equal, so nothing breaks, it only costs time.
"""

from __future__ import annotations

import json
import os
import socket
import threading
import time
from pathlib import Path

import psutil

HEARTBEAT_SECONDS = 5.0
EXPIRY_SECONDS = 60.0


class Claims:
    """The claims of one process on the keys of one store."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._held: set[str] = set()
        self._lock = threading.Lock()
        self._beating: threading.Thread | None = None
        self._stop = threading.Event()

    def take(self, key: str) -> bool:
        """Claim a key; False when another living process holds it."""
        path = self._folder / key
        for _ in range(2):
            try:
                with path.open("x") as stream:
                    json.dump({"host": socket.gethostname(), "pid": os.getpid()}, stream)
            except FileExistsError:
                if not _is_stale(path):
                    return False
                path.unlink(missing_ok=True)
            else:
                with self._lock:
                    self._held.add(key)
                self._beat()
                return True
        return False

    def release(self, key: str) -> None:
        """Give a claim back."""
        with self._lock:
            self._held.discard(key)
        (self._folder / key).unlink(missing_ok=True)

    def release_all(self) -> None:
        """Give every claim back, and stop the heartbeat."""
        self._stop.set()
        for key in list(self._held):
            self.release(key)

    def _beat(self) -> None:
        if self._beating is None:
            self._beating = threading.Thread(target=self._heartbeat, name="claims", daemon=True)
            self._beating.start()

    def _heartbeat(self) -> None:
        while not self._stop.wait(HEARTBEAT_SECONDS):
            with self._lock:
                held = list(self._held)
            for key in held:
                # A claim that someone took over as stale (this machine slept) must not be made ours again.
                if (self._folder / key).exists():
                    os.utime(self._folder / key)


def _is_stale(path: Path) -> bool:
    try:
        age = time.time() - path.stat().st_mtime
        holder = json.loads(path.read_text())
    except FileNotFoundError:
        return True
    except ValueError:
        # Created but not yet filled in, or its writer died in between: age alone tells.
        return age > HEARTBEAT_SECONDS
    if age > EXPIRY_SECONDS:
        return True
    return holder["host"] == socket.gethostname() and not psutil.pid_exists(holder["pid"])
