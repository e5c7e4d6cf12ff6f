"""Why a step ran: the first part of its key that differs from the last time."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import is_dataclass
from typing import Any

from ss_flow.cache.canonical import digest
from ss_flow.keys import Components

SHOWN_CHARACTERS = 60
SHOWN_ITEMS = 3


def first_difference(before: Components, now: Components, items: Callable[[str], str] = lambda name: "") -> str:
    """One phrase that names the first part of a key that changed; code as a closure, digests by qualified name.

    items: says which items of an input changed (see `changed_items`), "" where it is no list. Ordered from cause to
    effect: the task's own parameters, its code, packages and machine come before its inputs, which may have changed
    only because of another step. Returns "" when nothing differs.
    """
    if before["task"] != now["task"]:
        return "the format of keys changed"
    for name in _changed(before["parameters"], now["parameters"]):
        old, new = (_shown(side["parameters"], name) for side in (before, now))
        return f"parameter {name} {old} -> {new}"
    for name in _changed(before["code"], now["code"]):
        word = "changed" if name in before["code"] and name in now["code"] else "is new or gone"
        return f"{_what(name)} of {name.removeprefix('ss_flow.')} {word}"
    for name in _changed(before["packages"], now["packages"]):
        old, new = (_shown(side["packages"], name) for side in (before, now))
        return f"package {name} {old} -> {new}"
    for name in _changed(before["environment"], now["environment"]):
        old, new = (_shown(side["environment"], name) for side in (before, now))
        return f"{name} of this machine {old} -> {new}"
    for name in changed_inputs(before, now):
        return f"input {name} changed{items(name)}"
    return ""


def _what(name: str) -> str:
    """What a definition consists of: a dataclass, such as the type of a result, has fields first of all."""
    module, _, attribute = name.rpartition(".")
    return "fields or code" if is_dataclass(getattr(sys.modules.get(module), attribute, None)) else "code"


def changed_inputs(before: Components, now: Components) -> list[str]:
    """Names of the inputs that differ between two keys."""
    return _changed(before["inputs"], now["inputs"])


def _changed(before: dict[str, Any], now: dict[str, Any]) -> list[str]:
    """Names whose values differ as keys see it: 1, 1.0 and True do, and so do 0.0 and -0.0."""
    names = {**now, **before}
    return [n for n in names if n not in before or n not in now or digest(before[n]) != digest(now[n])]


def _shown(values: dict[str, Any], name: str) -> str:
    text = str(values[name]) if name in values else "(absent)"
    return text if len(text) <= SHOWN_CHARACTERS else f"{text[: SHOWN_CHARACTERS - 3]}..."


def changed_items(before: Sequence[str], now: Sequence[str], names: Sequence[str]) -> str:
    """How many items of a list differ and, where not all do, what the first of them are called.

    names: of the items as they are now.
    """
    if len(before) != len(now):
        return f" ({len(before)} -> {len(now)} items)"
    changed = [name for name, old, new in zip(names, before, now, strict=True) if old != new]
    said = f"{len(changed)} of {len(now)} items"
    if len(changed) < len(now):
        said += f": {', '.join(changed[:SHOWN_ITEMS])}{', ...' if len(changed) > SHOWN_ITEMS else ''}"
    return f" ({said})"
