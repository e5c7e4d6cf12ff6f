"""Editing a finished run: a script of operations -> a chain of cached tasks -> an output folder of the same kind."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ss_flow.cache.canonical import digest
from ss_flow.cache.files import write_atomically
from ss_flow.cache.store import Store
from ss_flow.engine import Report, Request, run_flows
from ss_flow.errors import InputError
from ss_flow.events import Reporter
from ss_flow.flows.deliver import failure_records, node_records, write_document
from ss_flow.flows.edit_objects import Objects
from ss_flow.flows.edit_script import Step, check, rooted
from ss_flow.flows.results import FinishedRun, Results, finished_run, read_run, source_in_words
from ss_flow.graph import labelled
from ss_flow.kept_closures import kept_closure
from ss_flow.resolution import Failure
from ss_flow.tasks.artifacts import EditedScene
from ss_flow.tasks.deliver.output import RUN_FILE, write_scene
from ss_flow.tasks.deliver.places import RESULT, check_replaceable, replacing_own
from ss_flow.tasks.edit.clear import clear
from ss_flow.tasks.edit.fill import fill
from ss_flow.tasks.edit.holes import Holes, Measured, holes
from ss_flow.tasks.edit.operations import begin
from ss_flow.tasks.edit.pictures import before_and_after

_NEEDED = ("scene", "cameras", "depth", "dense", "cut")
_CAPTURE = ("ingest", "cameras", "depth", "dense")
"""Results of the source run that an edit leaves true."""


@dataclass(frozen=True)
class Edit:
    """A checked script, ready to run."""

    source: FinishedRun
    """The run that is edited."""
    script: Mapping[str, Any]
    """With absolute paths."""
    steps: list[Step]
    objects: Objects
    """Those of the edited scene."""

    def build(self) -> dict[str, Any]:
        """Add the script's nodes to a flow: "scene", "report_pictures", and for each operation N after which something
        has left its place "holes_N"; where its holes are filled, "whole_N" before and "cleared_N" after what came to
        light is taken away, and "unfilled_N"."""
        results = self.source.results
        measured = Measured(*(results.node(name) for name in _NEEDED[1:]))
        scene = begin(results.node("scene"))
        outputs: dict[str, Any] = {}
        for step in self.steps:
            with labelled(str(step.number)):
                after, left = step.apply(scene), {"instances": step.leaving, "gone": step.gone}
                if step.leaving:
                    outputs[f"holes_{step.number}"] = holes(scene, after, measured, **left)
                if step.leaving and step.fill:
                    outputs[f"whole_{step.number}"] = after
                    after = clear(scene, after, measured, **left)
                    outputs[f"cleared_{step.number}"] = after
                    after = fill(scene, after, measured, **left)
                    outputs[f"unfilled_{step.number}"] = holes(scene, after, measured, **left)
            scene = after
        pictures = before_and_after(results.node("scene"), scene, results.node("cameras"))
        return outputs | {"scene": scene, "report_pictures": pictures}


def open_edit(source: Path, script: Mapping[str, Any], store: Store, folder: Path = Path()) -> Edit:
    """Check a script whole against a finished run.

    source: the run's output folder. script: the document. store: where the run's results are. folder: what relative
    paths in the script start from.
    Raises InputError when the run cannot be edited, and for the script's first fault.
    """
    document = read_run(source)
    if "edit" in document:
        raise InputError(
            f"{source} is an edited run; add the operations to its script (edit.script in its {RUN_FILE}) and edit "
            f"{source_in_words(source, document)}."
        )
    run = finished_run(source, document, store, _NEEDED)
    begun = Objects.of(run.instances, run.results.one("scene"), run.results.one("cameras"))
    steps, objects = check(script, begun, folder, store)
    return Edit(run, rooted(script, folder), steps, objects)


def run_edit(edit: Edit, store: Store, out: Path, *, reporter: Reporter | None = None, jobs: int = 0) -> dict[str, Any]:
    """Run an edit and write its output folder; return the document run.json.

    Raises InputError when `out` cannot be written, and what a task raised when one failed.
    """
    if out.resolve() == edit.source.folder.resolve():
        raise InputError(f"--out {out} is the run that is edited; name another folder.")
    read = [Path(operation["run"]) for operation in edit.script["operations"] if "run" in operation]
    check_replaceable(out, RESULT, store.location, [edit.source.folder, *read])
    documents: list[dict[str, Any]] = []

    def done(report: Report) -> None:
        failed = next((failure for failure in report.values.values() if isinstance(failure, Failure)), None)
        if failed is not None:
            raise failed.error
        documents.append(_deliver(edit, store, out, report))

    request = Request(
        edit.build, str(out.resolve()), {"edited": str(edit.source.folder.resolve())}, None, reporter, done
    )
    run_flows([request], store, jobs=jobs)
    return documents[-1]


def _deliver(edit: Edit, store: Store, out: Path, report: Report) -> dict[str, Any]:
    from ss_flow.tasks.deliver.report import report_html

    source, results = edit.source.document, edit.source.results.digests
    made = Results(store, report.values)
    scene: EditedScene = made.one("scene")
    instances = edit.objects.document(edit.source.instances, scene)
    document: dict[str, Any] = {
        "status": "ok",
        "warnings": [
            *({"label": f"{s.op}[{s.number}]", "text": s.warning} for s in edit.steps if s.warning),
            *({"label": n["label"], "text": text} for n in report.nodes for text in n.get("warnings", ())),
        ],
        "scene": source["scene"],
        "params": source["params"],
        **{name: source[name] for name in ("preset", "set", "given", "given_scene") if name in source},
        "models": source["models"],
        "metrics": {},
        "nodes": node_records(report),
        "failures": failure_records(report),
        "results": {name: results[name] for name in _CAPTURE} | report.values,
        "store": store.location,
        "edit": {
            "source": str(edit.source.folder.resolve()),
            "source_from_here": os.path.relpath(edit.source.folder.resolve(), out.resolve()),
            "source_content": source.get("content"),
            "script": edit.script,
            "holes": [_told(step, made) for step in edit.steps if step.leaving],
            "num_filled": int(scene.filled.sum()),
        },
    }
    code = kept_closure(_deliver, store.closures).definitions
    document["content"] = digest({"results": report.values, "instances": instances, "code": code})
    with replacing_own(out, RESULT) as filling:
        write_scene(filling, scene, instances)
        html = report_html(document, pictures=made.all("report_pictures"), instances=instances)
        write_atomically(filling / "report.html", html)
        write_document(filling, document)
    return document


def _told(step: Step, made: Results) -> dict[str, Any]:
    """What run.json says of the holes that an operation left."""
    hole: Holes = made.one(f"holes_{step.number}")
    told = {
        "operation": step.number,
        "instances": list(step.leaving),
        "views": len(hole.names),
        "pixels": int(hole.left.sum()),
        "unmeasured": int(hole.unmeasured.sum()),
        "empty": int(hole.empty.sum()),
        "largest_area": round(float(hole.area.max(initial=0)), 6),
    }
    if step.fill:
        told["cleared"] = len(made.one(f"whole_{step.number}")) - len(made.one(f"cleared_{step.number}"))
        told["open_after_filling"] = int(made.one(f"unfilled_{step.number}").unmeasured.sum())
    return told
