"""Collecting what nobody needs any more: mark from the roots, then sweep, what was used least recently first.

Notes
-----
*Jobs at work.* What was written or used within the grace period stays, so that a job finds what it has just been
promised; while anything runs, the grace period is no shorter than `GRACE_SECONDS`. An action goes before its objects,
and each only if nobody has used it since the marking. What slips through all the same is computed again.

*Several collectors* may go at once: what one has taken, the other passes over.

*Crash.* A collector that dies leaves actions whole, objects that no action names, and names in tmp/; the next one
takes them.
"""

from __future__ import annotations

import contextlib
import math
import re
import stat
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

from ss_flow.cache.canonical import DIGEST
from ss_flow.cache.errors import writing
from ss_flow.cache.files import UNFINISHED, remove
from ss_flow.cache.store import GRACE_SECONDS, Entry, Store
from ss_flow.cache.survey import Survey, Tally

THREADS = 8
"""How many things are taken out at the same time; a distant store has them wait for each."""
ORPHANS = "objects of no result"
HIDDEN = (".*", "roots/*/.*", "roots/runs/*/.*")
"""Where files are written beside those that they replace."""
_CHECKPOINT = re.compile(rf"{DIGEST.pattern}\.(npz|partial)")


@dataclass(frozen=True)
class Roots:
    """What is wanted."""

    held: set[str] = field(default_factory=set)
    """Keys of actions that stay whatever happens, and their outputs with them."""
    kept: set[str] = field(default_factory=set)
    """Keys of actions that go only when they are too old, or when there is too little room."""
    objects: set[str] = field(default_factory=set)
    """Digests of objects that stay whatever happens."""


@dataclass(frozen=True)
class Collected:
    """What went, or would go."""

    results: dict[str, Tally]
    """Actions with the bytes of what went with them, by step; "" are records that could not be read."""
    others: dict[str, Tally]
    """What is no result: how many, and the bytes where they are known."""
    left: Tally
    """Actions that stay, and the bytes of all actions and objects that do."""
    keys: frozenset[str]
    """Those of the actions that went."""


def collect(
    store: Store,
    roots: Callable[[set[str]], Roots],
    *,
    grace_seconds: float = GRACE_SECONDS,
    max_bytes: int | None = None,
    unused_seconds: float = math.inf,
    dry: bool = False,
) -> Collected:
    """Take out of a store what its roots do not reach.

    roots: called with the names of the living claims, whose actions count as held. grace_seconds: nothing that was
    written or used within this time goes. max_bytes: kept actions go too, those that were used least recently first,
    until actions and objects take no more. unused_seconds: kept actions go too when they were not used for this long.
    dry: take nothing out, only tell.

    Raises StoreFailure when the store cannot be used.
    """
    # The clock is read first: what another process makes or uses from now on is then too young to be deleted.
    now = store.now()
    claims = store.open_claims()
    claims.distrust(now - GRACE_SECONDS)
    living = claims.living()
    wanted = roots(living)
    before = now - max(grace_seconds, GRACE_SECONDS if living else 0.0)
    plan = _Plan(Survey.of(store), wanted, wanted.held | living, before)
    plan.choose(now - unused_seconds, math.inf if max_bytes is None else max_bytes)

    others: dict[str, Tally] = defaultdict(Tally)
    results = _sweep_results(store, plan, others, dry=dry)
    if not living:  # a run that starts a job counts on the parts that it found
        named = frozenset[str]().union(*(plan.survey.actions[key].parts for key in plan.staying))
        for part in store.parts():
            unwanted = part.name not in named and part.used < before
            if unwanted and (dry or store.drop_part(part.name, unused_since=before)):
                others["parts of keys"].add(part.bytes)
    with writing(store.root):
        for file, size in _old_files(store.root, ("checkpoints/*",), _CHECKPOINT, before):
            if file.stem not in living:
                _take(file, size, others["checkpoints"], dry=dry)
        # Another process may be writing these files now, so they stay for an hour, however short the grace period.
        for file, size in _old_files(store.root, HIDDEN, UNFINISHED, now - GRACE_SECONDS):
            _take(file, size, others["temporary files"], dry=dry)
    if not dry:
        others["temporary files"].count += store.sweep_temporaries()
    others["stale claims"].count += claims.sweep(dry=dry)
    left = Tally(len(plan.staying), plan.bytes)
    gone = frozenset(plan.survey.actions) - plan.staying
    return Collected(results, {what: tally for what, tally in others.items() if tally.count}, left, gone)


