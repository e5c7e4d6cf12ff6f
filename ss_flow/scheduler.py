"""The scheduler: one loop that makes the calls of flows, reusing whatever the store holds.

A node is ready when its inputs are known; its key is then known too, and is either a hit or a job. Jobs are submitted
under resource tokens, those of earlier flows first, and of one flow the longest path to the end first. The same key is
never computed twice at once: not by two nodes of this process (they share the job), not by two processes (the second
waits for the first one's record).
"""

from __future__ import annotations

import functools
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from dataclasses import dataclass, replace
from typing import Any

from ss_flow.cache.canonical import digests_of
from ss_flow.cache.claims import Claims
from ss_flow.cache.errors import Gone, StoreFailure
from ss_flow.cache.store import Action, Store
from ss_flow.errors import ExecutorLost, InputError
from ss_flow.events import Reporter
from ss_flow.execute import Invocation, reference_to
from ss_flow.executors import Executor
from ss_flow.executors.worker import WorkerDied
from ss_flow.explain import changed_items, part_of, since_last
from ss_flow.graph import Call, Flow, Node, Stored
from ss_flow.jobs import Job, Queue, Tokens
from ss_flow.kept_closures import kept_closure
from ss_flow.keys import Components, Keys, Value
from ss_flow.resolution import Failure, NotRun, Resolution
from ss_flow.task import Resources

POLL_SECONDS = 0.2
OUT_OF_MEMORY = (WorkerDied, MemoryError)
"""A call that ends like this is tried once more, with nothing beside it: most likely memory ran out."""


