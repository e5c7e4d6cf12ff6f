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

    label: str
    """What the figures are of."""
    values: list[float]
    """Of the parameter, ascending."""
    figures: list[float]
    """One a value, as fractions 0..1."""


@functools.cache
def tables() -> dict[str, Table]:
    """All tables by name."""
    text = (resources.files("ss_flow.flows") / "paper.toml").read_text(encoding="utf-8")
    return {name: Table(**table) for name, table in tomllib.loads(text).items()}


@functools.cache
def curves() -> dict[tuple[str, str], Curve]:
    """What the paper prints over one parameter, by the parameter and the figure of ours that it may be laid beside."""
    return {
        (table.parameter, metric): Curve(
            f"paper, {table.data.partition(';')[0]}",
            [float(value) for value in table.rows],
            [row[table.columns.index(column)] / 100 for row in table.rows.values()],
        )
        for table in tables().values()
        for metric, column in table.curves.items()
    }
