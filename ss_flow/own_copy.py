"""Parameters as a call keeps them: its own, so that nobody changes them after its key was made."""

from __future__ import annotations

import contextlib
import copy
import dataclasses
import operator
import typing
import weakref
from collections.abc import Mapping
from pathlib import PurePath
from typing import Any

import numpy as np

_PLAIN = (str, int, float, bool, type(None))
_unchanging: weakref.WeakValueDictionary[int, Any] = weakref.WeakValueDictionary()
"""Dataclasses in which nothing can be changed, by their ids: many calls share one, and it is looked through once."""


def own_copy(name: str, value: Any, hint: Any = None) -> Any:
    """A parameter as its key sees it: NumPy's scalars as numbers, mappings in the order of their names.

    hint: its declared type; where that is a tuple or a list, so is the copy: a key does not tell them apart. A
    dataclass stays what it is, but for lists, mappings and NumPy's scalars in it.
    Raises TypeError when it is neither plain data nor a frozen dataclass of such.
    """
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, _PLAIN):
        return value
    if getattr(getattr(type(value), "__dataclass_params__", None), "frozen", False):
        return _own_dataclass(name, value)
    if isinstance(value, list | tuple):
        items = [own_copy(name, item) for item in value]
        if hasattr(value, "_fields"):  # a named tuple
            return type(value)(*items)
        kind = typing.get_origin(hint) or hint
        if type(value) is tuple and kind is not list and all(map(operator.is_, items, value)):
            return value
        return kind(items) if kind in (list, tuple) else type(value)(items)
    if isinstance(value, Mapping) and all(isinstance(key, str) for key in value):
        return {key: own_copy(name, value[key]) for key in sorted(value)}
    instead = "a FileRef" if isinstance(value, PurePath) else "an input"
    kind = type(value).__name__
    raise TypeError(f"the parameter {name} holds a {kind}, no plain data and no frozen dataclass; make it {instead}")


def _own_dataclass(name: str, value: Any) -> Any:
    """The same object where nothing in it can be changed: calls that share it share its digest."""
    if _unchanging.get(id(value)) is value:
        return value
    own = value
    for field in dataclasses.fields(value):
        content = getattr(value, field.name)
        if field.metadata.get("key", True) and (inner := own_copy(f"{name}.{field.name}", content)) is not content:
            own = copy.copy(value) if own is value else own
            object.__setattr__(own, field.name, inner)
    if own is value:
        with contextlib.suppress(TypeError):  # of a class with slots
            _unchanging[id(value)] = value
    return own
