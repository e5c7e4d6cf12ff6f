"""`ss-flow diff`: what two results differ in, from what was asked to what came of it."""

from __future__ import annotations

import json
from collections import Counter, defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from ss_flow.errors import InputError
from ss_flow.flows.cli.context import console
from ss_flow.flows.cli.telling import print_table
from ss_flow.flows.results import read_run
from ss_flow.tasks.capture.id_images import written_ids
from ss_flow.tasks.evaluate.comparison import Correspondence, correspondence

_SHOWN = 10
"""Lines of a list that the terminal shows; --json has them all."""
_CHANGED = 0.9
"""IoU below which a pair of instances is told."""


@dataclass(frozen=True)
class Diff:
    """Tell what two results differ in: files given, parameters, networks, metrics, steps, which objects are which.

    Objects are compared in the masks of the views that both results have; ids need not agree.
    """

    first: Annotated[Path, tyro.conf.Positional]
    """The output folder of a run."""
    second: Annotated[Path, tyro.conf.Positional]
    """That of another one."""
    json: bool = False
    """Print one JSON document."""

    def run(self) -> int:
        document = difference(self.first, self.second)
        if self.json:
            print(json.dumps(document, indent=1))
        else:
            _tell(document, console(json=False))
        return 0


def difference(one: Path, other: Path) -> dict[str, Any]:
    """What two output folders of runs differ in. Raises InputError where one is none, or is damaged."""
    first, second = read_run(one), read_run(other)
    views = _views_of_both(one, other)
    why_not = _why_not([one, other], views, other_photos=_of_other_photos(first, second))
    matched = correspondence(_id_images(views)) if why_not is None else None
    return {
        "runs": [str(one), str(other)],
        "scenes": [first["scene"], second["scene"]],
        "params": _changed(first["params"], second["params"]),
        "models": _changed(first["models"], second["models"]),
        "given": _changed(_given(first), _given(second)),
        "metrics": _both(_flat(first["metrics"]), _flat(second["metrics"])),
        "steps": _steps(first["nodes"], second["nodes"]),
        "instances": None if matched is None else _instances(matched, len(views)),
        "not_compared": why_not,
    }


def _given(document: dict[str, Any]) -> dict[str, Any]:
    """The preset and the files that a run was given, besides its capture, by the options that name them."""
    given = {"preset": document.get("preset"), **document.get("given", {}), "scene": document.get("given_scene")}
    return {f"--{name}": value for name, value in given.items()}


def _changed(first: dict[str, Any], second: dict[str, Any]) -> dict[str, list[Any]]:
    return {name: pair for name, pair in _both(first, second).items() if pair[0] != pair[1]}


def _both(first: dict[str, Any], second: dict[str, Any]) -> dict[str, list[Any]]:
    """The values of each name in the two, None where one lacks it."""
    return {name: [first.get(name), second.get(name)] for name in {**first, **second}}


def _flat(metrics: dict[str, dict[str, float]]) -> dict[str, float]:
    return {f"{stage}.{name}": value for stage, values in metrics.items() for name, value in values.items()}


def _steps(first: list[dict[str, Any]], second: list[dict[str, Any]]) -> dict[str, dict[str, Any]]:
    """By step: nodes with the same result in both, with another one, or in one run only; and seconds of computation.

    Nodes are paired by what they gave, not by their items: where an object comes or goes, others get other numbers.
    """
    results: tuple[dict[str, Counter[tuple[str, ...]]], ...] = (defaultdict(Counter), defaultdict(Counter))
    seconds: dict[str, list[float]] = defaultdict(lambda: [0.0, 0.0])
    for side, nodes in enumerate((first, second)):
        for node in nodes:
            results[side][node["step"]][tuple(node["outputs"])] += 1
            seconds[node["step"]][side] += node["seconds"]
    steps = {}
    for step in seconds:
        a, b = (side[step] for side in results)
        same, only_a, only_b = ((a & b).total(), (a - b).total(), (b - a).total())
        steps[step] = {
            "same": same,
            "different": (different := min(only_a, only_b)),
            "only_first": only_a - different,
            "only_second": only_b - different,
            "seconds": seconds[step],
        }
    return steps


