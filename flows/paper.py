"""The tables of Split&Splat (Monchieri et al.), from paper.toml, to lay beside what we measure."""

from __future__ import annotations

import functools
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib import resources


@dataclass(frozen=True)
class Table:
    """One table as the paper prints it."""

    source: str
    title: str
    data: str
    """What it was measured on, and with what."""
    columns: list[str]
    """Names of the figures."""
    rows: Mapping[str, list[float]]
    """By row, a figure a column, in per cent."""
    parameter: str = ""
    """The parameter that the rows are values of, if they are."""
    curves: Mapping[str, str] = field(default_factory=dict)
    """Which column each figure of ours (flows/measures.py) may be laid beside in the picture of a sweep."""
    notes: list[str] = field(default_factory=list)
    """What is to be known of the printed figures."""


@dataclass(frozen=True)
class Curve:
    """A column of a table over its parameter."""

    parameter: str
    metric: str
    """The figure of ours that it is to be laid beside."""
    source: str
    label: str
    """What the figures are of."""
    percent: tuple[tuple[float, float], ...]
    """(value of the parameter, figure in per cent), by rising value."""

    def points(self) -> tuple[list[float], list[float]]:
        """Values of the parameter, and the figures as fractions 0..1."""
        return [x for x, _ in self.percent], [y / 100 for _, y in self.percent]


@functools.cache
def tables() -> dict[str, Table]:
    """All tables by name."""
    text = (resources.files("ss_flow.flows") / "paper.toml").read_text(encoding="utf-8")
    return {name: Table(**table) for name, table in tomllib.loads(text).items()}


@functools.cache
def curves() -> tuple[Curve, ...]:
    """What the paper prints over one parameter."""
    return tuple(
        Curve(
            table.parameter,
            metric,
            table.source,
            f"paper, {table.data.partition(';')[0]}",
            tuple((float(value), row[table.columns.index(column)]) for value, row in table.rows.items()),
        )
        for table in tables().values()
        for metric, column in table.curves.items()
    )


def curve(parameter: str, metric: str) -> Curve | None:
    """The paper's curve of a figure over a parameter, where it prints one."""
    return next((c for c in curves() if (c.parameter, c.metric) == (parameter, metric)), None)
