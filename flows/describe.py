"""What an artifact is, in words and as HTML: its fields, their statistics, what made it, and a picture."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from typing import Any

import numpy as np

from ss_flow.cache.store import Action, Store
from ss_flow.runs import Run, latest_runs
from ss_flow.tasks.deliver.statistics import statistics
from ss_flow.tasks.words import size_in_words

_LONGEST = 200
"""Characters of a plain value that are shown."""
_MOST_SHOWN = 8
"""Artifacts of a list that are described one by one."""


@dataclass(frozen=True)
class FieldFacts:
    """One field of an artifact."""

    name: str
    schema: str
    """Type and shape of an array, or the plain value."""
    bytes: int
    """Of an array in memory; 0 for plain values."""
    statistics: str
    """Of an array's values; "" where there are none."""

    def __str__(self) -> str:
        size = f" ({size_in_words(self.bytes)})" if self.bytes else ""
        return f"{self.schema}{size}{', ' if self.statistics else ''}{self.statistics}"


def facts(value: Any) -> list[FieldFacts]:
    """The fields of an artifact, in order."""
    found = []
    for item in dataclasses.fields(value):
        content = getattr(value, item.name)
        if isinstance(content, np.ndarray):
            schema = f"{content.dtype} {list(content.shape)}"
            found.append(FieldFacts(item.name, schema, content.nbytes, statistics(content)))
        else:
            text = str(content)
            shown = text if len(text) < _LONGEST else f"{text[: _LONGEST - 3]}..."
            found.append(FieldFacts(item.name, shown, 0, ""))
    return found


@dataclass(frozen=True)
class Provenance:
    """How a stored artifact came about."""

    node: Mapping[str, Any]
    """What the run says of it: "label", "key", "inputs" (by name, the step that made each), and so on."""
    action: Action | None
    """The store's record; None where it is no longer there."""

    def lines(self) -> list[str]:
        """In words, from what made it to what went in."""
        node, action = self.node, self.action
        told = [
            f"made by {node['label']} (key {node['key'][:12]}) in {node['seconds']:.1f} s, "
            f"{node['peak_rss_mb']:.0f} MB at most"
        ]
        if inputs := node.get("inputs"):
            told.append("from " + ", ".join(f"{name} ({step})" for name, step in inputs.items()))
        for word in ("parameters", "packages", "environment"):
            if action and (values := action.components.get(word)):
                told.append(f"{word}: " + ", ".join(f"{name}={value}" for name, value in values.items()))
        return told + [f"warning: {text}" for text in node.get("warnings", ())]


def maker(
    store: Store, object_digest: str, run: Run | None = None, asked: Sequence[Mapping[str, Any]] = ()
) -> tuple[Run, Mapping[str, Any]] | None:
    """The run that has an object, and its record of the step that gave it; None where none is known.

    run: the one to look into; otherwise the latest that has it. asked: records of that run that are looked at first: a
    step may give what it was given, and then several gave the same.
    """
    for one in latest_runs(store.runs) if run is None else (run,):
        for node in (*asked, *one.nodes()):
            if object_digest in node["outputs"]:
                return one, node
    return None


def provenance(
    store: Store, object_digest: str, run: Run | None = None, asked: Sequence[Mapping[str, Any]] = ()
) -> Provenance | None:
    """What made an object, as `maker` finds it."""
    found = maker(store, object_digest, run, asked)
    return None if found is None else Provenance(found[1], store.action(found[1]["key"], whole=False))


def told(
    values: Sequence[Any],
    digests: Sequence[str],
    store: Store,
    run: Run | None = None,
    asked: Sequence[Mapping[str, Any]] = (),
) -> list[str]:
    """One artifact, or those of a list, in lines of plain text. run, asked: where to look for what made them."""
    lines = []
    shown = len(values) if len(values) <= _MOST_SHOWN else 1
    for value, object_digest in list(zip(values, digests, strict=True))[:shown]:
        lines.append(type(value).__name__)
        lines += [f"  {fact.name}: {fact}" for fact in facts(value)]
        lines.append(f"  stored as {object_digest[:12]} in {size_in_words(store.size(object_digest))}")
        if made := provenance(store, object_digest, run, asked):
            lines += [f"  {line}" for line in made.lines()]
    if shown < len(values):
        total = size_in_words(sum(map(store.size, digests)))
        lines.append(f"... and {len(values) - shown} more, {total} in all")
    return lines


def as_html(value: Any, picture: bytes | None = None, made: Provenance | None = None) -> str:
    """An artifact as a piece of HTML: a picture (the bytes of a PNG), its fields, and how it came about."""
    from ss_flow.tasks.deliver.compressed import data_uri

    rows = "".join(
        f"<tr><th style='text-align:left;vertical-align:top'>{escape(fact.name)}</th>"
        f"<td style='text-align:left'>{escape(fact.schema)}</td>"
        f"<td style='text-align:left'>{escape(size_in_words(fact.bytes)) if fact.bytes else ''}</td>"
        f"<td style='text-align:left'>{escape(fact.statistics)}</td></tr>"
        for fact in facts(value)
    )
    image = f"<p><img src='{data_uri(picture)}' style='max-width:640px'></p>" if picture else ""
    history = "".join(f"<div>{escape(line)}</div>" for line in made.lines()) if made else ""
    kind = escape(type(value).__name__)
    return f"<div><strong>{kind}</strong>{image}<table>{rows}</table><small>{history}</small></div>"
