"""Flows: ordinary functions in which calling a task adds a node to a graph instead of running it.

For type checkers a node is the artifact that it stands for, so a flow is checked like any other function.

A node stands for one artifact, or for a list of artifacts. `each` fans a list out, `expand` lets a result decide what
comes next, `otherwise` says what stands in for a failed node, a plain sequence of nodes passed to a task is a list.
"""

from __future__ import annotations

import functools
import operator
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, TypeVar, cast, get_args, overload

if TYPE_CHECKING:
    from ss_flow.task import Task

OnError = Literal["fail", "skip"]
A = TypeVar("A")
B = TypeVar("B")
C = TypeVar("C")
D = TypeVar("D")
R = TypeVar("R")

INDEX: Sequence[int] = cast(Any, object())
"""In the place of a list of `each`: the position of the item, a plain number."""


@dataclass(eq=False)
class Node:
    """A place in the graph; its value is known only once the scheduler got to it."""

    flow: Flow
    step: str
    item: str
    """Which of the many nodes of a step this is (a frame's or an instance's name), "" for the only one."""

    @property
    def label(self) -> str:
        return f"{self.step}[{self.item}]" if self.item else self.step

    def waits_for(self) -> list[Node]:
        """The nodes that it waits for."""
        return []

    def __getitem__(self, index: int) -> Node:
        """One artifact of a list. Raises TypeError when the index is not a number."""
        try:
            index = operator.index(index)
        except TypeError:
            kind = type(index).__name__
            raise TypeError(f"an item of {self.label} is chosen by its number, not by a {kind}") from None
        return Item(self.flow, self.step, str(index), self, index)

    def __iter__(self) -> Iterator[Node]:
        """Refused: Python would take one item after the other for ever."""
        raise TypeError(f"how many items {self.label} has is known only when it runs; use `each` to go through them")


@dataclass(eq=False)
class Call(Node):
    """A task applied to nodes."""

    task: Task[..., Any]
    inputs: dict[str, Node]
    parameters: dict[str, Any]

    def waits_for(self) -> list[Node]:
        return list(self.inputs.values())


@dataclass(eq=False)
class Item(Node):
    """One artifact of a list."""

    source: Node
    index: int

    def waits_for(self) -> list[Node]:
        return [self.source]


@dataclass(eq=False)
class Pick(Node):
    """Some artifacts of a list."""

    source: Node
    positions: tuple[int, ...]

    def waits_for(self) -> list[Node]:
        return [self.source]


@dataclass(eq=False)
class Gather(Node):
    """Several artifacts as a list."""

    items: list[Node]
    on_error: OnError
    """With "skip", what failed is left out."""

    def waits_for(self) -> list[Node]:
        return self.items

    def __getitem__(self, index: int) -> Node:
        """One artifact of the list: where each is one call's single result, that call."""
        return self.items[index] if self._is_of_calls else super().__getitem__(index)

    @functools.cached_property
    def _is_of_calls(self) -> bool:
        return self.on_error == "fail" and all(isinstance(n, Call) and not n.task.returns_list for n in self.items)


@dataclass(eq=False)
class Expand(Node):
    """A node that stands for what `build` makes of the values of `sources`, once they are known."""

    sources: list[Node]
    build: Callable[..., Node]
    """Called in the flow. For `each`, with the lengths of the lists; for `expand`, with the loaded artifact."""
    loads: bool

    def waits_for(self) -> list[Node]:
        return self.sources


@dataclass(eq=False)
class Otherwise(Node):
    """What `source` comes to, or where that failed, what `build` puts in its place."""

    source: Node
    build: Callable[[], Node]

    def waits_for(self) -> list[Node]:
        return [self.source]


@dataclass(eq=False)
class Stored(Node):
    """Something that is in the store already: the result of another run."""

    value: str | tuple[str, ...]


_current: ContextVar[Flow | None] = ContextVar("current_flow", default=None)
_item: ContextVar[str] = ContextVar("current_item", default="")


