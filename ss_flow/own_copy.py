"""Parameters as a call keeps them: its own, so that nobody changes them after its key was made."""

from __future__ import annotations

import dataclasses
import typing
from collections.abc import Mapping
from typing import Any

import numpy as np

_PLAIN = (str, int, float, bool, type(None))


def own_copy(name: str, value: Any, hint: Any = None) -> Any:
    """A parameter as its key sees it: NumPy's scalars as numbers, mappings in the order of their names.

    hint: its declared type; where that is a tuple or a list, so is the copy: a key does not tell them apart. A
    dataclass stays what it is.
    Raises TypeError when it is not plain data.
    """
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, _PLAIN) or (dataclasses.is_dataclass(value) and not isinstance(value, type)):
        return value
    if isinstance(value, list | tuple):
        items = [own_copy(name, item) for item in value]
        if hasattr(value, "_fields"):  # a named tuple
            return type(value)(*items)
        kind = typing.get_origin(hint) or hint
        return kind(items) if kind in (list, tuple) else type(value)(items)
    if isinstance(value, Mapping) and all(isinstance(key, str) for key in value):
        return {key: own_copy(name, value[key]) for key in sorted(value)}
    raise TypeError(f"the parameter {name} holds a {type(value).__name__}, which is not plain data; make it an input")
