"""Sentences that several commands print."""

from __future__ import annotations

from rich.console import Console
from rich.table import Table

from ss_flow.engine import Report


def print_table(table: Table, out: Console) -> None:
    """Print a table, no word of it cut off; into a file or a pipe at its full width."""
    if not out.is_terminal:
        out.width = 1000
    for column in table.columns:
        column.overflow = "fold"
    out.print(table)


def would_run(report: Report) -> list[dict[str, str]]:
    """What a dry run says would be computed first: labels, and why."""
    return [{"label": n["label"], "why": n["why"]} for n in report.nodes if n["event"] == "would run"]


def hits_of(report: Report) -> int:
    """How many results were there."""
    return sum(node["event"] == "hit" for node in report.nodes)


def plan_in_words(report: Report) -> str:
    """What a dry run says in one line; of what follows from a result that is not there nothing is known."""
    first = would_run(report)
    there = f"{hits_of(report)} results are there"
    if not first:
        return f"{there}, all that is needed"
    return f"{there}, at least {len(first)} would be computed, first {first[0]['label']}: {first[0]['why']}"