def current_flow() -> Flow | None:
    """The flow that is being built in this context, if any."""
    return _current.get()


class Flow:
    """A graph of nodes. It grows while it runs, as expansions resolve."""

    @contextmanager
    def building(self, item: str = "") -> Iterator[None]:
        """Within this, calls of tasks add nodes to this flow, labelled with `item`."""
        flow_token, item_token = _current.set(self), _item.set(item)
        try:
            yield
        finally:
            _current.reset(flow_token)
            _item.reset(item_token)

    def add(self, task: Task[..., Any], args: Sequence[Any], kwargs: Mapping[str, Any]) -> Call:
        """The node of one call of a task.

        Raises TypeError when the arguments do not fit the task, an input is not a node of this flow, or a parameter is
        not plain data.
        """
        from ss_flow.own_copy import own_copy  # not above: the bare `ss-flow` does without NumPy

        given = task.arguments(args, kwargs)
        inputs: dict[str, Any] = {
            name: value if isinstance(value, Node) else _gathered_input(task, name, value)
            for name, value in given[0].items()
        }
        for name, node in inputs.items():
            if node.flow is not self:
                raise TypeError(f"the input {name} of {task.name} is a node of another flow")
        parameters = {name: own_copy(name, value, task.hints.get(name)) for name, value in given[1].items()}
        return Call(self, task.name, _item.get(), task, inputs, parameters)


def _gathered_input(task: Task[..., Any], name: str, value: Any) -> Any:
    if isinstance(value, Iterable) and not hasattr(value, "dtype"):
        return gather(list(value))
    kind = type(value).__name__
    raise TypeError(
        f'the input {name} of {task.name} is a {kind}, no node; an artifact becomes one by stored("x", store.put(it))'
    )


def nodes_by_step(outputs: Iterable[Node]) -> dict[str, list[Node]]:
    """The nodes that these need, by step, as far as is known before anything has run.

    Of a step that `each` applies to a list, the node of the whole list. Called in the flow.
    """
    found: dict[str, list[Node]] = {}
    seen: set[Node] = set()
    pending = list(outputs)
    while pending:
        node = pending.pop()
        if node in seen:
            continue
        seen.add(node)
        pending += node.waits_for()
        made = node
        if isinstance(node, Expand) and not node.loads:  # what it makes of a list shows in what it makes of one item
            (made,) = node.build(*(1 for _ in node.sources)).waits_for()
            pending += made.waits_for()
        if isinstance(made, Call):
            found.setdefault(made.step, []).append(node)
    return found


def gather(nodes: Sequence[A]) -> tuple[A, ...]:
    """A list of the artifacts of several nodes.

    Raises TypeError when one of them is not a node.
    """
    return cast(tuple[A, ...], _gathered(_nodes(nodes, "an input of a task in a flow"), "fail"))


def pick(nodes: Sequence[A], positions: Iterable[int]) -> tuple[A, ...]:
    """Some artifacts of a list, as a list: a task that gets them does not depend on the others.

    Raises TypeError when the list is no node.
    """
    if not isinstance(nodes, Node):
        raise TypeError(f"pick takes a node that stands for a list, not a {type(nodes).__name__}")
    picked = Pick(_building(), nodes.step, nodes.item, nodes, tuple(positions))
    return cast(tuple[A, ...], picked)


def _nodes(values: Iterable[Any], what: str) -> list[Any]:
    """The same, where they are nodes of the flow that is being built; what: what they are, for a message."""
    nodes = list(values)
    for node in nodes:
        if not isinstance(node, Node):
            raise TypeError(f"{what} must be a node, not {type(node).__name__}")
        if node.flow is not _building():
            raise TypeError(f"{node.label} is a node of another flow")
    return nodes


def _gathered(items: list[Any], on_error: OnError) -> Gather:
    flow = _building()
    return Gather(flow, "gather", _item.get(), items, on_error)