class _Plan:
    """Which actions go, and what is left then."""

    def __init__(self, survey: Survey, wanted: Roots, held: set[str], before: float) -> None:
        self.survey, self.before = survey, before
        self._kept, self._held, self._pinned = wanted.kept, held, wanted.objects
        self.going: list[str] = []
        """In the order in which they go."""
        self.staying = set(survey.actions)
        self._names = Counter(name for action in survey.actions.values() for name in action.outputs)
        """How many of the actions that stay name an object."""
        self.bytes = survey.bytes - sum(entry.bytes for entry in self.orphans())

    def orphans(self) -> list[Entry]:
        """The objects that may go: no action that stays names them."""
        return [entry for entry in self.survey.objects.values() if not self._names[entry.name] and self._may_go(entry)]

    def choose(self, unused_before: float, most_bytes: float) -> None:
        """Choose what is useless or unwanted, or was last used before then; then more, until the rest is no larger."""
        actions = self.survey.actions
        free = [key for key in actions if key not in self._held and actions[key].used < self.before]
        free.sort(key=lambda key: actions[key].used)
        for key in free:
            if key not in self._kept or actions[key].used < unused_before or not self.survey.is_whole(key):
                self._send(key)
        for key in free:
            if self.bytes > most_bytes and key in self.staying:
                self._send(key)

    def spare(self, key: str) -> None:
        """An action that was to go stays after all, with its outputs."""
        self.staying.add(key)
        action = self.survey.actions[key]
        self.bytes += action.bytes + self._count(key, 1)

    def _send(self, key: str) -> None:
        self.going.append(key)
        self.staying.remove(key)
        self.bytes -= self.survey.actions[key].bytes + self._count(key, -1)

    def _count(self, key: str, change: int) -> int:
        """Count an action's outputs up or down; return the bytes of the outputs that stay, or go, because of it."""
        size = 0
        for name in self.survey.actions[key].outputs:
            self._names[name] += change
            entry = self.survey.objects.get(name)
            if entry is not None and self._names[name] == max(change, 0) and self._may_go(entry):
                size += entry.bytes
        return size

    def _may_go(self, entry: Entry) -> bool:
        return entry.used < self.before and entry.name not in self._pinned


def _sweep_results(store: Store, plan: _Plan, others: dict[str, Tally], *, dry: bool) -> dict[str, Tally]:
    results: dict[str, Tally] = defaultdict(Tally)
    makers: dict[str, str] = {}
    with ThreadPoolExecutor(THREADS) as pool:
        forgotten = pool.map(lambda key: dry or store.forget(key, unused_since=plan.before), plan.going)
        for key, gone in zip(plan.going, forgotten, strict=True):
            action = plan.survey.actions[key]
            if gone:
                results[action.step].add(action.bytes)
                makers |= dict.fromkeys(action.outputs, action.step)
            elif store.action(key, whole=False) is not None:  # used since
                plan.spare(key)
        orphans = sorted(plan.orphans(), key=lambda entry: entry.used)
        discarded = pool.map(lambda entry: dry or store.discard(entry.name, unused_since=plan.before), orphans)
        for entry, gone in zip(orphans, discarded, strict=True):
            if gone and entry.name in makers:
                results[makers[entry.name]].add(entry.bytes, count=0)
            elif gone:
                others[ORPHANS].add(entry.bytes)
    return dict(sorted(results.items()))


def _old_files(
    root: Path, patterns: tuple[str, ...], named: re.Pattern[str], before: float
) -> Iterator[tuple[Path, int]]:
    """Files that a store names so and that were last written before then, and their sizes."""
    for pattern in patterns:
        for path in filter(lambda path: named.fullmatch(path.name), root.glob(pattern)):
            with contextlib.suppress(FileNotFoundError):  # its writer has just finished
                status = path.stat()
                if stat.S_ISREG(status.st_mode) and status.st_mtime < before:
                    yield path, status.st_size


def _take(file: Path, size: int, tally: Tally, *, dry: bool) -> None:
    tally.add(size)
    if not dry:
        remove(file)
