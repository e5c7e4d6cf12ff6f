"""Claims: who is computing a key now, so that no two processes compute it at once.

Notes
-----
*Concurrent claimants.* A claim is created exclusively: one of them wins, the others wait for the action record.

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
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import psutil

from ss_flow.cache.errors import writing
from ss_flow.cache.plain_json import read_json

HEARTBEAT_SECONDS = 5.0
EXPIRY_SECONDS = 60.0
RELEASE_SECONDS = 2.0
"""For so long the end of a run waits for its claims to be given back."""


@dataclass(frozen=True)
class Seen:
    """A claim as it was at one moment."""

    content: bytes
    """Who holds it."""
    touched: float
    """When it was last touched, by the clock of where it lies."""
    version: Any
    """Changes with every touch."""


class Place(Protocol):
    """Where the claims of a store lie. Raises StoreFailure when it cannot be used."""

    poll_seconds: float
    """How often it may be asked for a key that another process holds."""

    def create(self, key: str, content: bytes) -> bool:
        """Make a claim; False when there is one."""
        ...

    def look(self, key: str) -> Seen | None:
        """A claim; None when there is none."""
        ...

    def touch(self, key: str, seen: Seen) -> None:
        """Show that the holder lives, unless the claim has changed hands."""
        ...

    def remove(self, key: str, seen: Seen) -> bool:
        """Remove a claim; False when it is no longer the one that was seen."""
        ...

    def claimed(self) -> list[str]:
        """What is claimed."""
        ...


class Claims:
    """The claims of one process on the keys of one store."""

    def __init__(self, place: Path | Place) -> None:
        """place: a store's folder, or where else its claims lie."""
        self._place: Place = Folder(place) if isinstance(place, Path) else place
        self._token = json.dumps({**_this_process(), "token": uuid.uuid4().hex}).encode()
        self._held: set[str] = set()
        self._watched: dict[str, tuple[Seen, float]] = {}
        self._refused: dict[str, float] = {}
        self._lock = threading.Lock()
        self._beating: threading.Thread | None = None
        self._stop = threading.Event()

    def take(self, key: str) -> bool:
        """Claim a key; False when another living process holds it. Raises StoreFailure."""
        if time.monotonic() - self._refused.get(key, -math.inf) < self._place.poll_seconds:
            return False
        for _ in range(2):
            if self._place.create(key, self._token):
                self._refused.pop(key, None)
                with self._lock:
                    self._held.add(key)
                self._beat()
                return True
            if not self._remove_stale(key):
                break
        self._refused[key] = time.monotonic()
        return False

    def release(self, key: str) -> None:
        """Give a claim back. Raises StoreFailure."""
        with self._lock:
            self._held.discard(key)
        for _ in range(3):  # the heartbeat may touch it once more between the look and the removal
            if (seen := self._ours(key)) is None or self._place.remove(key, seen):
                return

    def release_all(self) -> None:
        """Give every claim back, and stop the heartbeat. Of those that take long nobody waits for the end: without the
        heartbeat they run out."""
        self._stop.set()
        # In a thread of its own: while a server is asked that does not answer, no Ctrl-C ends the waiting.
        releasing = threading.Thread(target=self._release_held, name="releasing", daemon=True)
        releasing.start()
        releasing.join(RELEASE_SECONDS)

    def _release_held(self) -> None:
        for key in list(self._held):
            with contextlib.suppress(OSError):
                self.release(key)

    def living(self) -> set[str]:
        """The keys that are claimed by processes that may be alive."""
        return {key for key, seen in self._all() if not self._is_stale(key, seen)}

    def distrust(self, untouched_since: float) -> None:
        """Take claims for stale that were not touched since then, by the clock that stamps the store's files.

        For who cannot wait `EXPIRY_SECONDS` to see what another host's claims do.
        """
        for key, seen in self._all():
            if seen.touched < untouched_since:
                self._watched[key] = (seen, -math.inf)

    def sweep(self, *, dry: bool = False) -> int:
        """Remove stale claims; return how many there are."""
        stale = [key for key, seen in self._all() if self._is_stale(key, seen)]
        return len(stale) if dry else sum(map(self._remove_stale, stale))

    def _all(self) -> list[tuple[str, Seen]]:
        return [(key, seen) for key in self._place.claimed() if (seen := self._place.look(key)) is not None]

    def _ours(self, key: str) -> Seen | None:
        seen = self._place.look(key)
        return seen if seen is not None and seen.content == self._token else None

    def _remove_stale(self, key: str) -> bool:
        """Whether a claim in the way is gone now."""
        seen = self._place.look(key)
        if seen is None:
            return True  # it was released just now
        if not self._is_stale(key, seen):
            return False
        self._watched.pop(key, None)
        return self._place.remove(key, seen)

    def _is_stale(self, key: str, seen: Seen) -> bool:
        if seen.content == self._token and key not in self._held:
            return True  # the answer to making or removing it was lost
        try:
            holder = read_json(seen.content)
            if holder["host"] == _this_process()["host"] and not _lives(holder["pid"], holder["started"]):
                return True
        except (ValueError, KeyError, TypeError):
            pass  # created but not yet filled in, or its writer died in between: time tells
        now = time.monotonic()
        before, since = self._watched.setdefault(key, (seen, now))
        if before != seen:
            self._watched[key] = (seen, now)
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
                    if (seen := self._ours(key)) is not None:
                        self._place.touch(key, seen)