def _of_other_photos(first: dict[str, Any], second: dict[str, Any]) -> bool:
    """Whether two results are of other photos, though views may go by the same names: no photo of one capture is one of
    the other's."""
    photos = [set(document["results"].get("ingest", ())) for document in (first, second)]
    return first["scene"] != second["scene"] and photos[0].isdisjoint(photos[1])


def _why_not(folders: list[Path], views: list[tuple[Path, Path]], *, other_photos: bool) -> str | None:
    """Why the objects of two results cannot be compared; None where they can. views: those that both have."""
    if unmasked := [folder for folder in folders if not (folder / "masks").is_dir()]:
        return f"{unmasked[0]} has no masks"
    if not views:
        return "the two results have no view of the same name"
    return "the two are of other photos" if other_photos else None


def _views_of_both(first: Path, second: Path) -> list[tuple[Path, Path]]:
    return [(a, b) for a in sorted((first / "masks").glob("*.png")) if (b := second / "masks" / a.name).is_file()]


def _id_images(views: list[tuple[Path, Path]]) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    for files in views:
        a, b = map(written_ids, files)
        if a.shape != b.shape:
            raise InputError(f"{files[0]} and {files[1]} differ in size; diff compares runs of the same photos.")
        yield a, b


def _instances(found: Correspondence, views: int) -> dict[str, Any]:
    return {
        "views": views,
        "agreement": found.agreement,
        "pairs": [{"first": a, "second": b, "iou": iou} for (a, b), iou in sorted(found.pairs.items())],
        "in_pieces": [{"first": a, "second": list(pieces)} for a, pieces in found.in_pieces.items()],
        "joined": [{"second": b, "first": list(pieces)} for b, pieces in found.joined.items()],
        "only_first": list(found.only_first),
        "only_second": list(found.only_second),
    }


def _tell(document: dict[str, Any], out: Console) -> None:
    if document["scenes"][0] != document["scenes"][1]:
        out.print(escape("scenes: {} and {}".format(*document["scenes"])))
    for title in ("given", "params", "models"):
        for name, (a, b) in document[title].items():
            out.print(escape(f"{name}: {a} -> {b}"))
    if document["metrics"]:
        table = Table("metric", "first", "second", "difference", box=None)
        for name, pair in document["metrics"].items():
            a, b = ("" if value is None else f"{value:.4f}" for value in pair)
            table.add_row(name, a, b, "" if None in pair else f"{pair[1] - pair[0]:+.4f}")
        print_table(table, out)
    table = Table("step", "same", "different", "only first", "only second", "seconds", box=None)
    for step, row in document["steps"].items():
        counts = (str(row[name] or "") for name in ("same", "different", "only_first", "only_second"))
        table.add_row(step, *counts, "{:.1f} / {:.1f}".format(*row["seconds"]))
    print_table(table, out)
    found = document["instances"]
    if found is None:
        out.print(escape(f"objects: not compared; {document['not_compared']}."))
        return
    what = f"mean IoU over {found['views']} views; an object without a partner counts 0"
    out.print(f"objects: agreement {found['agreement']:.3f} ({what})")
    lines = changes(found)
    for line in lines[:_SHOWN]:
        out.print(f"  {line}")
    if (more := len(lines) - _SHOWN) > 0:
        out.print(f"  and {more} more; --json lists them all")


def changes(found: dict[str, Any]) -> list[str]:
    """What a reader should know of the objects, the gravest first.

    found: "instances" of a `difference`.
    """

    def listed(ids: list[int]) -> str:
        return ", ".join(str(i) for i in ids)

    changed = sorted((pair["iou"], pair["first"], pair["second"]) for pair in found["pairs"])
    return [
        *(f"{row['first']} of the first is in pieces: {listed(row['second'])}" for row in found["in_pieces"]),
        *(f"{row['second']} of the second joins {listed(row['first'])}" for row in found["joined"]),
        *([f"only in the first: {listed(found['only_first'])}"] if found["only_first"] else []),
        *([f"only in the second: {listed(found['only_second'])}"] if found["only_second"] else []),
        *(f"{a} is {b} there, IoU {iou:.3f}" for iou, a, b in changed if iou < _CHANGED),
    ]
