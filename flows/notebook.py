"""Runs and artifacts in a notebook: with pictures, statistics and history instead of bare arrays.

`%load_ext ss_flow.flows.notebook` gives every artifact an HTML form; it alone knows of IPython, and artifacts know
nothing of it. `FinishedRun.show` draws results with the photos and cameras of their run.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from typing import Any

from ss_flow.cache.store import Store
from ss_flow.flows.describe import as_html, provenance
from ss_flow.flows.results import FinishedRun
from ss_flow.flows.view.artifact import around_results, artifact_picture
from ss_flow.flows.view.drawing import Around
from ss_flow.tasks import artifacts
from ss_flow.tasks.words import size_in_words


def load_ipython_extension(shell: Any) -> None:
    """Let a notebook show artifacts (called by `%load_ext`). shell: IPython's InteractiveShell."""
    html = shell.display_formatter.formatters["text/html"]
    for kind in vars(artifacts).values():
        if dataclasses.is_dataclass(kind):
            html.for_type(kind, _alone)


def _alone(value: Any) -> str:
    """An artifact of which nothing is known but itself."""
    return as_html(value, artifact_picture(value, Around()))


@dataclass(frozen=True)
class Shown:
    """A result of a run that a notebook shows: a picture drawn with what the run knows, its fields and its history."""

    store: Store
    digests: tuple[str, ...]
    around: Around

    def __repr__(self) -> str:  # not what it is drawn with
        return f"Shown({len(self.digests)} of {self.store.location})"

    def _repr_html_(self) -> str:
        values = [self.store.get(digest) for digest in self.digests]
        first = as_html(values[0], self._repr_png_(), provenance(self.store, self.digests[0])) if values else ""
        return first + (f"<p>... and {len(values) - 1} more, all in the picture</p>" if len(values) > 1 else "")

    def _repr_png_(self) -> bytes:
        values = [self.store.get(digest) for digest in self.digests]
        return artifact_picture(values[0] if len(values) == 1 else values, self.around)


def shown(run: FinishedRun, name: str) -> Shown:
    """A result of a run for a notebook. Raises InputError when the run has no such result, or it is gone."""
    return Shown(run.store, tuple(run.digests(name)), around_results(run.results))


def run_html(run: FinishedRun) -> str:
    """A run as HTML: what it was made from, and its results by name."""

    def row(name: str, digests: Sequence[str]) -> str:
        held = [digest for digest in digests if digest in run.store]
        kind = type(run.store.get(held[0])).__name__ if held else "no longer in the store"
        size = size_in_words(sum(map(run.store.size, held)))
        cells = (name, kind, str(len(digests)), size)
        return "<tr>" + "".join(f"<td style='text-align:left'>{escape(cell)}</td>" for cell in cells) + "</tr>"

    rows = "".join(row(name, run.digests(name)) for name in run.results.digests)
    objects = len(run.instances["instances"])
    head = f"<strong>{escape(run.name)}</strong>: {objects} objects, status {escape(run.document['status'])}"
    return f"<div>{head}<table><tr><th>result</th><th>type</th><th>items</th><th>stored</th></tr>{rows}</table></div>"
