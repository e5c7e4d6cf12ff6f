"""Looking at runs and at what they left: status, graph, cache ls, cache show."""

from __future__ import annotations

import contextlib
import json
import re
import time
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro
from rich.markup import escape
from rich.table import Table

from ss_flow.cache.canonical import digests_of
from ss_flow.cache.files import write_atomically
from ss_flow.cache.store import Store
from ss_flow.errors import InputError
from ss_flow.flows.cli.context import InStore, OptionalPath, PositionalPath, StoreOptions, console
from ss_flow.flows.cli.telling import print_table
from ss_flow.flows.describe import told
from ss_flow.flows.results import read_run
from ss_flow.runs import DONE, Run, latest_runs, settled
from ss_flow.tasks.deliver.output import RUN_FILE, check_named
from ss_flow.telemetry import trace


@dataclass(frozen=True)
class Status:
    """Tell what the latest run did, step by step; also while it runs."""

    scene: PositionalPath = None
    """Only runs of this scene."""
    json: bool = False
    """Print one JSON document."""
    otlp: OptionalPath = None
    """Also write the run as an OpenTelemetry trace (OTLP, JSON) to this file."""
    store: InStore = StoreOptions()
    """Where results are kept."""

    def run(self) -> int:
        run = latest_run(self.store.existing_store(), self.scene)
        if self.otlp:
            check_named(self.otlp, "--otlp")
            write_atomically(self.otlp, json.dumps(trace(run)) + "\n")
        events = list(run.events())
        steps = _steps(events)
        last = next((e for e in reversed(events) if e["event"] in ("run ended", "restarted")), None)
        ended = last if last and last["event"] == "run ended" else None
        state = _state(ended, events)
        done = sum(event["event"] in DONE for event in settled(events))
        # `known` falls again where a result chooses fewer of the others than might have been needed.
        known = next((event["known"] for event in reversed(events) if "known" in event), 0)
        expected = done if state == "done" else max(done, known)
        about = {"scene": run.scene, "started": run.header["started"], "state": state}
        document = about | {"done": done, "expected": expected, "steps": steps}
        if self.json:
            print(json.dumps(document, indent=1))
            return 0
        out = console(json=False)
        started = time.strftime("%F %T", time.localtime(run.header["started"]))
        growing = "" if state.startswith("done") else " or more"  # some results decide how many others there are
        out.print(escape(f"{run.scene}: {state}, started {started}, {done} of {expected}{growing} results are there"))
        table = Table("step", "of", "reused", "computed", "running", "failed", "seconds", box=None)
        for step, row in steps.items():
            failed = row["failed"] + row["skipped"]
            counts = (row["expected"], row["hit"], row["finished"], row["running"], failed)
            table.add_row(step, *(str(n or "") for n in counts), f"{row['seconds']:.1f}" if row["seconds"] else "")
        print_table(table, out)
        return 0


def _steps(events: list[dict[str, Any]]) -> dict[str, dict[str, Any]]:
    """How many nodes of each step were found, computed and so on, and how many are needed as far as is known."""
    steps: dict[str, dict[str, Any]] = defaultdict(
        lambda: {"hit": 0, "finished": 0, "failed": 0, "skipped": 0, "running": 0, "expected": 0, "seconds": 0.0}
    )
    running: dict[Any, str] = {}  # keys, each of several nodes perhaps, and their steps
    for event in events:
        row = steps[event["step"]] if "step" in event else {}
        row["expected"] = event.get("of", 0)
        if event["event"] == "restarted":  # the same results are found again
            running.clear()
            for row in steps.values():
                row |= {"hit": 0, "skipped": 0}
        elif event["event"] == "started":
            running[event.get("key")] = event["step"]
        elif event["event"] in ("finished", "failed", "retried"):
            running.pop(event.get("key"), None)
        if event["event"] in row:
            row[event["event"]] += 1
            row["seconds"] += event["seconds"] if event["event"] == "finished" else 0.0
    for step in running.values():
        steps[step]["running"] += 1
    return steps


