"""`ss-flow eval`: a finished run against ground truth, by a published protocol."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import tyro
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from ss_flow.engine import Report, Request, run_flows
from ss_flow.errors import InputError
from ss_flow.flows.cli.context import (
    InStore,
    OptionalPath,
    StoreOptions,
    choose_model,
    console,
    file_digests,
    open_run,
    references,
)
from ss_flow.flows.cli.query import encoder_name, query_params
from ss_flow.flows.cli.telling import print_table
from ss_flow.flows.deliver import FALLBACKS
from ss_flow.flows.evaluate import (
    LERF,
    LabelledScene,
    Nodes,
    labels_of,
    lifted_truth,
    on_objects,
    on_points,
    scan_truth,
)
from ss_flow.flows.results import FinishedRun, not_of_an_edit, read_run
from ss_flow.task import Reference
from ss_flow.tasks.artifacts import Metrics
from ss_flow.tasks.capture.scene import open_scene
from ss_flow.tasks.capture.scene_files import read_json
from ss_flow.tasks.models.catalogue import DISTANCES

_LERF_NEEDED = {
    "lerf-strict": ("ingest", "cameras", "scene", "describe"),
    "lerf-oracle": ("ingest", "cameras", "masks_split", "masks", "describe"),
    "lerf-2d": ("ingest", "cameras", "scene", "describe"),
}

_STAGES = {"split": "after Split", "refined": "refined masks", "splat": "after Splat"}


@dataclass(frozen=True)
class Evaluate:
    """Measure a result against ground truth, by a published protocol."""

    result: Annotated[Path, tyro.conf.Positional]
    """The output folder of a run."""
    protocol: Literal["views", "points", "lerf-strict", "lerf-oracle", "lerf-2d", "objects"] = "views"
    """"views": masks on the pixels of all annotated views pooled, as `run` measures them; "points": instances on
    annotated points, as ScanNet is evaluated; "lerf-strict", "lerf-oracle", "lerf-2d": texts on labelled frames;
    "objects": renderings near each object, at its border, and without it."""
    truth: OptionalPath = None
    """For "points": the folder of a ScanNet or Replica scene with its mesh and annotation, in the frame of the poses;
    left out, the capture's annotated views are carried to its dense points. For "lerf-...": the folder of label files;
    by default label/ of the scene."""
    radius: float = 0.0
    """For "points": annotated points farther than this from everything labelled count as unlabelled, in world units; 0
    = no limit, as in the protocol."""
    compat: bool = False
    """For "points" with a --truth of ScanNet: score as the published scripts do: by the annotation of the finer mesh,
    and with the ids 0 to the number of instances, also where they have gaps."""
    texts: OptionalPath = None
    """For "lerf-...": a file (.json) of what to ask for in the place of a category's own name: {category: text}."""
    json: bool = False
    """Print one JSON document."""
    store: InStore = StoreOptions()
    """Where results are kept; by default the store that the run names."""

    def run(self) -> int:
        self._check()
        warnings: list[str] = []
        tables = self._measured(warnings)
        if self.json:
            told = {"protocol": self.protocol, "result": str(self.result), **tables.asked, "metrics": tables.stages}
            objects = {"objects": tables.objects} if tables.objects else {}
            print(json.dumps({**told, **objects, "warnings": warnings}, indent=1))
            return 0
        for text in warnings:
            console(json=True).print(escape(f"warning: {text}"))
        _tell(tables, console(json=False))
        return 0

    def _check(self) -> None:
        if not 0 <= self.radius < math.inf:
            raise InputError(f"--radius {self.radius} is out of range; it must be 0 (no limit) or a length above 0.")
        if self.protocol != "points" and (self.radius or self.compat):
            raise InputError("--radius and --compat are for --protocol points; add it.")
        if self.compat and not self.truth:
            raise InputError("--compat follows the published scripts, which score ScanNet's mesh; add --truth DIR.")
        if self.protocol in ("views", "objects") and self.truth:
            raise InputError("--truth is for --protocol points and for those on labelled frames; add one.")
        if self.protocol not in LERF and self.texts:
            raise InputError(
                "--texts is for the protocols on labelled frames, such as --protocol lerf-strict; add one."
            )

    def _measured(self, warnings: list[str]) -> _Tables:
        if self.protocol == "views":
            return _Tables(_of_views(self.result))
        if self.protocol == "points":
            return self._of_points(warnings)
        if self.protocol == "objects":
            return self._of_objects(warnings)
        return self._of_labels(warnings)

    def _of_points(self, warnings: list[str]) -> _Tables:
        run = open_run(self.result, self.store, ("dense", "cut", "reproject", "scene"))
        if not self.truth and "truth" in run.results.digests:
            run.require(("visibility", "truth"))

        def build(nodes: Nodes, reference: Reference) -> dict[str, Any]:
            folder = self.truth
            truth = lifted_truth(nodes) if folder is None else scan_truth(folder, reference, compat=self.compat)
            return dict(on_points(nodes, truth, radius=self.radius, compat=self.compat))

        return _Tables(_metrics(_evaluated(run, build, warnings)))

    def _of_objects(self, warnings: list[str]) -> _Tables:
        run = open_run(self.result, self.store, ("scene", "masks"))
        kept_back = "truth_held_out" in run.results.digests
        if "truth" in run.results.digests or kept_back:
            run.require([f"{name}_held_out" if kept_back else name for name in ("ingest", "cameras", "truth")])
        with file_digests(run.store) as digests:
            perception = choose_model(DISTANCES, run.document["params"].get("evaluate.lpips", "auto"), digests)
        found = _evaluated(run, lambda nodes, reference: dict(on_objects(nodes, perception)), warnings)
        views, taken = found["views"], found["removals"]
        means = {
            "psnr": views.whole_psnr,
            "ssim": views.whole_ssim,
            "object_psnr": float(np.mean(views.psnr)),
            "object_ssim": float(np.mean(views.ssim)),
            "band_psnr": views.band_psnr,
            "band_ssim": views.band_ssim,
        }
        each = {"instance": views.instance, "views": views.views, "psnr": views.psnr, "ssim": views.ssim}
        if perception is None:
            warnings.append("LPIPS was not measured: no network for it is here; `ss-flow doctor` tells how to get one.")
        else:
            means |= {"lpips": views.whole_lpips, "object_lpips": float(np.mean(views.lpips))}
            means["band_lpips"] = views.band_lpips
            each["lpips"] = views.lpips
        if len(taken.residual):
            means |= {"residual": float(np.mean(taken.residual)), "worst_residual": float(np.max(taken.residual))}
        objects = {
            "true objects": _rows(**each),
            "instances taken out": _rows(instance=taken.instance, residual=taken.residual),
        }
        measured = {name: value for name, value in means.items() if not math.isnan(value)}  # without a border no band
        return _Tables({"held out views" if kept_back else "training views": measured}, objects)

    def _of_labels(self, warnings: list[str]) -> _Tables:
        run = open_run(self.result, self.store, _LERF_NEEDED[self.protocol])
        files = open_scene(Path(run.document["scene"]))
        name = encoder_name(run)
        with file_digests(run.store) as digests:
            labelled = LabelledScene.of(
                self.truth or labels_of(files),
                files,
                references(digests),
                encoder=choose_model("text-image", name, digests),
                query=query_params(run.document),
                texts=_texts(self.texts),
            )
        if labelled.unread:
            said = ", ".join(labelled.unread)
            who = "the encoder of colour words" if name == "none" else name
            warnings.append(f"{who} cannot be asked for {said}; these categories score 0.")
        build = LERF[self.protocol]
        asked: dict[str, Any] = {"encoder": FALLBACKS["encoder"] if name == "none" else name}
        if self.protocol != "lerf-2d":
            asked |= {"prompt": labelled.query.prompt, "tau_corr": labelled.query.tau_corr}
        stages = _metrics(_evaluated(run, lambda nodes, reference: dict(build(nodes, labelled)), warnings))
        return _Tables(stages, asked=asked)


