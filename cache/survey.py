"""What a store holds, seen at once: which actions there are, what they name, and how much room each takes."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass

from ss_flow.cache.store import Entry, Store


@dataclass
class Tally:
    """How many, and how much room they take."""

    count: int = 0
    bytes: int = 0

    def add(self, size: int, count: int = 1) -> None:
        self.count += count
        self.bytes += size


@dataclass(frozen=True)
class Record:
    """What care of the store needs to know of an action."""

    step: str
    """Empty when the record cannot be read."""
    outputs: frozenset[str]
    parts: frozenset[str]
    """Digests in its components that may stand for parts."""
    used: float
    bytes: int


@dataclass(frozen=True)
class Usage:
    """How much room groups of actions take."""

    rows: dict[str, Tally]
    """Of each group: its actions, and the bytes of all that they hold, shared or not."""
    shared_bytes: int
    """How much the rows count more than once."""
    unreachable: Tally
    """Actions of no group, and the bytes of all that no group holds."""


@dataclass(frozen=True)
class Survey:
    """All actions by key and all objects by digest."""

    actions: dict[str, Record]
    objects: dict[str, Entry]

    @classmethod
    def of(cls, store: Store) -> Survey:
        """Look through a store. Actions come first: an object that is missing then was missing before."""
        actions = {entry.name: _record(store, entry) for entry in store.actions()}
        return cls(actions, {entry.name: entry for entry in store.objects()})

    @property
    def bytes(self) -> int:
        """How much room actions and objects take; an object that several actions name counts once."""
        return sum(a.bytes for a in self.actions.values()) + sum(o.bytes for o in self.objects.values())

    def is_whole(self, key: str) -> bool:
        """Whether an action can be read and all of its outputs are there."""
        return bool(self.actions[key].step) and self.actions[key].outputs <= self.objects.keys()

    def by_step(self) -> dict[str, list[str]]:
        """Keys of the readable actions of each step."""
        steps: dict[str, list[str]] = {}
        for key, action in self.actions.items():
            if action.step:
                steps.setdefault(action.step, []).append(key)
        return dict(sorted(steps.items()))

    def usage(self, groups: Mapping[str, Iterable[str]]) -> Usage:
        """How much room groups of keys take; keys of actions that are not here count nothing."""
        present = {name: {key for key in keys if key in self.actions} for name, keys in groups.items()}
        rows = {name: self._tally(keys) for name, keys in present.items()}
        union = self._tally(set().union(*present.values()))
        unreachable = Tally(len(self.actions) - union.count, self.bytes - union.bytes)
        return Usage(rows, sum(row.bytes for row in rows.values()) - union.bytes, unreachable)

    def _tally(self, keys: Collection[str]) -> Tally:
        named = frozenset().union(*(self.actions[key].outputs for key in keys)) & self.objects.keys()
        size = sum(self.actions[key].bytes for key in keys) + sum(self.objects[name].bytes for name in named)
        return Tally(len(keys), size)


def _record(store: Store, entry: Entry) -> Record:
    action = store.action(entry.name, whole=False)
    if action is None:
        return Record("", frozenset(), frozenset(), entry.used, entry.bytes)
    inputs = action.components.get("inputs")
    named = [action.components.get("code"), *(inputs.values() if isinstance(inputs, dict) else ())]
    parts = frozenset(digest for digest in named if isinstance(digest, str))
    return Record(action.step, frozenset(action.outputs), parts, entry.used, entry.bytes)
