"""The scheduler: one loop that resolves a flow's nodes, reusing whatever the store holds.

A node is ready when its inputs are known; its key is then known too, and is either a hit or a job. Jobs are submitted
under resource tokens, longest path to the end first. The same key is never computed twice at once: not by two nodes of
this process (they share the job), not by two processes (the second waits for the first one's record).
"""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from dataclasses import dataclass, field, replace
from typing import Any

from ss_flow.cache.claims import Claims
from ss_flow.cache.store import Action, Store
from ss_flow.errors import InputError
from ss_flow.events import Reporter
from ss_flow.execute import Invocation
from ss_flow.executors import Executor
from ss_flow.executors.worker import WorkerDied
from ss_flow.explain import first_difference
from ss_flow.graph import Call, Expand, Flow, Gather, Item, Node, Stored, sources_of
from ss_flow.keys import Value, components, key_of
from ss_flow.task import Resources

POLL_SECONDS = 0.2
RETRIED = (WorkerDied,)
"""A call that ends like this is tried once more: its process may have fallen to something outside it."""


@dataclass(frozen=True)
class Failure:
    """The value of a node that has none: it failed, or something it needs did."""

    label: str
    """The node that failed first."""
    error: BaseException


@dataclass
class Job:
    """One key to compute, for one or more nodes."""

    invocation: Invocation
    nodes: list[Call]
    why: str
    tries: int = 0


@dataclass
class Outcome:
    """What a run came to."""

    values: dict[Node, Value | Failure]
    failures: list[Failure] = field(default_factory=list)
    """Nodes that failed of themselves, in order."""