@dataclass(frozen=True)
class _Tables:
    """What a protocol came to."""

    stages: Mapping[str, Mapping[str, float]]
    """Figures by stage."""
    objects: Mapping[str, list[dict[str, float]]] | None = None
    """Rows of single objects, by what they are."""
    asked: Mapping[str, Any] = field(default_factory=dict)
    """What texts were asked with, where they were (spec 2.2): the encoder, and what it depends on besides."""


def _evaluated(
    run: FinishedRun, build: Callable[[Nodes, Reference], dict[str, Any]], warnings: list[str]
) -> dict[str, Any]:
    """The artifacts that `build` makes of a run's results. Raises what went wrong."""
    found: list[Report] = []
    with file_digests(run.store) as digests:
        request = Request(
            lambda: build(run.results.nodes(), references(digests)),
            run.document["scene"],
            done=found.append,
        )
        run_flows([request], run.store, recorded=False)
    warnings += dict.fromkeys(text for node in found[-1].nodes for text in node.get("warnings") or ())
    return {name: run.store.get(str(value)) for name, value in found[-1].succeeded().items()}


def _metrics(found: Mapping[str, Metrics]) -> dict[str, dict[str, float]]:
    return {stage: dict(metrics.values) for stage, metrics in found.items()}


def _of_views(folder: Path) -> dict[str, dict[str, float]]:
    document = read_run(folder)
    if "edit" in document:
        raise not_of_an_edit(folder, document, "metrics")
    metrics = {stage: values for stage, values in document["metrics"].items() if stage != "novel_view"}
    if not metrics:
        raise InputError(f"{folder} was run on a capture without annotated views; there is nothing to measure by.")
    return metrics


def _texts(file: Path | None) -> dict[str, str]:
    document = {} if file is None else read_json(file)
    if not isinstance(document, dict) or not all(isinstance(text, str) for text in document.values()):
        raise InputError(f"{file} holds no texts; an object of the form {{category: text}} is expected.")
    return document


def _rows(**columns: np.ndarray) -> list[dict[str, float]]:
    lists = {name: column.tolist() for name, column in columns.items()}
    return [dict(zip(lists, values, strict=True)) for values in zip(*lists.values(), strict=True)]


def _tell(tables: _Tables, out: Console) -> None:
    if tables.asked:
        out.print(escape(", ".join(f"{name}: {value}" for name, value in tables.asked.items())), highlight=False)
    table = Table("metric", *(_STAGES.get(stage, stage) for stage in tables.stages), box=None)
    stages = tables.stages.values()
    for name in dict.fromkeys(name for values in stages for name in values):
        table.add_row(name, *(f"{values[name]:.4f}" if name in values else "" for values in stages))
    print_table(table, out)
    for title, rows in (tables.objects or {}).items():
        if rows:
            table = Table(title, *list(rows[0])[1:], box=None)
            for row in rows:
                table.add_row(*(str(v) if isinstance(v, int) else f"{v:.4f}" for v in row.values()))
            print_table(table, out)