def _state(ended: dict[str, Any] | None, events: list[dict[str, Any]]) -> str:
    if ended is None:
        silent = time.time() - events[-1]["time"] if events else 0.0
        return f"running, or killed; last heard of {silent:.0f} s ago"
    if ended.get("interrupted"):
        return "interrupted"
    failed = ended.get("failed")
    return f"done, {failed} failed" if failed else "done"


def named(run: Run, nodes: list[dict[str, Any]], name: str) -> list[dict[str, Any]]:
    """The nodes of a run that a user may mean: propagate, split.propagate, segment[0003], or a result, as masks.

    An item of a result may be named, too: masks come from steps of other names where no network finds them.
    """
    steps = [n for n in nodes if any(t == name or t.endswith(f".{name}") for t in (n["label"], n["step"]))]
    if steps:
        return steps
    result, bracket, item = name.partition("[")
    digests = set(run.results().get(result, ()))
    found = [n for n in nodes if n["label"].endswith(bracket + item) and not digests.isdisjoint(n.get("outputs", ()))]
    return found[::-1]  # a step that gave what it was given came later, and is what the result is of


def run_with(store: Store, scene: Path | None, name: str) -> tuple[Run | None, list[dict[str, Any]]]:
    """The latest run of a scene, or of any, that has results of this name, and their nodes; see `runs_to_ask`.

    (None, []) where no run has them.
    """
    with contextlib.suppress(InputError):  # there is no run at all
        for run in runs_to_ask(store, scene):
            if nodes := named(run, run.nodes(), name):
                return run, nodes
    return None, []


def runs_to_ask(store: Store, scene: Path | None) -> list[Run]:
    """The runs in which to look for a step, in this order: those of the scene; where none is named, of the scene that
    ran last, and then all others. Each time the latest first. scene: a capture, or an output folder: then those runs
    that came to what it holds.

    The very last run may have stopped before the step (`--until`, an interrupt), or be an edit, which has other steps.
    Raises InputError when there is no run.
    """
    runs = list(latest_runs(store.runs, str(scene.resolve()) if scene else None))
    if not runs and scene and (scene / RUN_FILE).is_file():
        return _runs_of_output(store, scene)
    if not runs:
        about = f" of {scene}" if scene else ""
        raise InputError(f"the store {store.location} knows no run{about}; `ss-flow run SCENE` makes one.")
    return sorted(runs, key=lambda run: run.scene != runs[0].scene)


def _runs_of_output(store: Store, folder: Path) -> list[Run]:
    """The runs that came to what an output folder holds, the latest first. Raises InputError when there is none."""
    document = read_run(folder)
    results = {name: digests_of(made) for name, made in document["results"].items()}
    of_scene = latest_runs(store.runs, str(Path(document["scene"]).resolve()))
    if runs := [run for run in of_scene if run.results() == results]:
        return runs
    raise InputError(
        f"the store {store.location} has no record of the run that made {folder}; {document['scene']} is its capture."
    )


def not_latest(run: Run, latest: Run) -> str | None:
    """What to say where something is told of another run than the latest one; None where it is that one."""
    if run.folder == latest.folder:
        return None
    started = time.strftime("%F %T", time.localtime(run.header["started"]))
    return f"the latest run has no such step; in that of {run.scene}, started {started}:"


@dataclass(frozen=True)
class Graph:
    """Draw what feeds what in the latest run, a box a step, in Mermaid's notation."""

    scene: PositionalPath = None
    """The scene; the one that ran last, when left out."""
    store: InStore = StoreOptions()
    """Where results are kept."""

    def run(self) -> int:
        graph = latest_run(self.store.existing_store(), self.scene).graph()
        print("flowchart TD")
        for step, count in graph.nodes(data="count"):
            print(f'  {step}["{step}{f" x {count}" if count > 1 else ""}"]')
        for producer, step, name in graph.edges(keys=True):
            print(f"  {producer} -->|{name}| {step}")
        return 0


