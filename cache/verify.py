"""Reading a whole store, and taking out what is not what its name says."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

from ss_flow.cache.canonical import digest
from ss_flow.cache.errors import Gone
from ss_flow.cache.store import Store
from ss_flow.cache.survey import Tally

THREADS = 4


@dataclass(frozen=True)
class Damage:
    """Something that was taken out."""

    kind: str
    """object, action or part."""
    name: str
    reason: str


@dataclass(frozen=True)
class Verified:
    """What was looked at, and what was wrong with it."""

    objects: Tally
    actions: Tally
    parts: Tally
    incomplete: int
    """Actions with an output that is not there; they count for nothing, and the next run makes them again."""
    damaged: tuple[Damage, ...]
    """What was taken out, so that the next run makes it again."""


def verify(store: Store, progress: Callable[[int, int], None] = lambda done, total: None) -> Verified:
    """Check every object, action and part of a store against its name; take out what is damaged.

    An object is damaged when its content is not what its name says, or when this version cannot read it for another
    reason than that its type has other fields by now, or is not to be found here; an action when its record cannot be
    read or is that of another key; a part when its content is not what its name says.

    progress: hears how many objects are done, of how many.
    Raises StoreFailure, or MemoryError, when the store cannot be used or read.
    """
    damaged: list[Damage] = []
    parts, actions, objects = Tally(), Tally(), Tally()
    for entry in store.parts():
        parts.add(entry.bytes)
        if digest(store.part(entry.name)) != entry.name and store.drop_part(entry.name):
            damaged.append(Damage("part", entry.name, "its content is not what its name says"))
    needed: dict[str, tuple[str, ...]] = {}
    for entry in store.actions():
        actions.add(entry.bytes)
        action = store.action(entry.name, whole=False)
        if action is not None:
            needed[entry.name] = action.outputs
        elif store.forget(entry.name):
            damaged.append(Damage("action", entry.name, "its record cannot be read, or is that of another key"))
    entries = list(store.objects())
    with ThreadPoolExecutor(THREADS) as pool:
        faults = pool.map(lambda entry: _fault(store, entry.name), entries)
        for entry, fault in zip(entries, faults, strict=True):
            objects.add(entry.bytes)
            if fault:
                damaged.append(Damage("object", entry.name, fault))
            progress(objects.count, len(entries))
    incomplete = sum(not all(output in store for output in outputs) for outputs in needed.values())
    return Verified(objects, actions, parts, incomplete, tuple(damaged))


def _fault(store: Store, object_digest: str) -> str:
    """What was wrong with an object, which is then no longer there; "" when it is whole."""
    try:
        store.read(object_digest)
    except Gone as gone:
        if "damaged" in gone.reason:  # otherwise someone took it out in the meantime
            return gone.reason
    return ""
