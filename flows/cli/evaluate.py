"""`ss-flow eval`: a finished run against ground truth, by a published protocol."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro
from rich.markup import escape
from rich.table import Table

from ss_flow.cache.store import Store
from ss_flow.engine import Report, Request, run_flows
from ss_flow.errors import InputError
from ss_flow.flows.cli.context import OptionalPath, StoreOptions, console, file_digests, open_run
from ss_flow.flows.evaluate import lifted_truth, on_points, scan_truth
from ss_flow.flows.results import read_run
from ss_flow.resolution import Failure
from ss_flow.task import FileRef

_NEEDED = ("dense", "cut", "reproject", "scene")


@dataclass(frozen=True)
class Evaluate:
    """Measure a result against ground truth, by a published protocol."""

    result: Annotated[Path, tyro.conf.Positional]
    """The output folder of a run."""
    protocol: Literal["views", "points"] = "views"
    """"views": masks on the pixels of all annotated views pooled, as `run` measures them; "points": instances on
    annotated points, as ScanNet is evaluated."""
    truth: OptionalPath = None
    """For "points": the folder of a ScanNet scene with its mesh and annotation, in the frame of the poses; left out,
    the capture's annotated views are carried to its dense points."""
    radius: float = 0.0
    """For "points": annotated points farther than this from everything labelled count as unlabelled, in world units; 0
    = no limit, as in the protocol."""
    compat: bool = False
    """For "points": score as the published scripts do: by the annotation of the finer mesh, and with the ids 0 to the
    number of instances, also where they have gaps."""
    json: bool = False
    """Print one JSON document."""
    store: tyro.conf.OmitArgPrefixes[StoreOptions] = StoreOptions()
    """Where results are kept; by default the store that the run names."""

    def run(self) -> int:
        if self.radius < 0:
            raise InputError(f"--radius {self.radius} is out of range; it must be 0 or more.")
        if self.protocol == "views" and (self.truth or self.radius or self.compat):
            raise InputError("--truth, --radius and --compat are for --protocol points; add it.")
        warnings: list[str] = []
        metrics = _of_views(self.result) if self.protocol == "views" else self._of_points(warnings)
        if self.json:
            told = {"protocol": self.protocol, "result": str(self.result), "metrics": metrics, "warnings": warnings}
            print(json.dumps(told, indent=1))
            return 0
        for text in warnings:
            console(json=True).print(escape(f"warning: {text}"))
        table = Table("metric", *(f"after {stage.capitalize()}" for stage in metrics), box=None)
        for name in dict.fromkeys(name for values in metrics.values() for name in values):
            table.add_row(name, *(f"{values[name]:.4f}" if name in values else "" for values in metrics.values()))
        console(json=False).print(table)
        return 0

    def _of_points(self, warnings: list[str]) -> dict[str, dict[str, float]]:
        annotated = () if self.truth or "truth" not in read_run(self.result)["results"] else ("visibility", "truth")
        run = open_run(self.result, self.store, (*_NEEDED, *annotated))
        results, digests = run.results, file_digests(run.store)
        found: list[Report] = []

        def build() -> dict[str, Any]:
            if self.truth is None:
                truth = lifted_truth(results)
            else:
                truth = scan_truth(self.truth, lambda p: FileRef(p.absolute(), digests(p)), compat=self.compat)
            return dict(on_points(results, truth, radius=self.radius, compat=self.compat))

        run_flows([Request(build, run.document["scene"], done=found.append)], run.store, recorded=False)
        digests.save()
        warnings += dict.fromkeys(text for node in found[-1].nodes for text in node.get("warnings") or ())
        return {stage: _values(run.store, value) for stage, value in found[-1].values.items()}


def _values(store: Store, value: Any) -> dict[str, float]:
    if isinstance(value, Failure):
        raise value.error
    return dict(store.get(value).values)


def _of_views(folder: Path) -> dict[str, dict[str, float]]:
    metrics = {stage: values for stage, values in read_run(folder)["metrics"].items() if stage != "novel_view"}
    if not metrics:
        raise InputError(f"{folder} was run on a capture without annotated views; there is nothing to measure by.")
    return metrics
