"""Resolving a graph that grows: which nodes are ready, and what each comes to."""

from __future__ import annotations

import functools
from collections import Counter, defaultdict, deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

from ss_flow.cache.canonical import digests_of
from ss_flow.graph import Call, Expand, Flow, Gather, Item, Node, Otherwise, Pick, Stored
from ss_flow.keys import Value


@dataclass(frozen=True)
class Failure:
    """The value of a node that has none: it failed, or something it needs did."""

    label: str
    """The node that failed first."""
    error: BaseException


@dataclass
class KnownCalls:
    """How many calls of a flow are needed, as far as the graph is known."""

    total: int = 0
    of_step: Counter[str] = field(default_factory=Counter)


class NotRun(RuntimeError):
    """Why a node has no result in a dry run: nothing went wrong."""


class Resolution:
    """The values of nodes, as they become known.

    load: gives the artifact of a digest, for what decides how the graph goes on. call: gets a call whose inputs are
    known; it must be settled sooner or later. skipped: hears of a call that cannot be made, and why. failed: hears of
    a node that cannot be expanded, or picks what its list does not have. taken: hears of a result of another run.
    """

    def __init__(
        self,
        load: Callable[[str], Any],
        call: Callable[[Call], None],
        skipped: Callable[[Call, Failure], None],
        failed: Callable[[Node, Failure], None],
        taken: Callable[[Stored], None],
    ) -> None:
        self._load, self._call, self._skipped, self._failed, self._taken = load, call, skipped, failed, taken
        self.values: dict[Node, Value | Failure] = {}
        self.known_calls: dict[Flow, KnownCalls] = defaultdict(KnownCalls)
        self._unresolved: dict[Node, int] = {}
        self._consumers: dict[Node, list[Node]] = defaultdict(list)
        self._awaited: dict[Node, list[Callable[[], None]]] = defaultdict(list)
        self._expanded: dict[Node, Node] = {}
        self._ranks: dict[Node, int] = {}
        self._ready: deque[Node] = deque()
        self._any_failed = False

    def need(self, node: Node, settled: Callable[[], None] | None = None) -> None:
        """Resolve this node too, and all that it needs. settled: called when it is."""
        if settled is not None:
            self._awaited[node].append(settled)
        pending = [node]
        while pending:
            node = pending.pop()
            if node in self._unresolved:
                continue
            if isinstance(node, Call):
                known = self.known_calls[node.flow]
                known.total += 1
                known.of_step[node.step] += 1
            sources = list(dict.fromkeys(node.waits_for()))
            self._await(node, sources)
            pending.extend(sources)

    @property
    def ready(self) -> bool:
        """Whether there is a node whose sources are settled."""
        return bool(self._ready)

    def resolve_ready(self) -> None:
        """Go as far as is possible without another result."""
        while self._ready:
            self._resolve(self._ready.popleft())

    def settle(self, node: Node, value: Value | Failure) -> None:
        """A node has come to this."""
        self.values[node] = value
        self._any_failed = self._any_failed or isinstance(value, Failure)
        for consumer in self._consumers.pop(node, ()):
            self._unresolved[consumer] -= 1
            if self._unresolved[consumer] == 0:
                self._ready.append(consumer)
        for settled in self._awaited.pop(node, ()):
            settled()

    def rank(self, node: Node) -> int:
        """The longest path from a node to a target, in nodes, as far as it is known when first asked."""
        pending = [node]
        while pending:
            current = pending[-1]
            self._ranks.setdefault(current, 0)  # meanwhile: a node that waits for itself would be ranked for ever
            consumers = self._consumers.get(current, [])
            unranked = [c for c in consumers if c not in self._ranks]
            if unranked:
                pending.extend(unranked)
            else:
                self._ranks[pending.pop()] = 1 + max((self._ranks[c] for c in consumers), default=0)
        return self._ranks[node]

    def producer(self, node: Node) -> str:
        """The step whose result a node's value is (seen through lists and expansions)."""
        while not isinstance(node, Call):
            if isinstance(node, Gather) and node.items:
                node = node.items[0]
            elif sources := [self._expanded[node]] if node in self._expanded else node.waits_for():
                node = sources[0]
            else:
                return node.step
        return node.step

    def item_names(self, node: Node) -> list[str]:
        """What the items of a node's list are called: as the nodes that they come from, or else by their numbers."""
        while node in self._expanded:
            node = self._expanded[node]
        value = self.values[node]
        assert isinstance(value, tuple)
        names: list[str] = []
        if isinstance(node, Gather):
            names = [item.item for item in self._whole(node)]
        elif isinstance(node, Pick):
            among = self.item_names(node.source)
            names = [among[position] for position in node.positions]
        return names if len(names) == len(value) and all(names) else [str(index) for index in range(len(value))]

    def _await(self, node: Node, sources: Sequence[Node]) -> None:
        missing = [source for source in sources if source not in self.values]
        for source in missing:
            self._consumers[source].append(node)
        self._unresolved[node] = len(missing)
        if not missing:
            self._ready.append(node)

    def _resolve(self, node: Node) -> None:
        match node:
            case Call():
                if (failed := self._failed_source(node)) is None:
                    self._call(node)
                else:
                    self._skipped(node, failed)
                    self.settle(node, failed)
            case Item():
                chosen = self._chosen(node, node.source, (node.index,))
                self.settle(node, chosen if isinstance(chosen, Failure) else chosen[0])
            case Pick():
                self.settle(node, self._chosen(node, node.source, node.positions))
            case Gather():
                self.settle(node, self._gathered(node))
            case Expand():
                if node in self._expanded:
                    self.settle(node, self.values[self._expanded[node]])
                elif (failed := self._failed_source(node)) is not None:
                    self.settle(node, failed)
                else:
                    self._expand(node)
            case Otherwise():
                value = self.values[node.source]
                if node in self._expanded:
                    self.settle(node, self.values[self._expanded[node]])
                elif isinstance(value, Failure) and not isinstance(value.error, NotRun):
                    self._replace(node, node.build)
                else:
                    self.settle(node, value)
            case Stored():
                self._taken(node)
                self.settle(node, node.value)

    def _failed_source(self, node: Node) -> Failure | None:
        if self._any_failed:
            for source in node.waits_for():
                if isinstance(value := self.values[source], Failure):
                    return value
        return None

    def _chosen(self, node: Node, source: Node, positions: Sequence[int]) -> tuple[str, ...] | Failure:
        """Some items of a list."""
        value = self.values[source]
        if isinstance(value, Failure):
            return value
        if isinstance(value, str):
            return self._fail(node, TypeError(f"{node.label} is of a list, but its source is a single artifact"))
        for position in positions:
            if not -len(value) <= position < len(value):
                said = f"item {position} is not among the {len(value)} items of {source.label}"
                return self._fail(node, IndexError(said))
        return tuple(value[position] for position in positions)

    def _fail(self, node: Node, error: Exception) -> Failure:
        failure = Failure(node.label, error)
        self._failed(node, failure)
        return failure

    def _gathered(self, node: Gather) -> Value | Failure:
        whole = self._whole(node)
        if len(whole) < len(node.items):
            failures = [value for item in node.items if isinstance(value := self.values[item], Failure)]
            if node.on_error == "fail" or not whole:
                return failures[0]
            for failure in failures:
                if isinstance(failure.error, NotRun):
                    return failure
        values: list[Any] = [self.values[item] for item in whole]
        return tuple(digest for value in values for digest in digests_of(value))

    def _whole(self, node: Gather) -> list[Node]:
        """The items that did not fail."""
        return [item for item in node.items if not isinstance(self.values[item], Failure)]

    def _expand(self, node: Expand) -> None:
        values: list[Any] = [self.values[source] for source in node.sources]
        if not node.loads and any(isinstance(v, str) for v in values):
            error = TypeError(f"{node.label} goes through a list, but what it was given is a single artifact")
            return self.settle(node, self._fail(node, error))
        arguments = [self._load(v) if isinstance(v, str) else len(v) for v in values]
        self._replace(node, functools.partial(node.build, *arguments))

    def _replace(self, node: Node, build: Callable[[], Node]) -> None:
        """Let a node come to what the node that `build` adds comes to; it fails where that cannot be added."""
        try:
            with node.flow.building(node.item):
                inner = build()
                if not isinstance(inner, Node):
                    raise TypeError(f"what {node.label} builds must be a node, not {type(inner).__name__}")
        except Exception as error:  # the other flows go on
            self.settle(node, self._fail(node, error))
            return
        self._expanded[node] = inner
        self.need(inner)
        self._await(node, [inner])
