"""The rows of a batch's batch.json: what one says of a scene, and which of earlier batches still hold."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from ss_flow.cache.files import write_atomically
from ss_flow.cache.plain_json import read_json
from ss_flow.engine import Report
from ss_flow.errors import InputError
from ss_flow.sweep import rows_of
from ss_flow.tasks.deliver.output import RUN_FILE, writing_output

BATCH_FILE = "batch.json"
COLOURS = {"ok": "green", "degraded": "yellow", "failed": "red"}


def row_of(
    path: Path,
    status: str,
    report: Report | None = None,
    out: Path | None = None,
    error: str | None = None,
    metrics: dict[str, float] | None = None,
) -> dict[str, Any]:
    """A row of batch.json."""
    counted = rows_of([{}], [report])[0] if report else None
    return {
        "scene": str(path),
        "status": status,
        "out": str(out) if out and status != "failed" else None,
        "seconds": round(counted.seconds, 3) if counted else 0.0,
        "hits": counted.hits if counted else 0,
        "misses": counted.misses if counted else 0,
        "error": error,
        "metrics": metrics or {},
    }


def earlier_rows(file: Path, *, needed: bool) -> dict[str, dict[str, Any]]:
    """The rows of earlier batches, by scene. Raises InputError when batch.json is damaged but needed."""
    try:
        return {row["scene"]: row for row in read_json(file.read_text(encoding="utf-8")) if row["status"] in COLOURS}
    except FileNotFoundError:
        return {}
    except (OSError, ValueError, TypeError, KeyError) as error:
        if not needed:
            return {}
        raise InputError(f"{file} is damaged ({error}); run the batch without --retry-failed.") from None


def stays(row: Mapping[str, Any], places: Mapping[Path, Path]) -> bool:
    """Whether the row of an earlier batch is of a scene that is not run now and whose folder is still its own."""
    if Path(row["scene"]) in places or row.get("out") is None or Path(row["out"]) in places.values():
        return False
    return (Path(row["out"]) / RUN_FILE).is_file()


def has_ended(row: Mapping[str, Any] | None, asked: str) -> bool:
    """Whether a scene, by its row of an earlier batch, if any, was run as is asked now, and what came of it is there.

    A run that writes no folder (--until) has what came of it in the store.
    """
    if row is None or row["status"] == "failed" or row.get("asked") != asked:
        return False
    return row["out"] is None or (Path(row["out"]) / RUN_FILE).is_file()


class Book:
    """The rows of batch.json, in the order of the scenes; written, and told of, whenever one is added."""

    def __init__(
        self,
        file: Path,
        scenes: Sequence[str],
        rows: dict[str, dict[str, Any]],
        others: Sequence[dict[str, Any]],
        asked: str,
        tell: Console,
    ) -> None:
        """others: rows of scenes that are not of this batch. asked: a digest of how its scenes are to be run."""
        self._file, self._scenes, self._rows, self._others = file, scenes, rows, others
        self._asked, self._tell = asked, tell
        self._write()

    @property
    def rows(self) -> list[dict[str, Any]]:
        return [self._rows[scene] for scene in self._scenes if scene in self._rows]

    def add(self, row: dict[str, Any]) -> None:
        self._rows[row["scene"]] = row | {"asked": self._asked}
        self._write()
        place = f"see {row['out']}" if row["out"] else None
        what = "; ".join(filter(None, (row["error"], place))) or f"{row['misses']} results computed"
        words = escape(f"{row['scene']}: {what}")
        self._tell.print(f"[{COLOURS[row['status']]}]{row['status']}[/] {words}")

    def _write(self) -> None:
        with writing_output(self._file):
            write_atomically(self._file, json.dumps([*self._others, *self.rows], indent=1))


def table_of(rows: Sequence[dict[str, Any]], folders: dict[Path, str]) -> Table:
    metrics = [name for name in ("split.miou", "splat.miou") if any(name in row["metrics"] for row in rows)]
    table = Table("scene", "", "instances", *metrics, "reused", "computed", "seconds", box=None)
    for row in rows:
        found = [row["metrics"].get(name) for name in ("splat.instances", *metrics)]
        table.add_row(
            escape(folders[Path(row["scene"])]),
            f"[{COLOURS[row['status']]}]{row['status']}[/]",
            *("" if value is None else f"{value:.4g}" for value in found),
            str(row["hits"]),
            str(row["misses"]),
            f"{row['seconds']:.1f}",
        )
    return table
