"""What happens while a flow runs: events, and who listens to them.

The scheduler speaks to one `Reporter`; the silent one at the root of the hierarchy makes listening optional.
"""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import IO, Any

from ss_flow.cache.errors import writing


class Reporter:
    """Hears what the scheduler does; this one is silent."""

    def event(self, kind: str, **details: Any) -> None:
        """Something happened to a node (hit, started, finished, failed, retried, skipped, waiting, would run), or to
        the whole (run started, restarted, stopping, run ended)."""

    def progressed(self, label: str, done: int, total: int, note: str) -> None:
        """A running node is so far; called from any thread."""

    def close(self) -> None:
        """The run is over."""


class Reporters(Reporter):
    """Several reporters as one."""

    def __init__(self, *reporters: Reporter) -> None:
        self._reporters = reporters

    def event(self, kind: str, **details: Any) -> None:
        for reporter in self._reporters:
            reporter.event(kind, **details)

    def progressed(self, label: str, done: int, total: int, note: str) -> None:
        for reporter in self._reporters:
            reporter.progressed(label, done, total, note)

    def close(self) -> None:
        for reporter in self._reporters:
            reporter.close()


class JsonLines(Reporter):
    """Appends every event to a file, one JSON document a line; a line is complete or absent.

    Hits come in great numbers and tell nothing new: they are written together with whatever comes next, or at the end.
    store: the store that holds the file; named when the disk is full.
    """

    def __init__(self, path: Path, store: Path) -> None:
        self._store = store
        self._stream: IO[str] = path.open("a", encoding="utf-8", buffering=1 << 16)

    def event(self, kind: str, **details: Any) -> None:
        with writing(self._store):
            self._stream.write(json.dumps({"time": round(time.time(), 3), "event": kind, **details}) + "\n")
            if kind != "hit":
                self._stream.flush()

    def close(self) -> None:
        with writing(self._store):
            self._stream.close()
