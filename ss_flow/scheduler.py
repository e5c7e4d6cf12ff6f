"""The scheduler: one loop that resolves the nodes of flows, reusing whatever the store holds.

A node is ready when its inputs are known; its key is then known too, and is either a hit or a job. Jobs are submitted
under resource tokens, those of earlier flows first, and of one flow the longest path to the end first. The same key is
never computed twice at once: not by two nodes of this process (they share the job), not by two processes (the second
waits for the first one's record).
"""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from dataclasses import dataclass
from typing import Any

from ss_flow.cache.claims import Claims
from ss_flow.cache.errors import Gone, StoreFailure
from ss_flow.cache.store import Action, Store
from ss_flow.errors import InputError
from ss_flow.events import Reporter
from ss_flow.execute import Invocation
from ss_flow.executors import Executor
from ss_flow.executors.worker import WorkerDied
from ss_flow.explain import first_difference
from ss_flow.graph import Call, Expand, Flow, Gather, Item, Node, Stored, sources_of
from ss_flow.jobs import Job, Queue, Tokens
from ss_flow.keys import Components, Keys, Value
from ss_flow.task import Resources

POLL_SECONDS = 0.2
OUT_OF_MEMORY = (WorkerDied, MemoryError)
"""A call that ends like this is tried once more, with nothing beside it: most likely memory ran out."""


@dataclass(frozen=True)
class Failure:
    """The value of a node that has none: it failed, or something it needs did."""

    label: str
    """The node that failed first."""
    error: BaseException


@dataclass(frozen=True)
class Listening:
    """What the scheduler knows of a flow besides its nodes."""

    reporter: Reporter
    previous: Callable[[str], str | None]
    """For `why`: the key under which a label's result was found the last time."""


