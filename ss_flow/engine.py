"""The engine as a whole: build flows, run them against a store, keep a record of each run."""

from __future__ import annotations

import contextlib
import glob
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import psutil

from ss_flow.cache.canonical import digests_of
from ss_flow.cache.claims import Claims
from ss_flow.cache.errors import Gone, OtherVersion, StoreFailure, writing
from ss_flow.cache.store import Store
from ss_flow.control_groups import usable_cores, within_limit
from ss_flow.errors import InputError
from ss_flow.events import Record, Reporter, Reporters
from ss_flow.executors import Executor, open_executor
from ss_flow.graph import Flow, Node
from ss_flow.keys import Value
from ss_flow.resolution import Failure
from ss_flow.runs import PreviousKeys, Run, latest_runs, settled, start_run
from ss_flow.scheduler import Listening, Scheduler
from ss_flow.task import Resources

RUN_CLAIM = "run-"
"""What the claim of a living run begins with; its results are not collected."""


@dataclass(frozen=True)
class Request:
    """One flow to run."""

    build: Callable[[], Mapping[str, Any]]
    """Called in a flow; returns its outputs by name. Called again when results turn out to be damaged."""
    scene: str
    """What the run is about; runs of the same scene are compared by `why`."""
    header: Mapping[str, Any] = field(default_factory=dict)
    """What the record of the run should say besides."""
    until: str | None = None
    """Run only what this output needs."""
    reporter: Reporter | None = None
    """Hears of this flow."""
    done: Callable[[Report], None] = lambda report: None
    """Called as soon as this flow has ended. A result that it finds damaged (Gone) is made again, and then it is called
    again."""


@dataclass(frozen=True)
class Report:
    """What a run came to."""

    values: dict[str, Value | Failure]
    """The flow's outputs by name: digests, or why there are none."""
    nodes: list[dict[str, Any]]
    """One event for every node that was reached, with its time: hit, finished, failed, skipped or would run."""
    failures: list[Failure]

    def succeeded(self) -> dict[str, Value]:
        """The outputs by name. Raises the error of the first that failed."""
        return {name: self._made(name) for name in self.values}

    def one(self, name: str) -> str:
        """The digest of an output that is one artifact. Raises the output's error where it failed."""
        if isinstance(value := self._made(name), str):
            return value
        raise TypeError(f"the output {name} is a list; ask for `all` of it")

    def all(self, name: str) -> tuple[str, ...]:
        """The digests of an output that is a list. Raises the output's error where it failed."""
        if isinstance(value := self._made(name), tuple):
            return value
        raise TypeError(f"the output {name} is one artifact; ask for that `one`")

    def _made(self, name: str) -> Value:
        value = self.values[name]
        if isinstance(value, Failure):
            raise value.error
        return value


def run_flow(
    build: Callable[[], Mapping[str, Any]],
    store: Store,
    *,
    scene: str,
    header: Mapping[str, Any] | None = None,
    until: str | None = None,
    reporter: Reporter | None = None,
    **options: Any,
) -> Report:
    """Run what `build` describes: `run_flows` for one flow, and with its options."""
    return run_flows([Request(build, scene, header or {}, until, reporter)], store, **options)[0]