@dataclass(frozen=True)
class CacheList:
    """List what the latest run left in the store: a line a result."""

    scene: PositionalPath = None
    """The scene; the one that ran last, when left out."""
    json: bool = False
    """Print one JSON document."""
    store: InStore = StoreOptions()
    """Where results are kept."""

    def run(self) -> int:
        store = self.store.existing_store()
        rows = []
        for node in latest_run(store, self.scene).nodes():
            size = sum(store.size(digest) for digest in node["outputs"])
            rows.append({k: node[k] for k in ("label", "key", "outputs", "seconds")} | {"bytes": size})
        if self.json:
            print(json.dumps(rows, indent=1))
            return 0
        table = Table("result", "digest", "items", "kB", "seconds", box=None)
        for row in rows:
            first = row["outputs"][0][:12] if row["outputs"] else ""
            table.add_row(
                escape(row["label"]),
                first,
                str(len(row["outputs"])),
                f"{row['bytes'] / 1000:.0f}",
                f"{row['seconds']:.1f}",
            )
        print_table(table, console(json=False))
        return 0


@dataclass(frozen=True)
class CacheShow:
    """Describe one result, or draw it as a picture."""

    what: Annotated[str, tyro.conf.Positional]
    """A step (propagate, segment[0003]) of the latest run that got to it, or the first characters of a digest."""
    png: OptionalPath = None
    """Write a picture of it to this file."""
    view: int = 0
    """Draw points and Gaussians as this view's camera sees them."""
    scene: OptionalPath = None
    """The scene; the one that ran last, when left out."""
    store: InStore = StoreOptions()
    """Where results are kept."""

    def run(self) -> int:
        store = self.store.existing_store()
        if self.png:
            check_named(self.png, "--png")
        run, digests, asked = results_named(store, self.scene, self.what)
        values = [store.get(digest) for digest in digests]
        if self.png:
            from ss_flow.flows.view.artifact import around_of, artifact_picture

            around = around_of(store, run or latest_run(store, self.scene))
            if around.cameras is not None and not 0 <= self.view < len(around.cameras.names):
                last = len(around.cameras.names) - 1
                raise InputError(f"--view {self.view} is out of range; the run has views 0 to {last}.")
            picture = artifact_picture(values[0] if len(values) == 1 else values, around, self.view)
            self.png.parent.mkdir(parents=True, exist_ok=True)
            self.png.write_bytes(picture)
        out = console(json=False)
        if run and (other := not_latest(run, latest_run(store, self.scene))):
            out.print(escape(other))
        for line in told(values, digests, store, run, asked):
            out.print(escape(line))
        if self.png:
            out.print(escape(f"drawn to {self.png}"))
        return 0


def results_named(store: Store, scene: Path | None, what: str) -> tuple[Run | None, list[str], list[dict[str, Any]]]:
    """The latest run that has a step or result, its digests, and the nodes that gave them; or of what a digest begins.

    Raises InputError when there is nothing of this name, or several things.
    """
    run, nodes = run_with(store, scene, what)
    if run:
        nodes.sort(key=lambda node: [int(t) if t.isdecimal() else t for t in re.split(r"(\d+)", node["item"])])
        outputs = [digest for node in nodes for digest in node["outputs"]]
        return run, run.results().get(what) or outputs, nodes
    found = store.find(what)
    if len(found) == 1:
        return None, found, []
    problem = f"stands for {len(found)} results" if found else "is neither a step of the latest runs nor a digest"
    raise InputError(f"{what!r} {problem}; `ss-flow cache ls` lists what there is.")


def latest_run(store: Store, scene: Path | None) -> Run:
    """The latest run of a scene, or of any. Raises InputError when there is none."""
    return runs_to_ask(store, scene)[0]