class Scheduler:
    """Resolves flows against a store, once.

    flows: in the order of their importance. memory_is_strict: refuse a task that declares more memory than `capacity`,
    instead of running it alone. dry: compute no job; report what would run.
    """

    def __init__(
        self,
        store: Store,
        claims: Claims,
        executor: Executor,
        capacity: Resources,
        flows: Mapping[Flow, Listening],
        *,
        memory_is_strict: bool = False,
        dry: bool = False,
    ) -> None:
        self._store = store
        self._claims = claims
        self._executor = executor
        self._capacity = capacity
        self._flows = flows
        self._importance = {flow: position for position, flow in enumerate(flows)}
        self._memory_is_strict = memory_is_strict
        self._dry = dry
        self._keys = Keys()
        self._tokens = Tokens(capacity)
        self._values: dict[Node, Value | Failure] = {}
        self._unresolved: dict[Node, int] = {}
        self._known_calls = 0
        self._consumers: dict[Node, list[Node]] = defaultdict(list)
        self._ranks: dict[Node, int] = {}
        self._expanded: dict[Node, Node] = {}
        self._ready: list[Node] = []
        self._jobs: dict[str, Job] = {}
        self._queue = Queue()
        self._claimed_elsewhere: dict[str, Job] = {}
        self._running: dict[Future[Action], Job] = {}
        self._awaited: dict[Node, list[Callable[[], None]]] = defaultdict(list)
        self.failures: dict[Flow, list[Failure]] = {flow: [] for flow in flows}
        """Nodes that failed of themselves, in order."""

    def run(self, targets: Mapping[Flow, Sequence[Node]], done: Callable[[Flow], None] = lambda flow: None) -> None:
        """Resolve the targets and all they need, and nothing else. done: called when all those of a flow are settled.

        Raises Gone when an object turned out to be missing or damaged: what made it must run again, so start anew.
        Raises StoreFailure when the store cannot be used. Either way, `drain` before leaving.
        """
        left = len(targets)

        def settle_one(flow: Flow, missing: list[int]) -> None:
            nonlocal left
            missing[0] -= 1
            if missing[0] == 0:
                left -= 1
                done(flow)

        for flow, nodes in targets.items():
            missing = [len(nodes) + 1]
            settle_one(flow, missing)
            for node in nodes:
                self._awaited[node].append(lambda flow=flow, missing=missing: settle_one(flow, missing))
                self._need(node)
        while left:
            while self._ready:
                self._resolve(self._ready.pop())
            self._submit()
            if self._running or self._claimed_elsewhere:
                self._collect()
            elif left and not self._ready:
                raise RuntimeError("the flow waits for itself: a node depends on what it expands to")

    def drain(self) -> None:
        """Wait for what runs; whatever finishes is recorded, and nothing new starts."""
        wait(self._running)
        for future in list(self._running):
            job = self._running.pop(future)
            self._claims.release(job.key)
            if not future.cancelled() and future.exception() is None:
                self._complete(job, future.result(), "finished")

    def value(self, node: Node) -> Value | Failure:
        """What a target came to."""
        return self._values[node]

    def running(self) -> list[str]:
        """Labels of the nodes that are computed now."""
        return [job.nodes[0].label for job in self._running.values()]

    def progressed(self, key: str, done: int, total: int, note: str) -> None:
        """A call is so far; from any thread."""
        if (job := self._jobs.get(key)) is not None:
            for node in list(job.nodes):
                self._flows[node.flow].reporter.progressed(node.label, done, total, note)

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
        for told in self._awaited.pop(node, ()):
            told()

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
        return _flattened(self._values[row[node.position]] for row in whole)

    def _expand(self, node: Expand, values: Sequence[Any]) -> None:
        arguments = [self._store.get(v) if node.loads and isinstance(v, str) else len(v) for v in values]
        with node.flow.building(node.item):
            inner = node.build(*arguments)
        self._expanded[node] = inner
        self._need(inner)
        self._await(node, [inner])

    def _call(self, node: Call) -> None:
        inputs: dict[str, Any] = {name: self._values[source] for name, source in node.inputs.items()}
        key = self._keys.key(node.task, inputs, node.parameters)
        if key in self._jobs:
            self._jobs[key].nodes.append(node)
            return
        action = self._store.action(key)
        if action is not None:
            self._finish(node, action, "hit")
            return
        parts = self._keys.components(node.task, inputs, node.parameters)
        why = self._why(node, key, parts)
        if self._dry:
            self._tell("would run", node, key=key, why=why)
            self._settle(node, Failure(node.label, RuntimeError("not run")))
            return
        recipe = self._keys.recipe(node.task)
        self._store.put_closure(recipe.components["code"], recipe.closure)
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
            store=self._store.location,
        )
        job = Job(invocation, [node], why, (self._importance[node.flow], -self._rank(node)))
        self._jobs[key] = job
        needed, most = invocation.resources.memory_mb, self._capacity.memory_mb
        if self._memory_is_strict and needed > most:
            self._fail(job, InputError(f"{node.label} needs {needed} MB of memory, but the run may use {most} MB."))
            return
        self._queue.push(job)

    def _why(self, node: Call, key: str, parts: Components) -> str:
        known = self._flows[node.flow].previous(node.label)
        if known is None:
            return "never computed for this scene"
        before = self._store.action(known, whole=False)
        if before is None or known == key:
            return "its result is no longer in the store"
        old = {**before.components, "code": self._store.closure(before.components["code"])}
        return first_difference(old, {**parts, "code": self._keys.recipe(node.task).closure})

    def _rank(self, node: Node) -> int:
        """The longest path from a node to a target, in nodes, as far as it is known when first asked."""
        pending = [node]
        while pending:
            current = pending[-1]
            consumers = self._consumers.get(current, [])
            unranked = [c for c in consumers if c not in self._ranks]
            if unranked:
                pending.extend(unranked)
            else:
                self._ranks[pending.pop()] = 1 + max((self._ranks[c] for c in consumers), default=0)
        return self._ranks[node]

    def _submit(self) -> None:
        """Hand out what fits into the tokens that are left."""
        while (job := self._queue.pop(self._tokens)) is not None:
            if not self._claims.take(job.key):
                if job.key not in self._claimed_elsewhere:
                    self._tell("waiting", job.nodes[0], key=job.key, because="another process is computing it")
                self._claimed_elsewhere[job.key] = job
                continue
            if (action := self._store.action(job.key)) is not None:  # finished between the look-up and the claim
                self._claims.release(job.key)
                self._complete(job, action, "hit")
                continue
            self._tokens.take(job, waiting=len(self._queue))
            self._tell("started", job.nodes[0], key=job.key, why=job.why)
            self._running[self._executor.submit(job.invocation)] = job

    def _collect(self) -> None:
        """Wait for something to happen, and settle it."""
        timeout = POLL_SECONDS if self._claimed_elsewhere else None
        if self._running:
            done, _ = wait(self._running, timeout=timeout, return_when=FIRST_COMPLETED)
        else:
            done = set()
            time.sleep(POLL_SECONDS)
        for future in done:
            job = self._running.pop(future)
            self._tokens.give_back(job)
            self._claims.release(job.key)
            error = future.exception()
            if error is None:
                self._complete(job, future.result(), "finished")
            elif isinstance(error, Gone | StoreFailure):
                raise error
            elif isinstance(error, OUT_OF_MEMORY) and not job.alone:
                job.alone = True
                self._tell("retried", job.nodes[0], key=job.key, because=_described(error))
                self._queue.push(job)
            else:
                self._fail(job, error)
        elsewhere, self._claimed_elsewhere = self._claimed_elsewhere, {}
        for job in elsewhere.values():
            if (action := self._store.action(job.key)) is not None:
                self._complete(job, action, "hit")
            elif self._claims.take(job.key):  # whoever held it has gone without a result
                self._claims.release(job.key)
                self._queue.push(job)
            else:
                self._claimed_elsewhere[job.key] = job

    def _complete(self, job: Job, action: Action, kind: str) -> None:
        del self._jobs[job.key]
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

    def _fail(self, job: Job, error: BaseException) -> None:
        del self._jobs[job.key]
        failures = {node.flow: Failure(node.label, error) for node in reversed(job.nodes)}
        for flow, failure in failures.items():
            self.failures[flow].append(failure)
        for node in job.nodes:
            failure, bad_input = failures[node.flow], isinstance(error, InputError)
            self._tell("failed", node, key=job.key, error=_described(error), bad_input=bad_input)
            self._settle(node, failure)

    def _tell(self, kind: str, node: Node, **details: Any) -> None:
        self._flows[node.flow].reporter.event(
            kind, label=node.label, step=node.step, item=node.item, known=self._known_calls, **details
        )


def _described(error: BaseException) -> str:
    return f"{type(error).__name__}: {error}"


def _flattened(values: Iterable[Any]) -> tuple[str, ...]:
    """Digests of single artifacts and of lists, as one list."""
    return tuple(d for value in values for d in ((value,) if isinstance(value, str) else value))
