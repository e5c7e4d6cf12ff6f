"""Why a step ran: the first part of its key that differs from the last time."""

from __future__ import annotations

import functools
import sys
from collections.abc import Callable, Sequence
from dataclasses import is_dataclass
from typing import Any

from ss_flow.cache.canonical import digest
from ss_flow.cache.store import Store
from ss_flow.keys import Components

COMPARED = 10
"""With how many earlier calls of the same label a call is compared."""
SHOWN_CHARACTERS = 60
SHOWN_BEFORE = 10
SHOWN_ITEMS = 3


def since_last(
    known: Sequence[str],
    now: Components,
    closure: dict[str, str] | None,
    store: Store,
    items: Callable[[Components, str], str] = lambda before, name: "",
) -> str:
    """How a key differs from the nearest of those under which results of its label were found before: one phrase.

    known: these keys. closure: that of `now`; None where it is no longer known. items: as for `first_difference`, by
    the nearest key.
    """
    records = [store.action(key, whole=False) for key in known[:COMPARED]]
    among = [record.components for record in records if record is not None]
    if not among:
        return "what changed is not known: the record of the last time is no longer in the store"
    before = nearest(among, now)
    codes: list[Any] = [{}, {}]
    if before["code"] != now["code"]:
        codes = [part_of(store, before["code"]), closure]
    known_code = None if None in codes else codes[0]
    return first_difference({**before, "code": known_code}, {**now, "code": codes[1]}, functools.partial(items, before))


def part_of(store: Store, name: str) -> Any:
    """What a digest in a key stands for; None where the store has lost it, or holds something else by now."""
    part = store.part(name)
    return part if digest(part) == name else None


def first_difference(before: Components, now: Components, items: Callable[[str], str] = lambda name: "") -> str:
    """One phrase that names the first part of a key that changed; code as a closure, digests by qualified name.

    before: its code is None where only that it differs is known.
    items: says which items of an input changed (see `changed_items`), "" where it is no list. Ordered from cause to
    effect: the task's own parameters, its code, packages and machine come before its inputs, which may have changed
    only because of another step. Returns "" when nothing differs.
    """
    if before["task"] != now["task"]:
        return "the format of keys changed"
    for name in _changed(before["parameters"], now["parameters"]):
        return f"parameter {name} {_shown(before['parameters'], now['parameters'], name)}"
    if before["code"] is None:
        return "its code changed; which part of it is no longer known"
    for name in _changed(before["code"], now["code"]):
        word = "changed" if name in before["code"] and name in now["code"] else "is new or gone"
        return f"{_what(name)} of {name.removeprefix('ss_flow.')} {word}"
    for name in _changed(before["packages"], now["packages"]):
        return f"package {name} {_shown(before['packages'], now['packages'], name)}"
    for name in _changed(before["environment"], now["environment"]):
        return f"{name} of this machine {_shown(before['environment'], now['environment'], name)}"
    for name in _changed(before["inputs"], now["inputs"]):
        return f"input {name} changed{items(name)}"
    return ""


def nearest(among: Sequence[Components], now: Components) -> Components:
    """Of several keys' parts, those that differ least from these; of equal ones, the first."""
    parts = ("parameters", "packages", "environment", "inputs")

    def distance(before: Components) -> int:
        return sum(len(_changed(before[part], now[part])) for part in parts) + int(before["code"] != now["code"])

    return min(among, key=distance)


def _what(name: str) -> str:
    """What a definition consists of: a dataclass, such as the type of a result, has fields first of all."""
    module, _, attribute = name.rpartition(".")
    found = getattr(sys.modules.get(module), attribute, None)
    return "fields or code" if isinstance(found, type) and is_dataclass(found) else "code"


def _changed(before: dict[str, Any], now: dict[str, Any]) -> list[str]:
    """Names whose values differ as keys see it: 1, 1.0 and True do, and so do 0.0 and -0.0."""
    names = {**now, **before}
    return [n for n in names if n not in before or n not in now or digest(before[n]) != digest(now[n])]


def _shown(before: dict[str, Any], now: dict[str, Any], name: str) -> str:
    """The two values side by side; of long ones, a part that begins shortly before they differ."""
    sides = [str(side[name]) if name in side else "(absent)" for side in (before, now)]
    if sides[0] == sides[1]:  # 1 and "1"
        sides = [repr(side[name]) if name in side else "(absent)" for side in (before, now)]
    start = 0
    if max(map(len, sides)) > SHOWN_CHARACTERS:
        same = next((i for i, (old, new) in enumerate(zip(*sides, strict=False)) if old != new), min(map(len, sides)))
        start = max(0, same - SHOWN_BEFORE)
    return " -> ".join(_cut(side, start) for side in sides)


def _cut(text: str, start: int) -> str:
    text = text if start == 0 else f"...{text[start:]}"
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
