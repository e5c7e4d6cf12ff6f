"""What the runs of one of the paper's tables came to: its sections, and how they are printed."""

from __future__ import annotations

import statistics
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from ss_flow.flows import paper
from ss_flow.flows.cli.telling import print_table
from ss_flow.flows.reproduce import Plan, Section, Variant
from ss_flow.resolution import Failure
from ss_flow.tasks.artifacts import Metrics
from ss_flow.tasks.evaluate.points import InstanceIoUs

MEAN = "mean"
_COLUMNS = {"miou": "mIoU", "macc25": "mAcc(25)", "macc50": "mAcc(50)", "share": "avg % lab. l", "iou": "IoU"}


@dataclass(frozen=True)
class Run:
    """One run that a table needs."""

    section: Section
    variant: Variant
    scene: Path
    seed: int


@dataclass(frozen=True)
class Found:
    """What a run came to."""

    run: Run
    value: Metrics | InstanceIoUs | Failure
    keys: frozenset[str]
    """Of all its results."""


def failures(found: Iterable[Found]) -> list[str]:
    return [
        f"not measured: {one.run.variant.row or one.run.scene.name}: {one.value.error}"
        for one in found
        if isinstance(one.value, Failure)
    ]


Figures = dict[tuple[str, int], dict[str, float]]
"""Figures by column, of each row and repetition."""


def section_of(section: Section, plan: Plan, printed: paper.Table, found: Iterable[Found]) -> dict[str, Any]:
    """One section of the document: for each row the paper's figures, ours, their spread; None where there is none."""
    own = [one for one in found if one.run.section is section]
    figures = _figures(own, plan)
    known = printed.rows if section.of_paper else {}
    variants = [variant.row for variant in section.variants]
    named = [name for name in known if name != MEAN] or (variants if plan.rows == "variants" else [])
    rows = list(
        dict.fromkeys([*named, *(row for row, _ in figures if row != MEAN), *([MEAN] * (MEAN in printed.rows))])
    )
    fresh = _fresh(own, variants[0]) if plan.rows == "variants" else {}
    return {
        "title": section.title,
        "protocol": section.protocol,
        "columns": printed.columns,
        "rows": [
            {
                "row": row,
                "paper": dict(zip(printed.columns, known[row], strict=True)) if row in known else None,
                "ours": _over_seeds(figures, row, statistics.fmean),
                "spread": _over_seeds(figures, row, statistics.stdev),
                "recomputed": fresh.get(row),
            }
            for row in rows
        ],
    }


def _figures(found: Sequence[Found], plan: Plan) -> Figures:
    """In per cent. Of a row with several scenes the mean over them; rows that are scenes or instances have a mean."""
    columns: dict[tuple[str, int], list[dict[str, float]]] = defaultdict(list)
    for one in found:
        seed = one.run.seed
        match one.value:
            case Metrics(values):
                row = one.run.scene.name if plan.rows == "scenes" else one.run.variant.row
                columns[row, seed].append(values)
                if plan.rows == "scenes":
                    columns[MEAN, seed].append(values)
            case InstanceIoUs() as ious:
                alone = len({other.run.scene for other in found}) == 1
                for number, name, iou in zip(ious.instance.tolist(), ious.names, ious.iou.tolist(), strict=True):
                    row = f"{number} {name}" if alone else f"{one.run.scene.name}: {number} {name}"
                    columns[row, seed].append({"iou": iou})
                columns[MEAN, seed].append({"iou": float(ious.iou.mean())})
    return {
        at: {name: 100 * statistics.fmean(values[name] for values in several) for name in several[0]}
        for at, several in columns.items()
    }


def _over_seeds(figures: Figures, row: str, statistic: Callable[[Sequence[float]], float]) -> dict[str, float] | None:
    several = [values for (of_row, _), values in figures.items() if of_row == row]
    if len(several) < (2 if statistic is statistics.stdev else 1):
        return None
    return {name: round(statistic([values[name] for values in several]), 4) for name in several[0]}


def _fresh(found: Sequence[Found], baseline: str) -> dict[str, float]:
    """Of each row, the share of its results that the first row does not have."""
    first = {(one.run.scene, one.run.seed): one.keys for one in found if one.run.variant.row == baseline}
    shares: dict[str, list[float]] = defaultdict(list)
    for one in found:
        known = first.get((one.run.scene, one.run.seed))
        if known is not None and one.keys:
            shares[one.run.variant.row].append(len(one.keys - known) / len(one.keys))
    return {row: round(statistics.fmean(values), 4) for row, values in shares.items()}


def tell_table(document: Mapping[str, Any], out: Console) -> None:
    out.print(escape(f"{document['source']}: {document['title']}, in per cent"))
    for section in document["sections"]:
        names = [_COLUMNS[column] for column in section["columns"]]
        fresh = any(row["recomputed"] for row in section["rows"])
        printed = any(row["paper"] for row in section["rows"])
        heads = [f"{name}\n{whose}" for name in names for whose in (("paper", "ours") if printed else ("ours",))]
        table = Table(section["title"], *heads, *(["recomputed"] if fresh else []), box=None)
        for row in section["rows"]:
            cells = []
            for column in section["columns"]:
                cells += [_cell(row["paper"], None, column)] * printed
                cells.append(_cell(row["ours"], row["spread"], column))
            share = row["recomputed"]
            table.add_row(escape(row["row"]), *cells, *(["" if share is None else f"{share:.0%}"] if fresh else []))
        print_table(table, out)
    for text in document["differs"]:
        out.print(escape(f"differs: {text}"))
    for text in document["notes"]:
        out.print(escape(f"note: {text}"))


def _cell(values: Mapping[str, float] | None, spread: Mapping[str, float] | None, column: str) -> str:
    if values is None or column not in values:
        return ""
    return f"{values[column]:.2f}" + (f" ±{spread[column]:.2f}" if spread else "")