@dataclass(frozen=True)
class Listening:
    """What the scheduler knows of a flow besides its nodes."""

    reporter: Reporter
    previous: Callable[[str], Sequence[str]]
    """For `why`: the keys under which a label's results were found the last time."""


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
        self._keys = Keys(functools.partial(kept_closure, folder=store.closures))
        self._tokens = Tokens(capacity)
        self._graph = Resolution(store.get, self._call, self._skip, self._fail_node, self._take)
        self._jobs: dict[str, Job] = {}
        self._queue = Queue()
        self._claimed_elsewhere: dict[str, Job] = {}
        self._running: dict[Future[Action], Job] = {}
        self._told: set[Reporter] = set()
        """Who was told something since the last pause."""
        self.failures: dict[Flow, list[Failure]] = {flow: [] for flow in flows}
        """Nodes that failed of themselves, in order."""

    def run(self, targets: Mapping[Flow, Sequence[Node]], done: Callable[[Flow], None]) -> None:
        """Resolve the targets and all they need, and nothing else. done: called when all those of a flow are settled.

        Raises Gone when an object turned out to be missing or damaged: what made it must run again, so start anew.
        Raises StoreFailure when the store cannot be used, ExecutorLost when nobody runs the calls any more. Either way,
        `drain` before leaving.
        """
        left = len(targets)

        def count_down(flow: Flow, missing: list[int]) -> None:
            nonlocal left
            missing[0] -= 1
            if missing[0] == 0:
                left -= 1
                done(flow)

        for flow, nodes in targets.items():
            missing = [len(nodes) + 1]  # one more, so that a flow without targets ends too
            count_down(flow, missing)
            for node in nodes:
                self._graph.need(node, functools.partial(count_down, flow, missing))
        while left:
            self._graph.resolve_ready()
            self._submit()
            if self._running or self._claimed_elsewhere:
                self._collect()
            elif left and not self._graph.ready:
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
        return self._graph.values[node]

    def running(self) -> list[str]:
        """Labels of the nodes that are computed now."""
        return [job.nodes[0].label for job in self._running.values()]

    def progressed(self, key: str, done: int, total: int, note: str) -> None:
        """A call is so far; from any thread."""
        if (job := self._jobs.get(key)) is not None:
            for node in list(job.nodes):
                self._flows[node.flow].reporter.progressed(node.label, done, total, note)

    def _skip(self, node: Call, failed: Failure) -> None:
        self._tell("skipped", node, because=failed.label)

    def _take(self, node: Stored) -> None:
        """No action of this run leads to these objects, so the record of the run says that they are needed."""
        digests = digests_of(node.value)
        self._store.use(digests)
        self._reporter(node).event("taken", label=node.label, outputs=digests)

    def _call(self, node: Call) -> None:
        """A call whose inputs are known is a hit, or a job."""
        inputs: dict[str, Any] = {name: self._graph.values[source] for name, source in node.inputs.items()}
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
            self._graph.settle(node, Failure(node.label, NotRun("not run")))
            return
        recipe = self._keys.recipe(node.task)
        self._store.put_part(recipe.components["code"], recipe.closure)
        for name, value in inputs.items():
            if not isinstance(value, str):
                self._store.put_part(parts["inputs"][name], value)
        invocation = Invocation(
            key=key,
            label=node.label,
            task=reference_to(node.task),
            inputs=inputs,
            parameters=node.parameters,
            components=parts,
            resources=node.task.resources,
            isolate=node.task.isolate,
            store=self._store.location,
        )
        job = Job(invocation, [node], why, (self._importance[node.flow], -self._graph.rank(node)))
        self._jobs[key] = job
        needed, most = invocation.resources.memory_mb, self._capacity.memory_mb
        if self._memory_is_strict and needed > most:
            self._fail(job, InputError(f"{node.label} needs {needed} MB of memory, but the run may use {most} MB."))
            return
        self._queue.push(job)

    def _why(self, node: Call, key: str, parts: Components) -> str:
        known = self._flows[node.flow].previous(node.label)
        if not known:
            return f"{'never computed' if self._dry else 'computed for the first time'} for this scene"
        if key in known:
            return "its result is no longer in the store"
        closure = self._keys.recipe(node.task).closure
        return since_last(known, parts, closure, self._store, functools.partial(self._changed_items, node))

    def _changed_items(self, node: Call, before: Components, name: str) -> str:
        now = self._graph.values[node.inputs[name]]
        if not isinstance(now, tuple) or name not in before["inputs"]:
            return ""
        then = part_of(self._store, before["inputs"][name])
        if not isinstance(then, list):  # it was one artifact; or what its digest stood for is no longer known
            return ""
        return changed_items(then, now, self._graph.item_names(node.inputs[name]))

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
        for reporter in self._told:
            reporter.pause()
        self._told.clear()
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
            elif isinstance(error, Gone | StoreFailure | ExecutorLost):
                raise error
            elif isinstance(error, OUT_OF_MEMORY) and not job.invocation.alone:
                job.invocation = replace(job.invocation, alone=True)
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
        details = {
            **self._about(node),
            "key": action.key,
            "outputs": list(action.outputs),
            "seconds": action.seconds,
            "peak_rss_mb": action.peak_rss_mb,
            "warnings": list(action.warnings),
            "inputs": {name: self._graph.producer(source) for name, source in node.inputs.items()},
        }
        if kind == "finished":
            details["why"] = why
        self._reporter(node).event(kind, **details)
        self._graph.settle(node, action.outputs if action.is_list else action.outputs[0])

    def _fail_node(self, node: Node, failure: Failure) -> None:
        """A node failed that is no call: nothing was computed."""
        self.failures[node.flow].append(failure)
        bad_input = isinstance(failure.error, InputError)
        self._tell("failed", node, key="", error=_described(failure.error), bad_input=bad_input)

    def _fail(self, job: Job, error: BaseException) -> None:
        del self._jobs[job.key]
        failures = {node.flow: Failure(node.label, error) for node in reversed(job.nodes)}
        for flow, failure in failures.items():
            self.failures[flow].append(failure)
        for node in job.nodes:
            failure, bad_input = failures[node.flow], isinstance(error, InputError)
            self._tell("failed", node, key=job.key, error=_described(error), bad_input=bad_input)
            self._graph.settle(node, failure)

    def _tell(self, kind: str, node: Node, **details: Any) -> None:
        self._reporter(node).event(kind, **self._about(node), **details)

    def _reporter(self, node: Node) -> Reporter:
        """Who is to be told of a node, and of the next pause."""
        reporter = self._flows[node.flow].reporter
        self._told.add(reporter)
        return reporter

    def _about(self, node: Node) -> dict[str, Any]:
        known = self._graph.known_calls[node.flow]
        of_step = known.of_step[node.step]
        return {"label": node.label, "step": node.step, "item": node.item, "of": of_step, "known": known.total}


def _described(error: BaseException) -> str:
    try:
        return f"{type(error).__name__}: {error}"
    except Exception:  # of whoever wrote that error
        return f"{type(error).__name__}, which cannot say what it is about"
