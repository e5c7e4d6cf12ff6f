"""Claims: who is computing a key now, so that no two processes compute it at once.

Notes
-----
*Concurrent claimants.* A claim is a file created exclusively: one of them wins, the others wait for the action record.

*Crash.* A holder touches its claims every few seconds. A claim is stale, and may be taken over, when its process on
this machine is gone, or when it was not touched while we watched it for `EXPIRY_SECONDS`. Only our own monotonic clock
counts, so hosts whose clocks differ do not matter. At worst, when a holder only seemed dead, two compute the same key:
the results are equal, so nothing breaks, it only costs time.
"""

from __future__ import annotations

import contextlib
import functools
import json
import math
import os
import socket
import threading
import time
import uuid
from pathlib import Path

import psutil

from ss_flow.cache.errors import writing

HEARTBEAT_SECONDS = 5.0
EXPIRY_SECONDS = 60.0


class Claims:
    """The claims of one process on the keys of one store."""

    def __init__(self, root: Path) -> None:
        self._root, self._folder = root, str(root / "claims")
        self._token = json.dumps({**_this_process(), "token": uuid.uuid4().hex}).encode()
        self._held: set[str] = set()
        self._watched: dict[str, tuple[object, float]] = {}
        self._lock = threading.Lock()
        self._beating: threading.Thread | None = None
        self._stop = threading.Event()

    def take(self, key: str) -> bool:
        """Claim a key; False when another living process holds it. Raises StoreFailure."""
        with writing(self._root):
            return self._take(key)

    def _take(self, key: str) -> bool:
        path = f"{self._folder}/{key}"
        for _ in range(2):
            try:
                handle = os.open(path, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666)
            except FileExistsError:
                if not self._remove_stale(key):
                    return False
            else:
                try:
                    os.write(handle, self._token)
                finally:
                    os.close(handle)
                with self._lock:
                    self._held.add(key)
                self._beat()
                return True
        return False

    def release(self, key: str) -> None:
        """Give a claim back."""
        with self._lock:
            self._held.discard(key)
        if self._is_ours(key):
            with contextlib.suppress(FileNotFoundError):
                os.unlink(f"{self._folder}/{key}")

    def release_all(self) -> None:
        """Give every claim back, and stop the heartbeat."""
        self._stop.set()
        for key in list(self._held):
            with contextlib.suppress(OSError):
                self.release(key)

    def living(self) -> set[str]:
        """The keys that are claimed by processes that may be alive."""
        return {name for name in self._names() if not self._is_stale(name, self._content(name))}

    def distrust(self, untouched_since: float) -> None:
        """Take claims for stale that were not touched since then, by the clock that stamps the store's files.

        For who cannot wait `EXPIRY_SECONDS` to see what another host's claims do.
        """
        for name in self._names():
            with contextlib.suppress(FileNotFoundError):
                status = os.stat(f"{self._folder}/{name}")
                if status.st_mtime < untouched_since:
                    self._watched[name] = ((self._content(name), status.st_mtime_ns), -math.inf)

    def sweep(self, *, dry: bool = False) -> int:
        """Remove stale claims; return how many there are."""
        stale = [name for name in self._names() if self._is_stale(name, self._content(name))]
        return len(stale) if dry else sum(map(self._remove_stale, stale))

    def _names(self) -> list[str]:
        return [name for name in os.listdir(self._folder) if not name.startswith(".")]

    def _content(self, key: str) -> bytes | None:
        try:
            with open(f"{self._folder}/{key}", "rb") as stream:
                return stream.read(4096)
        except FileNotFoundError:
            return None

    def _is_ours(self, key: str) -> bool:
        return self._content(key) == self._token

    def _remove_stale(self, key: str) -> bool:
        """Whether a claim in the way is gone now."""
        content = self._content(key)
        if content is None:
            return True  # it was released just now
        if not self._is_stale(key, content):
            return False
        self._watched.pop(key, None)
        path, aside = f"{self._folder}/{key}", f"{self._folder}/.{uuid.uuid4().hex}"
        try:
            os.rename(path, aside)  # of several who find it stale, one moves it
        except FileNotFoundError:
            return True
        with open(aside, "rb") as stream:
            fresh = stream.read(4096) != content
        if fresh:  # another one took it over in between: put it back
            with contextlib.suppress(FileExistsError):
                os.link(aside, path)
        os.unlink(aside)
        return not fresh

    def _is_stale(self, key: str, content: bytes | None) -> bool:
        try:
            stamp = (content, os.stat(f"{self._folder}/{key}").st_mtime_ns)
            holder = json.loads(content or b"")
            if holder["host"] == _this_process()["host"] and not _lives(holder["pid"], holder["started"]):
                return True
        except FileNotFoundError:
            return False  # released, or taken over, just now
        except (ValueError, KeyError, TypeError):
            pass  # created but not yet filled in, or its writer died in between: time tells
        now = time.monotonic()
        before, since = self._watched.setdefault(key, (stamp, now))
        if before != stamp:
            self._watched[key] = (stamp, now)
            return False
        return now - since > EXPIRY_SECONDS

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
                with contextlib.suppress(OSError):
                    if self._is_ours(key):
                        os.utime(f"{self._folder}/{key}")


@functools.cache
def _this_process() -> dict[str, object]:
    """Which process this is, on which machine: containers may share a host's name, but not its process numbers."""
    parts = [socket.gethostname()]
    with contextlib.suppress(OSError):
        parts.append(Path("/proc/sys/kernel/random/boot_id").read_text().strip())
        parts.append(os.readlink("/proc/self/ns/pid"))
    return {"host": " ".join(parts), "pid": os.getpid(), "started": psutil.Process().create_time()}


def _lives(pid: int, started: float) -> bool:
    try:
        return abs(psutil.Process(pid).create_time() - started) < 1
    except psutil.NoSuchProcess:
        return False
    except psutil.Error:
        return True
