"""The engine as a whole: build a flow, run it against a store, keep a record of the run."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import psutil

from ss_flow.cache.claims import Claims
from ss_flow.cache.store import Store
from ss_flow.events import JsonLines, Reporter, Reporters
from ss_flow.executors import open_executor
from ss_flow.graph import Flow
from ss_flow.keys import Value
from ss_flow.runs import previous_keys, start_run
from ss_flow.scheduler import Failure, Scheduler
from ss_flow.task import Resources


@dataclass(frozen=True)
class Report:
    """What a run came to."""

    values: dict[str, Value | Failure]
    """The flow's outputs by name: digests, or why there are none."""
    nodes: list[dict[str, Any]]
    """One event for every node that was reached: hit, finished, failed, skipped or would run."""
    failures: list[Failure]
    run_folder: str


class _Recorder(Reporter):
    def __init__(self) -> None:
        self.nodes: list[dict[str, Any]] = []

    def event(self, kind: str, **details: Any) -> None:
        if kind in ("hit", "finished", "failed", "skipped", "would run"):
            self.nodes.append({"event": kind, **details})


def usable_cores() -> int:
    """Cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def run_flow(
    build: Callable[[], Mapping[str, Any]],
    store: Store,
    *,
    scene: str,
    header: Mapping[str, Any],
    until: str | None = None,
    jobs: int = 0,
    executor: str = "threads",
    reporter: Reporter | None = None,
    dry: bool = False,
    recorded: bool = True,
) -> Report:
    """Run what `build` describes.

    build: called in a flow; returns its outputs by name. until: run only what this output needs. jobs: how many cores
    to use, 0 = all. scene: what the run is about; runs of the same scene are compared by `why`. recorded: whether the
    run is kept among the store's runs; a question about a result need not be.
    Raises KeyError when `until` names no output, and KeyboardInterrupt when interrupted; running tasks are then told to
    stop.
    """
    jobs = jobs or usable_cores()
    flow = Flow(scene)
    with flow.building():
        outputs = dict(build())
    targets = {until: outputs[until]} if until else outputs
    runs = store.root / "roots" / "runs"
    previous = previous_keys(runs, scene)
    recorder = _Recorder()
    listeners: list[Reporter] = [recorder, *([reporter] if reporter else [])]
    folder = ""
    if recorded and not dry:
        run = start_run(runs, {"scene": scene, **header})
        listeners.append(JsonLines(run.folder / "events.jsonl"))
        folder = str(run.folder)
    told = Reporters(*listeners)
    claims = Claims(store.root / "claims")
    workers = open_executor(executor, jobs, store, told.progressed)
    capacity = Resources(cores=jobs, memory_mb=psutil.virtual_memory().available >> 20, gpus=1)
    scheduler = Scheduler(store, claims, workers, told, capacity, previous=previous, dry=dry)
    told.event("run started", scene=scene)
    try:
        outcome = scheduler.run(flow, list(targets.values()))
        told.event("run ended", failed=len(outcome.failures))
        workers.close()
    except BaseException:
        told.event("run ended", interrupted=True)
        workers.cancel()
        raise
    finally:
        claims.release_all()
        told.close()
    values = {name: outcome.values[node] for name, node in targets.items()}
    return Report(values, recorder.nodes, outcome.failures, folder)
