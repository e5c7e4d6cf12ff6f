"""What a sweep came to, as a table, files and a picture."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from ss_flow.cache.files import write_atomically
from ss_flow.cache.plain_json import read_json
from ss_flow.flows.cli.telling import plan_in_words, print_table, would_run
from ss_flow.flows.measures import HEADLINE
from ss_flow.sweep import Row
from ss_flow.tasks.capture.names import named_after

Document = Mapping[str, Any]
"""A row of sweep.json."""


def in_short(value: Any) -> str:
    """A parameter's value as people would write it, with at most six digits."""
    match value:
        case None | True | False:
            return str(value).lower()
        case float():
            return f"{value:.6g}"
        case tuple():
            return ",".join(map(in_short, value))
    return str(value)


def metrics_of(rows: Sequence[Document]) -> list[str]:
    """The figures that any row has, in order."""
    return list(dict.fromkeys(name for row in rows for name in row["metrics"]))


def shown(rows: Sequence[Document]) -> list[str]:
    """The figures to show people: those that headlines are made of, unless none or only a few were asked for."""
    names = metrics_of(rows)
    return names if len(names) <= 4 else [name for name in HEADLINE if name in names] or names


def short_names(names: Sequence[str]) -> list[str]:
    """Each parameter's last part, where no other one ends alike."""
    last = [name.rpartition(".")[2] for name in names]
    return [short if last.count(short) == 1 else name for short, name in zip(last, names, strict=True)]


def scene_names(rows: Sequence[Document]) -> dict[str, str]:
    """A short name for each scene: the last part of its path, where no other one ends alike."""
    scenes = list(dict.fromkeys(row["scene"] for row in rows))
    last = [named_after(Path(scene)).name for scene in scenes]
    return {scene: name if last.count(name) == 1 else scene for scene, name in zip(scenes, last, strict=True)}


def tell_rows(rows: Sequence[Document], out: Console) -> None:
    """Print a table, a line a variant."""
    scenes, params, metrics = scene_names(rows), list(rows[0]["params"]), shown(rows)
    figures = [name.replace(".", "\n") for name in metrics]
    columns = [*(["scene"] if len(scenes) > 1 else []), *short_names(params), *figures]
    table = Table(*columns, "reused", "computed", "seconds", "", box=None)
    for row in rows:
        table.add_row(
            *([escape(scenes[row["scene"]])] if len(scenes) > 1 else []),
            *(escape(in_short(row["params"][name])) for name in params),
            *(f"{row['metrics'][name]:.4g}" if name in row["metrics"] else "" for name in metrics),
            str(row["hits"]),
            str(row["misses"]),
            f"{row['seconds']:.1f}",
            "" if row["status"] == "ok" else f"[red]{row['status']}[/]",
        )
    print_table(table, out)
    for error in dict.fromkeys(row["error"] for row in rows if row["error"]):
        out.print(f"[red]failed:[/] {escape(error)}")


def tell_plan(labels: Sequence[str], rows: Sequence[Row], out: Console, *, scenes: Sequence[str] | None) -> int:
    """Tell of a dry run; with `scenes` (a path a row) as a JSON document on stdout. Returns the exit code."""
    if scenes is not None:
        documents = [
            {"scene": scene, "params": row.values, "hits": row.hits, "would_run": would_run(row.report)}
            for scene, row in zip(scenes, rows, strict=True)
        ]
        print(json.dumps(documents))
        return 0
    for label, row in zip(labels, rows, strict=True):
        out.print(escape(f"{label}: {plan_in_words(row.report)}"))
    total = len({node["key"] for row in rows for node in row.report.nodes if node["event"] == "would run"})
    out.print(f"at least {total} results would be computed in all; what follows from them is not known yet")
    return 0


def holds_other(folder: Path, asked: str) -> bool:
    """Whether a folder holds the files of a sweep that asked something else, or of no sweep under a sweep's names.

    asked: what a row has as "sweep".
    """
    try:
        return any(row.get("sweep") != asked for row in read_json((folder / "sweep.json").read_text(encoding="utf-8")))
    except FileNotFoundError:
        return any((folder / name).exists() for name in ("sweep.csv", "sweep.png"))
    except NotADirectoryError:
        return False
    except (OSError, ValueError, TypeError, AttributeError):
        return True


def write_files(out: Path, rows: Sequence[Document], *, zipped: bool) -> list[str]:
    """Write sweep.json, sweep.csv and, where there are figures to draw, sweep.png; return their names."""
    from ss_flow.flows.cli.sweep_plot import plot

    write_atomically(out / "sweep.json", json.dumps(rows, indent=1))
    write_atomically(out / "sweep.csv", _csv(rows))
    picture = plot(rows, shown(rows), zipped=zipped)
    if picture is None:
        (out / "sweep.png").unlink(missing_ok=True)  # of an earlier sweep
        return ["sweep.json", "sweep.csv"]
    write_atomically(out / "sweep.png", picture)
    return ["sweep.json", "sweep.csv", "sweep.png"]


def _csv(rows: Sequence[Document]) -> str:
    """One line a row; parameters under their full names."""
    params, metrics, counts = list(rows[0]["params"]), metrics_of(rows), ("hits", "misses", "seconds", "status")
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["scene", *params, *metrics, *counts])
    for row in rows:
        values = [value if isinstance(value, float) else in_short(value) for value in row["params"].values()]
        found = [row["metrics"].get(name, "") for name in metrics]
        writer.writerow([row["scene"], *values, *found, *(row[name] for name in counts)])
    return text.getvalue()