class Scheduler:
    """Runs flows against a store. One instance runs one flow.

    previous: for `why`, the key under which each label's result was found the last time.
    dry: compute no job; report what would run.
    """

    def __init__(
        self,
        store: Store,
        claims: Claims,
        executor: Executor,
        reporter: Reporter,
        capacity: Resources,
        *,
        previous: Mapping[str, str],
        dry: bool = False,
    ) -> None:
        self._store = store
        self._claims = claims
        self._executor = executor
        self._reporter = reporter
        self._capacity = capacity
        self._previous = previous
        self._dry = dry
        self._values: dict[Node, Value | Failure] = {}
        self._unresolved: dict[Node, int] = {}
        self._known_calls = 0
        self._consumers: dict[Node, list[Node]] = defaultdict(list)
        self._expanded: dict[Node, Node] = {}
        self._ready: list[Node] = []
        self._jobs: dict[str, Job] = {}
        self._queued: list[str] = []
        self._claimed_elsewhere: set[str] = set()
        self._running: dict[Future[Action], str] = {}
        self._failures: list[Failure] = []

    def run(self, flow: Flow, targets: Sequence[Node]) -> Outcome:
        """Resolve the targets and all they need, and nothing else."""
        self._flow = flow
        for target in targets:
            self._need(target)
        while not all(target in self._values for target in targets):
            while self._ready:
                self._resolve(self._ready.pop())
            self._submit()
            if self._running or self._claimed_elsewhere:
                self._collect()
            elif not self._ready and not all(target in self._values for target in targets):
                raise RuntimeError("the flow waits for itself: a node depends on what it expands to")
        return Outcome({target: self._values[target] for target in targets}, self._failures)

    def producer(self, node: Node) -> str:
        """The step whose result a node's value is (seen through lists and expansions)."""
        while not isinstance(node, Call):
            if isinstance(node, Gather) and node.rows:
                node = node.rows[0][node.position]
            elif sources := [self._expanded[node]] if node in self._expanded else sources_of(node):
                node = sources[0]
            else:
                return node.step
        return node.step

    def _need(self, node: Node) -> None:
        pending = [node]
        while pending:
            node = pending.pop()
            if node in self._unresolved:
                continue
            self._known_calls += isinstance(node, Call)
            sources = list(dict.fromkeys(sources_of(node)))
            self._await(node, sources)
            pending.extend(sources)

    def _await(self, node: Node, sources: Sequence[Node]) -> None:
        missing = [source for source in sources if source not in self._values]
        for source in missing:
            self._consumers[source].append(node)
        self._unresolved[node] = len(missing)
        if not missing:
            self._ready.append(node)

    def _settle(self, node: Node, value: Value | Failure) -> None:
        self._values[node] = value
        for consumer in self._consumers.pop(node, ()):
            self._unresolved[consumer] -= 1
            if self._unresolved[consumer] == 0:
                self._ready.append(consumer)

    def _resolve(self, node: Node) -> None:
        """Settle a node whose sources are settled, or make it a job."""
        if node in self._expanded:
            self._settle(node, self._values[self._expanded[node]])
            return
        values = [self._values[source] for source in sources_of(node)]
        failed = next((value for value in values if isinstance(value, Failure)), None)
        if isinstance(node, Gather):
            self._settle(node, self._gathered(node, failed))
            return
        match node:
            case _ if failed is not None:
                if isinstance(node, Call):
                    self._tell("skipped", node, because=failed.label)
                self._settle(node, failed)
            case Item():
                value = values[0]
                assert isinstance(value, tuple), f"{node.label} is one of a list, but its source is a single artifact"
                self._settle(node, value[node.index])
            case Stored():
                self._settle(node, node.value)
            case Expand():
                self._expand(node, values)
            case Call():
                self._call(node)

    def _gathered(self, node: Gather, failed: Failure | None) -> Value | Failure:
        whole = [row for row in node.rows if not any(isinstance(self._values[n], Failure) for n in row)]
        if failed is not None and (node.on_error == "fail" or not whole):
            return failed
        return _flattened([self._values[row[node.position]] for row in whole])

    def _expand(self, node: Expand, values: Sequence[Any]) -> None:
        arguments = [self._store.get(v) if node.loads and isinstance(v, str) else len(v) for v in values]
        with self._flow.building(node.item):
            inner = node.build(*arguments)
        self._expanded[node] = inner
        self._need(inner)
        self._await(node, [inner])

    def _call(self, node: Call) -> None:
        inputs: dict[str, Any] = {name: self._values[source] for name, source in node.inputs.items()}
        parts = components(node.task, inputs, node.parameters)
        key = key_of(parts)
        if key in self._jobs:
            self._jobs[key].nodes.append(node)
            return
        action = self._store.action(key)
        if action is not None:
            self._finish(node, action, "hit")
            return
        why = self._why(node.label, key, parts)
        if self._dry:
            self._tell("would run", node, key=key, why=why)
            self._settle(node, Failure(node.label, RuntimeError("not run")))
            return
        function = node.task.function
        invocation = Invocation(
            key=key,
            label=node.label,
            task=f"{function.__module__}:{function.__qualname__}",
            inputs=inputs,
            parameters=node.parameters,
            components=parts,
            resources=node.task.resources,
            isolate=node.task.isolate,
            store=self._store.root,
        )
        self._jobs[key] = Job(invocation, [node], why)
        self._queued.append(key)

    def _why(self, label: str, key: str, parts: Any) -> str:
        known = self._previous.get(label)
        if known is None:
            return "never computed for this scene"
        before = self._store.action(known, whole=False)
        if before is None or known == key:
            return "its result is no longer in the store"
        return first_difference(before.components, parts)

    def _submit(self) -> None:
        """Hand out what fits into the tokens that are left, the longest path to the end first."""
        if not self._queued:
            return
        ranks = self._ranks()
        self._queued.sort(key=lambda key: -max(ranks[node] for node in self._jobs[key].nodes))
        for key in list(self._queued):
            job = self._jobs[key]
            if not self._fits(job.invocation.resources):
                continue
            job.invocation = self._with_spare_cores(job.invocation)
            if not self._claims.take(key):
                if key not in self._claimed_elsewhere:
                    self._claimed_elsewhere.add(key)
                    self._tell("waiting", job.nodes[0], key=key, because="another process is computing it")
                continue
            self._claimed_elsewhere.discard(key)
            self._queued.remove(key)
            if (action := self._store.action(key)) is not None:  # it was finished between the look-up and the claim
                self._claims.release(key)
                self._complete(key, action, "hit")
                continue
            self._tell("started", job.nodes[0], key=key, why=job.why)
            self._running[self._executor.submit(job.invocation)] = key

    def _fits(self, wanted: Resources) -> bool:
        held = [self._jobs[key].invocation.resources for key in self._running.values()]
        if not held:
            return True  # what needs more than the machine has runs alone
        return all(
            sum(getattr(r, kind) for r in held) + getattr(wanted, kind) <= getattr(self._capacity, kind)
            for kind in ("cores", "memory_mb", "gpus")
        )

    def _with_spare_cores(self, invocation: Invocation) -> Invocation:
        """The last job that waits gets the cores that nobody wants."""
        wanted = invocation.resources
        if wanted.most_cores <= wanted.cores or len(self._queued) > 1:
            return invocation
        held = sum(self._jobs[key].invocation.resources.cores for key in self._running.values())
        granted = max(wanted.cores, min(wanted.most_cores, self._capacity.cores - held))
        return replace(invocation, resources=replace(wanted, cores=granted))

    def _ranks(self) -> dict[Node, int]:
        """The longest known path from each unsettled node to a target, in nodes."""
        ranks: dict[Node, int] = {}
        pending: list[Node] = [node for key in self._queued for node in self._jobs[key].nodes]
        while pending:
            node = pending[-1]
            consumers = self._consumers.get(node, [])
            unranked = [c for c in consumers if c not in ranks]
            if unranked:
                pending.extend(unranked)
            else:
                ranks[pending.pop()] = 1 + max((ranks[c] for c in consumers), default=0)
        return ranks

    def _collect(self) -> None:
        """Wait for something to happen, and settle it."""
        if self._running:
            done, _ = wait(self._running, timeout=POLL_SECONDS, return_when=FIRST_COMPLETED)
        else:
            done = set()
            time.sleep(POLL_SECONDS)
        for future in done:
            key = self._running.pop(future)
            self._claims.release(key)
            error = future.exception()
            if error is None:
                self._complete(key, future.result(), "finished")
            elif isinstance(error, RETRIED) and self._jobs[key].tries == 0:
                self._jobs[key].tries += 1
                self._queued.append(key)
            else:
                self._fail(key, error)
        for key in list(self._claimed_elsewhere):
            if (action := self._store.action(key)) is not None:
                self._claimed_elsewhere.discard(key)
                self._queued.remove(key)
                self._complete(key, action, "hit")

    def _complete(self, key: str, action: Action, kind: str) -> None:
        job = self._jobs.pop(key)
        for position, node in enumerate(job.nodes):
            self._finish(node, action, kind if position == 0 else "hit", why=job.why)

    def _finish(self, node: Call, action: Action, kind: str, why: str = "") -> None:
        self._tell(
            kind,
            node,
            key=action.key,
            outputs=list(action.outputs),
            seconds=action.seconds,
            peak_rss_mb=action.peak_rss_mb,
            warnings=list(action.warnings),
            inputs={name: self.producer(source) for name, source in node.inputs.items()},
            **({"why": why} if kind == "finished" else {}),
        )
        self._settle(node, action.outputs if action.is_list else action.outputs[0])

    def _fail(self, key: str, error: BaseException) -> None:
        job = self._jobs.pop(key)
        failure = Failure(job.nodes[0].label, error)
        self._failures.append(failure)
        for node in job.nodes:
            told = f"{type(error).__name__}: {error}"
            self._tell("failed", node, key=key, error=told, bad_input=isinstance(error, InputError))
            self._settle(node, failure)

    def _tell(self, kind: str, node: Node, **details: Any) -> None:
        known = self._known_calls
        self._reporter.event(kind, label=node.label, step=node.step, item=node.item, known=known, **details)


def _flattened(values: Sequence[Any]) -> tuple[str, ...]:
    """Digests of single artifacts and of lists, as one list."""
    return tuple(d for value in values for d in ((value,) if isinstance(value, str) else value))
