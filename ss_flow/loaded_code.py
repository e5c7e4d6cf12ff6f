"""Whether the functions that are loaded are those that are written: a key is made from what is written.

Compared is compiled code, which of a value (a constant, a default) tells nothing.
"""

from __future__ import annotations

import inspect
import os
import sys
from collections.abc import Iterable, Iterator
from types import CodeType, FunctionType
from typing import Any

EDITED = "was edited after it was loaded: load it again (importlib.reload), or start anew"


def not_as_written(module_name: str) -> str:
    """Why a loaded module is not what its file says now, as the end of a sentence; "" where its functions are."""
    specification: Any = sys.modules[module_name].__spec__
    read = getattr(getattr(specification, "loader", None), "get_code", None)
    code = read and read(module_name)
    if code is None:  # compiled by others, or a folder without an __init__.py
        return ""
    if _may_be_stale(specification):
        loader, file = specification.loader, specification.origin
        if code != loader.source_to_code(loader.get_data(file), file):
            return (
                f"was loaded from {specification.cached}, which was made from an older text of the same size and time: "
                "delete that, and start anew"
            )
    written = set(_codes(code))
    if all(f.__code__ in written for f in _functions(module_name) if f.__module__ == module_name):
        return ""
    return EDITED


def _may_be_stale(specification: Any) -> bool:
    """Whether a module's file was written after the bytecode that Python keeps of it: Python compares only its size and
    its time, in whole seconds, which an edit within the second, or an archive, leaves as they were."""
    try:
        return os.stat(specification.origin).st_ctime_ns >= os.stat(specification.cached).st_mtime_ns
    except (OSError, TypeError):  # there is none
        return False


def left_behind(definitions: Iterable[str]) -> str:
    """A sentence on a module that holds a function of another one as it was before that was loaded again; or "".

    definitions: qualified names of all that may be called, "package.module.name".
    """
    called = set(definitions)
    modules = {name.rpartition(".")[0] for name in called} & sys.modules.keys()
    now: dict[str, set[CodeType]] = {}
    for user in sorted(modules):
        for held in _functions(user):
            home, name = held.__module__, held.__qualname__.partition(".")[0]
            if home == user or home not in modules or f"{home}.{name}" not in called:
                continue
            if home not in now:
                now[home] = {function.__code__ for function in _functions(home)}
            if held.__code__ not in now[home]:
                return f"{user} holds {home}.{name} as it was before {home} was loaded again: load {user} again, too"
    return ""


def bound_in(module_name: str) -> dict[str, list[Any]]:
    """What the names of a module stand for, those of its own classes included, with code in the place of functions.

    Empty for a module that is not loaded.
    """
    bound = dict(vars(sys.modules[module_name])) if module_name in sys.modules else {}
    found: dict[str, list[Any]] = {}
    for name, value in bound.items():
        is_own = issubclass(type(value), type) and value.__module__ == module_name
        found[name] = [_code(held) for held in list(vars(value).values())] if is_own else [_code(value)]
    return found


def _code(held: Any) -> Any:
    held = _in_class(held)
    return held.__code__ if type(held) is FunctionType else held


def _in_class(held: Any) -> Any:
    """The function that a class holds as a static or class method, or as a property; anything else as it is."""
    if isinstance(held, property):
        return held.fget
    return held.__func__ if isinstance(held, staticmethod | classmethod) else held


def _functions(module_name: str) -> Iterator[FunctionType]:
    """The functions that a loaded module holds, and the methods of its classes, bare of what wraps them.

    Without those that a decorator generates.
    """
    for value in list(vars(sys.modules[module_name]).values()):
        for held in list(vars(value).values()) if issubclass(type(value), type) else (value,):
            held = _in_class(held)
            while (inner := _wrapped(held)) is not None:
                held = inner
            if type(held) is FunctionType and held.__code__.co_filename == _file(held.__module__):
                yield held


def _wrapped(held: Any) -> Any:
    """What a wrapper says that it holds; no code of its own is asked.

    A look through all its classes takes a hundred times as long as these two, which almost all are: functions, and what
    has no place for it.
    """
    if type(held) is FunctionType:
        return held.__dict__.get("__wrapped__")
    return inspect.getattr_static(held, "__wrapped__", None) if type(held).__dictoffset__ else None


def _file(module_name: Any) -> str | None:
    return getattr(sys.modules.get(module_name), "__file__", None)


def _codes(code: CodeType) -> Iterator[CodeType]:
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield constant
            yield from _codes(constant)
