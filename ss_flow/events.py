"""What happens while a flow runs: events, and who listens to them.

The scheduler speaks to one `Reporter`; the silent one at the root of the hierarchy makes listening optional.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

from ss_flow.cache.errors import writing
from ss_flow.cache.plain_json import as_json
from ss_flow.runs import ENDS


class Reporter:
    """Hears what the scheduler does; this one is silent."""

    def event(self, kind: str, **details: Any) -> None:
        """Something happened to a node (hit, started, finished, failed, retried, skipped, waiting, would run), or to
        the whole (run started, restarted, stopping, run ended); or a result of another run is used (taken).

        Of a node, `of` says how many nodes of its step are needed and `known` how many of its flow, as far as is known.
        """

    def progressed(self, label: str, done: int, total: int, note: str) -> None:
        """A running node is so far; called from any thread."""

    def pause(self) -> None:
        """Something was told since the last time, and nothing more happens for a while."""

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

    def pause(self) -> None:
        for reporter in self._reporters:
            reporter.pause()

    def close(self) -> None:
        for reporter in self._reporters:
            reporter.close()


class Record(Reporter):
    """Keeps what nodes came to, and appends every event to a file, one JSON document a line, complete or absent.

    Hits come in great numbers: they are written together, with whatever comes next or before a pause.
    path: the file; None for no file. store: the store that holds it; named when the disk is full.
    """

    def __init__(self, path: Path | None, store: Path) -> None:
        self.ended: list[dict[str, Any]] = []
        """The events that say what a node came to, with their times."""
        self._path, self._store = path, store
        self._held_back: list[dict[str, Any]] = []

    def event(self, kind: str, **details: Any) -> None:
        told = {"time": round(time.time(), 3), "event": kind, **details}
        if kind in ENDS:
            self.ended.append(told)
        if self._path is not None:
            self._held_back.append(told)
            if kind != "hit":
                self.pause()

    def pause(self) -> None:
        if self._path is not None and self._held_back:
            # Opened each time: a sweep has thousands of flows, and a process may hold a few hundred files open.
            with writing(self._store), self._path.open("ab") as stream:
                stream.write(b"\n".join([*map(as_json, self._held_back), b""]))
            self._held_back.clear()

    def close(self) -> None:
        self.pause()
