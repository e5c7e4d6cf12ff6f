"""Keys: the digest of all that a computation's result depends on, kept in parts so that a change can be named."""

from __future__ import annotations

import dataclasses
import functools
import platform
import types
import typing
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ss_flow.cache.canonical import digest
from ss_flow.closure import Closure, closure_of, fix_sources
from ss_flow.distributions import Changes, version, versions_of
from ss_flow.task import FileRef, Task

SCHEMA = 3
"""Raised when the meaning of keys or of stored objects changes: everything is then computed anew."""

_SIMPLE = (str, int, float, bool, type(None))
_PLAIN = (*_SIMPLE, bytes)
Components = dict[str, Any]
Value = tuple[str, ...] | str
"""What an input resolves to: one digest, or the digests of a list."""


@dataclass(frozen=True)
class Recipe:
    """What all calls of a task have in common."""

    components: Components
    """task (schema, name), code (the digest of `closure`), packages (version by name, of all that the code imports),
    environment (what the task declares of this machine)."""
    closure: dict[str, str]
    """Digests of the definitions that the task depends on, by qualified name."""
    digest: str

    @classmethod
    def of(cls, task: Task[..., Any], closure: Closure | None = None, changes: Changes = ()) -> Recipe:
        """closure: of the task's function, where it is known already. changes: see `versions_of`."""
        closure = closure or closure_of(task.function)
        packages = {name: version(name) for name in task.uses}
        for module in sorted(closure.modules):
            packages |= versions_of(module, changes)
        parts = {
            "task": {"schema": SCHEMA, "name": task.name},
            "code": digest(closure.definitions),
            "packages": {"python": ".".join(platform.python_version_tuple()[:2])} | packages,
            "environment": dict(task.environment()) if task.environment else {},
        }
        return cls(parts, closure.definitions, digest(parts))


class Keys:
    """Makes the keys of one run. What calls share (a task's recipe, a set of parameters) is digested once.

    closure: says what the code of a function depends on.
    """

    def __init__(self, closure: Callable[[Callable[..., Any]], Closure] = closure_of) -> None:
        self._closure = closure
        self._recipes: dict[int, tuple[object, Recipe]] = {}
        self._parameters: dict[tuple[int, str, Any], tuple[object, str]] = {}
        self._lists: dict[tuple[str, ...], str] = {}

    def recipe(self, task: Task[..., Any]) -> Recipe:
        """What all calls of the task have in common."""
        if id(task) not in self._recipes:
            fix_sources()
            self._recipes[id(task)] = (task, Recipe.of(task, self._closure(task.function)))
        return self._recipes[id(task)][1]

    def key(self, task: Task[..., Any], inputs: Mapping[str, Value], parameters: Mapping[str, Any]) -> str:
        """The key of one call.

        Raises TypeError when a parameter is not plain data.
        """
        given = [
            (name, value if type(value) in _SIMPLE else self._counted(name, value, task.hints.get(name)))
            for name, value in parameters.items()
        ]
        counted = [(name, self.input(value)) for name, value in inputs.items()]
        return digest((self.recipe(task).digest, given, counted))

    def input(self, value: Value) -> str:
        """What an input counts as: the digest of an artifact, or that of a list of such digests."""
        if isinstance(value, str):
            return value
        if value not in self._lists:
            self._lists[value] = digest(value)
        return self._lists[value]

    def components(
        self, task: Task[..., Any], inputs: Mapping[str, Value], parameters: Mapping[str, Any]
    ) -> Components:
        """All that the key of one call is made from, as plain data: those of the recipe, parameters (by dotted name)
        and inputs (a digest by name, also for a list, so that its length does not count in every record)."""
        flat: dict[str, Any] = {}
        for name, value in parameters.items():
            fields = getattr(value, "__dataclass_fields__", {})
            bare = name == "params" and not parameters.keys() & fields.keys()  # else one would hide the other
            flat |= _flat("" if bare else name, value, task.hints.get(name))
        return {
            **self.recipe(task).components,
            "parameters": flat,
            "inputs": {name: self.input(value) for name, value in inputs.items()},
        }

    def _counted(self, name: str, value: Any, hint: Any) -> Any:
        if isinstance(value, np.generic):
            return value.item()
        if not dataclasses.is_dataclass(value):
            return digest(_flat(name, value, hint))
        known = (id(value), name, hint)
        if known not in self._parameters:  # kept together with the value, so that its id is not used again
            self._parameters[known] = (value, digest(_flat(name, value, hint)))
        return self._parameters[known][1]


def _flat(name: str, value: Any, hint: Any) -> dict[str, Any]:
    """A parameter as {dotted name: plain value}; a file counts by content alone.

    hint: its declared type. Where that does not tell a dataclass's class, or no field would, the class counts too, and
    its code where the declared type does not name it: the task's own code then does not lead there.
    """
    if isinstance(value, FileRef):
        return {name: value.digest}
    flat: dict[str, Any] = {}
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        kind = type(value)
        counted = [f.name for f in dataclasses.fields(value) if f.metadata.get("key", True)]
        items: Any = [(field, getattr(value, field), _hints(kind).get(field)) for field in counted]
        declared = [typing.get_origin(one) or one for one in _candidates(hint)]
        if not items or declared != [kind]:
            flat[name or "params"] = f"{kind.__module__}.{kind.__qualname__}"
        if kind not in declared:
            flat[name or "params"] += f" (code {digest(closure_of(kind).definitions)[:32]})"
    elif isinstance(value, Sequence) and not isinstance(value, str | bytes) and any(map(_is_nested, value)):
        items = [(str(i), item, _hint_of_item(hint, i)) for i, item in enumerate(value)]
    else:
        return {name: _plain(name, value)}
    for inner, item, inner_hint in items:
        flat |= _flat(f"{name}.{inner}" if name else inner, item, inner_hint)
    return flat


def _candidates(hint: Any) -> list[Any]:
    """What a value of a declared type may be, besides plain values."""
    among = typing.get_args(hint) if typing.get_origin(hint) in (typing.Union, types.UnionType) else (hint,)
    return [one for one in among if one not in _PLAIN and typing.get_origin(one) is not typing.Literal]


def _hint_of_item(hint: Any, index: int) -> Any:
    for one in _candidates(hint):
        among = typing.get_args(one)
        if typing.get_origin(one) is not tuple or among[1:] == (...,):
            index = 0
        return among[index] if index < len(among) else None
    return None


@functools.cache
def _hints(kind: type) -> dict[str, Any]:
    """The declared types of a dataclass's fields; none where one of them is not known at run time."""
    try:
        return typing.get_type_hints(kind)
    except NameError:
        return {}


def _plain(name: str, value: Any) -> Any:
    """A value as JSON gives it back, so that a key's parts compare equal after being stored."""
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, tuple | list):
        return [_plain(name, item) for item in value]
    if isinstance(value, Mapping) and all(isinstance(key, str) for key in value):
        return {key: _plain(name, item) for key, item in value.items()}
    if isinstance(value, _SIMPLE):
        return value
    raise TypeError(f"the parameter {name} holds a {type(value).__name__}, which is not plain data; make it an input")


def _is_nested(value: Any) -> bool:
    return dataclasses.is_dataclass(value) and not isinstance(value, type)
