"""What a person hears of a run: a live display on a terminal, plain lines elsewhere."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from datetime import timedelta
from typing import Any

from rich.console import Console, Group
from rich.live import Live
from rich.markup import escape
from rich.progress_bar import ProgressBar
from rich.table import Table

from ss_flow.events import Reporter

WORTH_SECONDS = 1.0
"""Steps that took less in all leave no line behind on a terminal."""
ALIVE_SECONDS = 30.0
"""Elsewhere, how often a line says how far the running nodes are."""
_MOST_ROWS = 8
"""Steps that the live display shows at once."""
_ENDED = ("hit", "finished", "failed", "skipped")


class Messages(Reporter):
    """Says what has to be known at once: warnings, failures, second tries, that the run stops, and that it waits for
    another process, once a step."""

    def __init__(self, console: Console) -> None:
        self._console = console
        self._warned: set[str] = set()
        self._waited: set[str] = set()

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
        elif kind == "waiting":
            if details["step"] not in self._waited:
                self.say("cyan", "waits", f"{label}: {details['because']}")
            self._waited.add(details["step"])
        elif kind == "stopping" and details["running"]:
            words = f"waiting for what runs ({len(details['running'])}) to finish, or to keep what it has"
            self.say("yellow", "stopping", f"{words}; Ctrl-C again stops at once")

    def say(self, style: str, word: str, text: str) -> None:
        self._console.print(f"[{style}]{word:<6}[/] {escape(text)}", highlight=False, soft_wrap=True)


@dataclass
class _Node:
    """A node that runs."""

    begun: float
    done: int = 0
    total: int = 0
    """What it said last of how far it is; 0 of 0 = nothing."""
    note: str = ""

    def seconds(self, now: float) -> float | None:
        """How long it is going to take in all, by what it said; None where it said nothing."""
        return (now - self.begun) * self.total / self.done if self.done > 0 else None


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
    begun: float | None = None
    """When the first of its nodes was."""
    running: dict[str, _Node] = field(default_factory=dict)
    """By label."""

    def work_left(self, now: float) -> float | None:
        """Seconds that its nodes still take, one after another; None where nothing tells."""
        waiting = self.known - self.ended - len(self.running)
        said = [node.seconds(now) for node in self.running.values()]
        known = [seconds for seconds in said if seconds is not None]
        if self.computed:
            usual = self.seconds / self.computed
        elif known:
            usual = sum(known) / len(known)
        else:
            return None if waiting or self.running else 0.0
        begun = [node.begun for node in self.running.values()]
        ends = zip((usual if seconds is None else seconds for seconds in said), begun, strict=True)
        return max(waiting, 0) * usual + sum(max(seconds - (now - since), 0.0) for seconds, since in ends)


class _Steps(Messages):
    """Counts the nodes of each step, and leaves a line when the last known one of a step has ended.

    worth: seconds that a step must have taken to leave one. What was found in the store makes no line.
    """

    def __init__(self, console: Console, *, worth: float) -> None:
        super().__init__(console)
        self._worth = worth
        self._steps: dict[str, _Step] = {}
        self._step_of: dict[str, _Step] = {}
        self._has_news = False
        """Whether anything was heard since the last pause: each of thousands of flows calls for one."""
        self._lock = threading.RLock()

    def event(self, kind: str, **details: Any) -> None:
        with self._lock:
            self._count(kind, details)
            self._has_news = True
        super().event(kind, **details)

    def _count(self, kind: str, details: dict[str, Any]) -> None:
        label = details.get("label", "")
        if "step" in details:
            step = self._steps.setdefault(f"{details.get('flow', '')} {details['step']}".strip(), _Step())
            step.known = details["of"]
            if kind == "started":
                step.running[label] = _Node(time.monotonic())
                step.begun = step.begun or step.running[label].begun
                self._step_of[label] = step
            elif kind in ("finished", "failed", "retried"):
                step.running.pop(label, None)
            if kind in _ENDED:
                step.ended += 1
                step.there += kind in ("hit", "finished")
                step.computed += kind == "finished"
                step.seconds += details["seconds"] if kind == "finished" else 0.0
        elif kind == "restarted":
            for step in self._steps.values():
                step.ended = step.there = 0

    def progressed(self, label: str, done: int, total: int, note: str) -> None:
        with self._lock:
            if label in self._step_of and (node := self._step_of[label].running.get(label)):
                node.done, node.total, node.note = done, total, note

    def pause(self) -> None:
        if self._has_news:
            self._has_news = False
            self._say_done(lambda step: step.ended >= step.known)

    def close(self) -> None:
        """Also tells of steps that were interrupted."""
        self._say_done(lambda step: True)

    def _say_done(self, which: Callable[[_Step], bool]) -> None:
        for name, step in self._steps.items():
            if step.computed > step.told and step.seconds >= self._worth and which(step):
                step.told = step.computed
                self.say("green", "done", f"{name:<34} {step.there:5} of {step.known:<5} {step.seconds:8.1f} s")


class Terminal(_Steps):
    """A live display of few lines, however many nodes there are: all steps, and a line for each step that runs.

    Remaining times hold for the nodes that are known, at the pace of those that ended: results decide what else is to
    be done, so the whole takes at least what is shown.
    """

    def __init__(self, console: Console, *, every: float = 0.25) -> None:
        super().__init__(console, worth=WORTH_SECONDS)
        self._begun = time.monotonic()
        self._known: dict[str, int] = {}
        self._live = Live(get_renderable=self.picture, console=console, transient=True, refresh_per_second=1 / every)
        self._live.start()

    def _count(self, kind: str, details: dict[str, Any]) -> None:
        super()._count(kind, details)
        if "known" in details:
            self._known[details.get("flow", "")] = details["known"]

    def close(self) -> None:
        self._live.stop()
        super().close()

    def picture(self) -> Group:
        """What the display shows now."""
        with self._lock:
            now = time.monotonic()
            active = [(name, step) for name, step in self._steps.items() if step.running]
            # Side by side, as many as run now; those that are still to come may find more room or less.
            width = max(1, sum(len(step.running) for _, step in active))
            left = sum(step.work_left(now) or 0.0 for step in self._steps.values()) / width
            ended, known = (sum(step.ended for step in self._steps.values()), sum(self._known.values()))
            rows = Table.grid(padding=(0, 1), expand=True)
            rows.add_column(no_wrap=True, overflow="ellipsis", max_width=24)
            rows.add_column(width=10)
            for _ in range(2):
                rows.add_column(no_wrap=True, justify="right")
            rows.add_column(no_wrap=True, overflow="ellipsis", ratio=1)
            rows.add_row(
                "[bold]all steps",
                ProgressBar(max(known, ended, 1), ended),
                f"{ended} of {max(known, ended)}",
                _clock(now - self._begun),
                f"at least {_clock(left)} left" if left else "",
            )
            for name, step in active[:_MOST_ROWS]:
                rows.add_row(escape(name), *_row(step, now))
            more = len(active) - _MOST_ROWS
            return Group(rows, f"[dim]and {more} more steps[/]") if more > 0 else Group(rows)


def _row(step: _Step, now: float) -> Iterable[Any]:
    """Bar, count, remaining time and note of a step that runs."""
    nodes = list(step.running.items())
    part = sum(node.done / node.total for _, node in nodes if node.total > 0)
    work = step.work_left(now)
    left = "" if work is None else f"{_clock(work / len(nodes))} left"
    if step.known == 1:
        node = nodes[0][1]
        note, count = node.note, f"{node.done} of {node.total}" if node.total else ""
    else:
        items = [label.partition("[")[2].rstrip("]") or label for label, _ in nodes]
        note, count = ", ".join(items), f"{step.ended} of {step.known}"
    return ProgressBar(max(step.known, 1), step.ended + part), count, left, f"[dim]{escape(note)}[/]"


def _clock(seconds: float) -> str:
    """Hours, minutes and seconds: "0:05:10"."""
    return str(timedelta(seconds=round(seconds)))


class Lines(_Steps):
    """Plain lines, for a file or a pipe: one a step, and now and then one for what runs for long, steps of many nodes
    and single nodes.

    every: seconds between two lines of the same.
    """

    def __init__(self, console: Console, *, every: float = ALIVE_SECONDS) -> None:
        super().__init__(console, worth=0.0)
        self._closed = threading.Event()
        self._beat = threading.Thread(target=self._say_alive, args=(every,), name="alive", daemon=True)
        self._beat.start()

    def close(self) -> None:
        self._closed.set()
        self._beat.join()
        super().close()

    def _say_alive(self, every: float) -> None:
        while not self._closed.wait(every):
            with self._lock:
                now = time.monotonic()
                lines = []
                for name, step in self._steps.items():
                    began = {f"{label}{_so_far(node)}": node.begun for label, node in step.running.items()}
                    if step.known > 1 and step.running and step.begun:
                        began = {f"{name}, {step.ended} of {step.known}": step.begun} | began
                    lines += [f"{what}, {now - at:.0f} s so far" for what, at in began.items() if now - at >= every]
            with contextlib.suppress(BrokenPipeError):  # nobody reads any more: the main thread will find out
                for line in lines:
                    self.say("cyan", "runs", line)


def _so_far(node: _Node) -> str:
    """ ", 3 of 200 (level 2)", or nothing where the node said nothing."""
    return f", {node.done} of {node.total}{f' ({node.note})' if node.note else ''}" if node.total else ""
