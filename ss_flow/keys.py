"""Keys: the digest of all that a computation's result depends on, kept in parts so that a change can be named."""

from __future__ import annotations

import dataclasses
import functools
import importlib.metadata
import platform
from collections.abc import Mapping, Sequence
from typing import Any

from ss_flow.cache.canonical import digest
from ss_flow.closure import code_closure
from ss_flow.task import FileRef, Task

SCHEMA = 1
"""Raised when the meaning of keys or of stored objects changes: everything is then computed anew."""

Components = dict[str, dict[str, Any]]
Value = tuple[str, ...] | str
"""What an input resolves to: one digest, or the digests of a list."""


def components(task: Task[..., Any], inputs: Mapping[str, Value], parameters: Mapping[str, Any]) -> Components:
    """The parts of the key of one call, as plain data.

    Returns task (schema, name), code (digest by qualified name), parameters (by dotted name), inputs (digests by
    name), packages (version by name), environment (what the task declares of this machine).
    """
    flat: dict[str, Any] = {}
    for name, value in parameters.items():
        flat |= _flat("" if name == "params" else name, value)
    return {
        "task": {"schema": SCHEMA, "name": task.name},
        "code": code_closure(task.function),
        "parameters": flat,
        "inputs": {name: value if isinstance(value, str) else list(value) for name, value in inputs.items()},
        "packages": {"python": ".".join(platform.python_version_tuple()[:2])} | {n: _version(n) for n in task.uses},
        "environment": dict(task.environment()) if task.environment else {},
    }


def key_of(parts: Components) -> str:
    """The key: the digest of the parts."""
    return digest(parts)


def _flat(name: str, value: Any) -> dict[str, Any]:
    """A parameter as {dotted name: plain value}; a file counts by content alone."""
    if isinstance(value, FileRef):
        return {name: value.digest}
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        items: Any = (
            (f.name, getattr(value, f.name)) for f in dataclasses.fields(value) if f.metadata.get("key", True)
        )
    elif isinstance(value, Sequence) and not isinstance(value, str | bytes) and any(map(_is_nested, value)):
        items = ((str(i), item) for i, item in enumerate(value))
    else:
        digest(value)  # refuses a type that has no canonical form, here where the parameter's name is known
        return {name: _plain(value)}
    flat: dict[str, Any] = {}
    for inner, item in items:
        flat |= _flat(f"{name}.{inner}" if name else inner, item)
    return flat


def _plain(value: Any) -> Any:
    """A value as JSON gives it back, so that a key's parts compare equal after being stored."""
    return [_plain(item) for item in value] if isinstance(value, tuple | list) else value


def _is_nested(value: Any) -> bool:
    return dataclasses.is_dataclass(value) and not isinstance(value, type)


@functools.cache
def _version(distribution: str) -> str:
    try:
        return importlib.metadata.version(distribution)
    except importlib.metadata.PackageNotFoundError:
        return "absent"