class Folder:
    """Claims as files of a store in a folder."""

    poll_seconds = 0.0

    def __init__(self, root: Path) -> None:
        self._root, self._folder = root, str(root / "claims")

    def create(self, key: str, content: bytes) -> bool:
        with writing(self._root):
            try:
                handle = os.open(f"{self._folder}/{key}", os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666)
            except FileExistsError:
                return False
            try:
                os.write(handle, content)
            except OSError:
                os.unlink(f"{self._folder}/{key}")  # an empty one would be in everyone's way until it expires
                raise
            finally:
                os.close(handle)
        return True

    def look(self, key: str) -> Seen | None:
        with writing(self._root):
            try:
                with open(f"{self._folder}/{key}", "rb") as stream:
                    status = os.fstat(stream.fileno())
                    return Seen(stream.read(4096), status.st_mtime, status.st_mtime_ns)
            except FileNotFoundError:
                return None

    def touch(self, key: str, seen: Seen) -> None:
        os.utime(f"{self._folder}/{key}")

    def remove(self, key: str, seen: Seen) -> bool:
        path, aside = f"{self._folder}/{key}", f"{self._folder}/.{uuid.uuid4().hex}"
        with writing(self._root):
            try:
                os.rename(path, aside)  # of several who find it stale, one moves it
            except FileNotFoundError:
                return True
            with open(aside, "rb") as stream:
                fresh = stream.read(4096) != seen.content
            if fresh:  # another one took it over in between: put it back
                with contextlib.suppress(FileExistsError):
                    os.link(aside, path)
            os.unlink(aside)
        return not fresh

    def claimed(self) -> list[str]:
        with writing(self._root):
            return [name for name in os.listdir(self._folder) if not name.startswith(".")]


def _this_process() -> dict[str, object]:
    """Which process this is, on which machine: containers may share a host's name, but not its process numbers."""
    return _process(os.getpid())


@functools.cache
def _process(pid: int) -> dict[str, object]:  # by its number, since a fork copies what is remembered
    parts = [socket.gethostname()]
    with contextlib.suppress(OSError):
        parts.append(Path("/proc/sys/kernel/random/boot_id").read_text().strip())
        parts.append(os.readlink("/proc/self/ns/pid"))
    return {"host": " ".join(parts), "pid": pid, "started": _started(pid)}


def _started(pid: int) -> float:
    """When a process of this machine started, in seconds; where the system says it, by a clock that nobody sets."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_bytes().rpartition(b")")[2].split()
        return int(fields[19]) / os.sysconf("SC_CLK_TCK")
    except (OSError, ValueError, IndexError):
        return float(psutil.Process(pid).create_time())


def _lives(pid: int, started: float) -> bool:
    try:
        return abs(_started(pid) - started) < 1
    except psutil.NoSuchProcess:
        return False
    except psutil.Error:
        return True