@overload
def each(
    a: Sequence[A], /, *, build: Callable[[A], R], names: Sequence[str] | None = None, on_error: OnError = "fail"
) -> tuple[R, ...]: ...
@overload
def each(
    a: Sequence[A], b: Sequence[B], /, *, build: Callable[[A, B], R],
    names: Sequence[str] | None = None, on_error: OnError = "fail",
) -> tuple[R, ...]: ...  # fmt: skip
@overload
def each(
    a: Sequence[A], b: Sequence[B], c: Sequence[C], /, *, build: Callable[[A, B, C], R],
    names: Sequence[str] | None = None, on_error: OnError = "fail",
) -> tuple[R, ...]: ...  # fmt: skip
@overload
def each(
    a: Sequence[A], b: Sequence[B], c: Sequence[C], d: Sequence[D], /, *, build: Callable[[A, B, C, D], R],
    names: Sequence[str] | None = None, on_error: OnError = "fail",
) -> tuple[R, ...]: ...  # fmt: skip
def each(
    *lists: Any,
    build: Callable[..., Any],
    names: Sequence[str] | None = None,
    on_error: OnError = "fail",
) -> Any:
    """Apply `build` to every item of one list, or of several lists of equal length side by side.

    lists: nodes that stand for lists, one at least, or INDEX. build: takes one node of every list, and the position of
    the item for INDEX; returns a node. names: what to call the items (say, the frames' names). on_error: with "skip",
    an item that fails is left out, and the run is degraded. Returns a node that stands for the list of the results.
    Raises TypeError when a list is no node, ValueError for another `on_error`.
    """
    flow = _building()
    if on_error not in get_args(OnError):
        raise ValueError(f"on_error is {on_error!r}; it must be one of {', '.join(get_args(OnError))}")
    sources = _nodes([one for one in lists if one is not INDEX], "what `each` goes through")
    if not sources:
        raise TypeError("each needs a list to go through; INDEX alone says no length")

    def build_list(*lengths: int) -> Node:
        if len(set(lengths)) != 1:
            raise ValueError(f"lists of different lengths side by side: {lengths}")
        if names and len(names) < lengths[0]:
            raise ValueError(f"{len(names)} names for the {lengths[0]} items of a list")
        items = []
        with flow.building():
            for index in range(lengths[0]):
                _item.set(names[index] if names else str(index))
                items.append(build(*(index if source is INDEX else source[index] for source in lists)))
        return _gathered(_nodes(items, "what `build` returns for an item"), on_error)

    return Expand(flow, "each", _item.get(), sources, build_list, loads=False)


def expand(plan: A, build: Callable[[A], R]) -> R:
    """A node whose result decides what comes next: once `plan` is known, `build` is called with it and adds nodes.

    Of a list, `build` gets the number of its items: none is loaded.
    """
    flow = _building()
    sources = _nodes([plan], "what `expand` waits for")
    node = Expand(flow, "expand", _item.get(), sources, cast(Any, build), loads=True)
    return cast(R, node)


def otherwise(node: R, build: Callable[[], R]) -> R:
    """A node for the result of `node`, or where that failed, for the result of the node that `build` adds.

    The run is then degraded.
    """
    flow = _building()
    (source,) = _nodes([node], "what `otherwise` replaces")
    return cast(R, Otherwise(flow, "otherwise", _item.get(), source, cast(Any, build)))


def stored(name: str, value: str | Sequence[str]) -> Any:
    """A node for one artifact, or a list of them, that the store holds under these digests."""
    flow = _building()
    return Stored(flow, name, _item.get(), value if isinstance(value, str) else tuple(value))


@contextmanager
def labelled(item: str) -> Iterator[None]:
    """Within this, the nodes that are added are labelled with `item`."""
    with _building().building(item):
        yield


def _building() -> Flow:
    flow = current_flow()
    if flow is None:
        raise RuntimeError("each, expand and gather belong in a flow")
    return flow