def run_flows(
    requests: Sequence[Request],
    store: Store,
    *,
    jobs: int = 0,
    memory_mb: int = 0,
    gpus: int | None = None,
    executor: str = "threads",
    processes: int | None = None,
    dry: bool = False,
    recorded: bool = True,
) -> list[Report]:
    """Run several flows as one graph; what they share is computed once. Earlier flows go first.

    jobs: how many cores to use, 0 = all. memory_mb: how much memory tasks may declare together, 0 = what is free. Both
    are this machine's, or those of the cluster that the executor speaks to. gpus: how many of this machine's GPUs tasks
    will use, None = one where the driver shows any. processes: the most that "mixed" starts, None = a job each.
    recorded: whether the run is kept among the store's runs; a question about a result need not be.

    Raises InputError for a negative number, or an executor that is unknown, not installed or does not answer, TypeError
    when a flow returns anything but its own nodes by name, KeyError when `until` names no output, StoreFailure when the
    store cannot be used, ExecutorLost when whoever ran the calls is gone, and KeyboardInterrupt when interrupted: what
    runs is then told to stop at its next sign of progress, and waited for; a second interrupt does not wait.
    """
    for name, number in (("jobs", jobs), ("memory_mb", memory_mb), ("gpus", gpus or 0)):
        if number < 0:
            raise InputError(f"{name} is {number}; it must be 0 or more.")
    with contextlib.ExitStack() as stack:
        claims = store.open_claims()
        stack.callback(claims.release_all)
        run = _Run(requests, store, claims)
        stack.callback(run.close)
        workers = open_executor(executor, jobs or usable_cores(), store, run.progressed, processes=processes)
        try:
            run.begin(recorded=recorded and not dry)  # only now: a run that nobody can compute leaves no record
            room = workers.capacity or _this_machine(gpus)
            capacity = replace(room, cores=jobs or room.cores, memory_mb=memory_mb or room.memory_mb)
            if not dry:
                store.sweep_temporaries()
            claims.sweep()
            while not run.attempt(workers, capacity, memory_is_strict=memory_mb > 0, dry=dry):
                pass
            workers.close()
        except BaseException as error:
            _stop(workers, run, patiently=isinstance(error, KeyboardInterrupt))
            raise
        return run.reports


def _this_machine(gpus: int | None) -> Resources:
    """What there is to use here. gpus: None = one where the driver shows any."""
    return Resources(
        cores=usable_cores(),
        memory_mb=within_limit(psutil.virtual_memory().available) >> 20,
        gpus=min(len(glob.glob("/dev/nvidia[0-9]*")), 1) if gpus is None else gpus,  # tasks use the first one
    )


def _checked(outputs: Any, flow: Flow) -> dict[str, Node]:
    """The outputs of a flow, where they are such."""
    if not isinstance(outputs, Mapping):
        raise TypeError(f"a flow must return its outputs by name, a dict of nodes, not {type(outputs).__name__}")
    for name, node in outputs.items():
        if not isinstance(node, Node):
            raise TypeError(f"the output {name} must be a node, not {type(node).__name__}; `gather` makes one of many")
        if node.flow is not flow:
            raise TypeError(f"the output {name} is a node of another flow")
    return dict(outputs)


def _stop(workers: Executor, run: _Run, *, patiently: bool) -> None:
    """Let what runs finish or keep what it has; at the next interrupt do not wait."""
    workers.cancel()
    try:
        with contextlib.suppress(StoreFailure):
            run.stop()
    except KeyboardInterrupt:
        patiently = False
    finally:
        if patiently:
            workers.close()
        else:
            workers.kill()


class _Part:
    """One request of a run: its flow, who hears of it, and what it came to."""

    def __init__(self, request: Request, store: Store) -> None:
        self.request = request
        self.record = Record(None, store.root)
        self.reporter = Reporter()
        self.previous = PreviousKeys(())
        self.is_open = False
        """Whether it has begun, and not ended."""
        self.report: Report | None = None
        self.build()

    def build(self) -> None:
        """Make its flow, and the outputs by name that are asked for."""
        self.flow = Flow()
        with self.flow.building():
            outputs = _checked(self.request.build(), self.flow)
        until = self.request.until
        self.targets = {until: outputs[until]} if until else outputs

    def begin(self, record: Record, previous: PreviousKeys) -> None:
        self.record, self.previous = record, previous
        self.reporter = Reporters(record, self.request.reporter) if self.request.reporter else record
        self.is_open = True
        self.reporter.event("run started", scene=self.request.scene)


