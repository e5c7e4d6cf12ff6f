"""The live display of a run."""

from __future__ import annotations

from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn
from rich.progress import TaskID as RowId

from ss_flow.events import Reporter

WORTH_SECONDS = 1.0
"""Shorter steps leave no line behind."""


class Terminal(Reporter):
    """A live display: how many nodes are done, and how far each running one is."""

    def __init__(self, console: Console) -> None:
        self._console = console
        self._display = Progress(
            SpinnerColumn(),
            TextColumn("{task.description}"),
            BarColumn(bar_width=24),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            TextColumn("[dim]{task.fields[note]}"),
            console=console,
            transient=True,
            disable=not console.is_terminal,
        )
        self._all = self._display.add_task("[bold]all steps", total=None, note="")
        self._rows: dict[str, RowId] = {}
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
        if kind in ("hit", "finished", "failed", "skipped"):
            self._done += 1
            self._display.update(self._all, completed=self._done, total=max(self._done, details.get("known", 0)))
        if kind == "finished" and details["seconds"] >= WORTH_SECONDS:
            self._console.print(f"[green]done[/]  {label:<34} {details['seconds']:8.1f} s", highlight=False)
        for warning in details.get("warnings", ()):
            self._console.print(f"[yellow]warning[/] {label}: {escape(warning)}", highlight=False, soft_wrap=True)
        if kind == "failed" and not details["bad_input"]:  # whoever asked for the run tells of bad input, once
            self._console.print(f"[red]failed[/] {label}: {escape(details['error'])}", highlight=False)
        elif kind in ("retried", "restarted"):
            self._console.print(f"[yellow]again[/]  {label}: {escape(details['because'])}", highlight=False)
        elif kind == "stopping" and details["running"]:
            words = f"waiting for what runs ({len(details['running'])}) to finish, or to keep what it has"
            self._console.print(f"[yellow]stopping[/] {words}; Ctrl-C again stops at once", highlight=False)

    def progressed(self, label: str, done: int, total: int, note: str) -> None:
        if (label := escape(label)) in self._rows:
            self._display.update(self._rows[label], completed=done, total=total, note=escape(note))

    def close(self) -> None:
        self._display.stop()
