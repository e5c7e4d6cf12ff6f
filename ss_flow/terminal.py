"""What a person hears of a run: a live display on a terminal, plain lines elsewhere."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn
from rich.progress import TaskID as RowId

from ss_flow.events import Reporter

WORTH_SECONDS = 1.0
"""Shorter nodes leave no line behind on a terminal."""
ALIVE_SECONDS = 30.0
"""Elsewhere, how often a line says how far the running nodes are."""
_ENDED = ("hit", "finished", "failed", "skipped")


class Messages(Reporter):
    """Says what has to be known at once: warnings, failures, second tries, and that the run stops."""

    def __init__(self, console: Console) -> None:
        self._console = console
        self._warned: set[str] = set()

    def event(self, kind: str, **details: Any) -> None:
        label = details.get("label", "")
        for warning in details.get("warnings", ()):
            if warning not in self._warned:
                self.say("yellow", "warning", f"{label}: {warning}")
            self._warned.add(warning)
        if kind == "failed" and not details["bad_input"]:  # whoever asked for the run tells of bad input, once
            self.say("red", "failed", f"{label}: {details['error']}")
        elif kind in ("retried", "restarted"):
            self.say("yellow", "again", f"{f'{label}: ' if label else ''}{details['because']}")
        elif kind == "stopping" and details["running"]:
            words = f"waiting for what runs ({len(details['running'])}) to finish, or to keep what it has"
            self.say("yellow", "stopping", f"{words}; Ctrl-C again stops at once")

    def say(self, style: str, word: str, text: str) -> None:
        self._console.print(f"[{style}]{word:<6}[/] {escape(text)}", highlight=False, soft_wrap=True)


class Terminal(Messages):
    """A live display: how many nodes are done, and how far each running one is."""

    def __init__(self, console: Console) -> None:
        super().__init__(console)
        self._display = Progress(
            SpinnerColumn(),
            TextColumn("{task.description}"),
            BarColumn(bar_width=24),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            TextColumn("[dim]{task.fields[note]}"),
            console=console,
            transient=True,
        )
        self._all = self._display.add_task("[bold]all steps", total=None, note="")
        self._rows: dict[str, RowId] = {}
        self._known: dict[str, int] = {}
        self._done = 0
        self._display.start()

    def event(self, kind: str, **details: Any) -> None:
        label = escape(details.get("label", ""))
        if kind == "started":
            self._rows[label] = self._display.add_task(label, total=None, note="")
        elif kind in ("finished", "failed", "retried") and label in self._rows:
            self._display.remove_task(self._rows.pop(label))
        elif kind == "restarted":
            self._done = 0
        if kind in _ENDED:
            self._done += 1
            self._known[details.get("flow", "")] = details["known"]
            self._display.update(self._all, completed=self._done, total=max(self._done, sum(self._known.values())))
        if kind == "finished" and details["seconds"] >= WORTH_SECONDS:
            self.say("green", "done", f"{details['label']:<34} {details['seconds']:8.1f} s")
        super().event(kind, **details)

    def progressed(self, label: str, done: int, total: int, note: str) -> None:
        if (label := escape(label)) in self._rows:
            self._display.update(self._rows[label], completed=done, total=total, note=escape(note))

    def close(self) -> None:
        self._display.stop()


@dataclass
class _Step:
    """How far the nodes of a step are."""

    known: int = 0
    ended: int = 0
    there: int = 0
    """Those of them that have a result."""
    computed: int = 0
    told: int = 0
    """How many were computed when the step was last told of."""
    seconds: float = 0.0


class Log(Messages):
    """Plain lines, for a file or a pipe: one a step, when the last of its known nodes has ended, and now and then one
    for each node that runs for long.

    What was found in the store makes no line. every: seconds between two lines of a running node.
    """

    def __init__(self, console: Console, *, every: float = ALIVE_SECONDS) -> None:
        super().__init__(console)
        self._steps: dict[str, _Step] = {}
        self._begun: dict[str, float] = {}
        self._progress: dict[str, str] = {}
        self._lock = threading.Lock()
        self._closed = threading.Event()
        self._beat = threading.Thread(target=self._say_alive, args=(every,), name="alive", daemon=True)
        self._beat.start()

    def event(self, kind: str, **details: Any) -> None:
        label = details.get("label", "")
        with self._lock:
            if kind == "started":
                self._begun[label] = time.monotonic()
            elif kind in ("finished", "failed", "retried"):
                self._begun.pop(label, None)
                self._progress.pop(label, None)
            elif kind == "restarted":
                for step in self._steps.values():
                    step.ended = step.there = 0
            if kind in _ENDED:
                step = self._steps.setdefault(f"{details.get('flow', '')} {details['step']}".strip(), _Step())
                step.known = details["of"]
                step.ended += 1
                step.there += kind in ("hit", "finished")
                step.computed += kind == "finished"
                step.seconds += details["seconds"] if kind == "finished" else 0.0
        super().event(kind, **details)

    def progressed(self, label: str, done: int, total: int, note: str) -> None:
        with self._lock:
            if label in self._begun:
                self._progress[label] = f", {done} of {total}{f' ({note})' if note else ''}"

    def pause(self) -> None:
        self._say_done(lambda step: step.ended >= step.known)

    def close(self) -> None:
        """Also tells of steps that were interrupted."""
        self._closed.set()
        self._beat.join()
        self._say_done(lambda step: True)

    def _say_done(self, which: Callable[[_Step], bool]) -> None:
        for name, step in self._steps.items():
            if step.computed > step.told and which(step):
                step.told = step.computed
                self.say("green", "done", f"{name:<34} {step.there:5} of {step.known:<5} {step.seconds:8.1f} s")

    def _say_alive(self, every: float) -> None:
        while not self._closed.wait(every):
            with self._lock:
                now = time.monotonic()
                lines = [
                    f"{label}{self._progress.get(label, '')}, {now - begun:.0f} s so far"
                    for label, begun in self._begun.items()
                    if now - begun >= every
                ]
            with contextlib.suppress(BrokenPipeError):  # nobody reads any more: the main thread will find out
                for line in lines:
                    self.say("cyan", "runs", line)