class _Run:
    """Several requests on their way; attempted again when results of earlier runs turn out to be damaged."""

    def __init__(self, requests: Sequence[Request], store: Store, claims: Claims) -> None:
        self._store, self._claims = store, claims
        self._parts = [_Part(request, store) for request in requests]
        self._healed: set[str] = set()
        self._is_stopping = False
        self.scheduler: Scheduler | None = None

    @property
    def reports(self) -> list[Report]:
        return [part.report for part in self._parts if part.report is not None]

    def begin(self, *, recorded: bool) -> None:
        """Tell everyone that the run starts; recorded: and keep that among the store's runs."""
        runs = list(latest_runs(self._store.runs))
        number = runs[0].place[0] + 1 if runs else 1
        of_scene: dict[str, list[Run]] = {part.request.scene: [] for part in self._parts}
        for run in runs:
            of_scene.get(run.scene, []).append(run)
        previous = {scene: PreviousKeys(earlier) for scene, earlier in of_scene.items()}
        for part in self._parts:
            record = self._started(part.request, number) if recorded else part.record
            part.begin(record, previous[part.request.scene])

    def _started(self, request: Request, number: int) -> Record:
        """The record of a run that starts now; the claim says that it lives."""
        asked = {"scene": request.scene, "number": number, "until": request.until, **request.header}
        with writing(self._store.root):
            folder = start_run(self._store.runs, asked).folder
        self._claims.take(RUN_CLAIM + folder.name)
        return Record(folder / "events.jsonl", self._store.root)

    def attempt(self, workers: Executor, capacity: Resources, *, memory_is_strict: bool, dry: bool) -> bool:
        """Run to the end; False when something must be made again first."""
        if self.scheduler is not None:
            for part in self._parts:
                part.build()
        parts = {part.flow: part for part in self._parts}
        listening = {flow: Listening(part.reporter, part.previous) for flow, part in parts.items()}
        scheduler = Scheduler(
            self._store, self._claims, workers, capacity, listening, memory_is_strict=memory_is_strict, dry=dry
        )
        self.scheduler = scheduler
        damaged: list[Gone] = []

        def ended(flow: Flow) -> None:
            part = parts[flow]
            values = {name: scheduler.value(node) for name, node in part.targets.items()}
            failures = scheduler.failures[flow]
            results = {name: digests_of(value) for name, value in values.items() if not isinstance(value, Failure)}
            part.reporter.event("run ended", failed=len(failures), results=results)
            report = Report(values, settled(part.record.ended), failures)
            part.is_open = False
            if part.report is None:
                try:
                    part.request.done(report)
                except Gone as gone:  # the other flows go on
                    damaged.append(gone)
                    return
                except Exception:
                    if not self._is_stopping:  # else what ended the run is told, and the other flows are heard out
                        raise
            part.report = report

        try:
            scheduler.run({flow: list(part.targets.values()) for flow, part in parts.items()}, ended)
        except Gone as gone:
            scheduler.drain()
            damaged.append(gone)
        for one in {one.digest: one for one in damaged}.values():
            for part in self._parts:
                part.is_open = True
            self._heal(one)
            self.tell("restarted", because=str(one))
        return not damaged

    def _heal(self, gone: Gone) -> None:
        """Have something made again. Raises StoreFailure when it was made again before, or nothing here makes it."""
        # Counted by what made it: results that differ from time to time would otherwise never be the same one.
        made = (event for part in self._parts for event in part.record.ended if "outputs" in event)
        maker = next((e for e in made if gone.digest in e["outputs"]), None)
        name = f"{maker['key']}.{maker['outputs'].index(gone.digest)}" if maker else gone.digest
        if name in self._healed:
            reason = "though it was made anew; is the disk failing?" if maker else "and this run does not make it"
            raise StoreFailure(f"{gone}, {reason}; run its scene again.")
        self._healed.add(name)
        if maker and isinstance(gone, OtherVersion):
            self._store.discard(gone.digest)  # else its record would be found again
        self._store.restore(gone.digest)

    def progressed(self, key: str, done: int, total: int, note: str) -> None:
        if self.scheduler is not None:
            self.scheduler.progressed(key, done, total, note)

    def stop(self) -> None:
        """Wait for what runs to finish or to keep what it has; flows that have not ended end here."""
        self._is_stopping = True
        if self.scheduler is not None:
            self.tell("stopping", running=self.scheduler.running())
            self.scheduler.drain()
        for part in self._parts:
            if part.is_open:
                part.reporter.event("run ended", interrupted=True)

    def tell(self, kind: str, **details: Any) -> None:
        for part in self._parts:
            part.reporter.event(kind, **details)

    def close(self) -> None:
        for part in self._parts:
            with contextlib.suppress(OSError):
                part.reporter.close()
