"""Care of the store: cache gc, du, verify."""

from __future__ import annotations

import contextlib
import json
import math
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass
from typing import Any, Literal, TypeVar

from rich.markup import escape
from rich.progress import Progress
from rich.table import Table

from ss_flow.cache.collect import Collected, Roots, collect
from ss_flow.cache.pins import Pin, read_pins
from ss_flow.cache.store import GRACE_SECONDS, Store
from ss_flow.cache.survey import Survey, Tally, Usage
from ss_flow.cache.verify import verify
from ss_flow.engine import RUN_CLAIM
from ss_flow.errors import InputError
from ss_flow.flows.cli.context import InStore, OptionalCount, OptionalText, StoreOptions, console
from ss_flow.flows.cli.pins import tell_pins
from ss_flow.flows.cli.telling import print_table
from ss_flow.flows.deliver import STATUS_EXIT
from ss_flow.runs import Run, latest_runs
from ss_flow.sweep import scene_of
from ss_flow.tasks.words import first_of, size_in_words
from ss_flow.units import parse_bytes, parse_seconds

T = TypeVar("T")

SHOWN = 10
"""Damaged things, and scenes, that are named one by one."""


@dataclass(frozen=True)
class CacheCollect:
    """Delete results that neither a pin nor a run needs; with limits, also those that were not used for long."""

    keep_runs: OptionalCount = None
    """Keep only the latest so many runs, and sweeps, of each scene, and delete the records of older ones; all, when
    left out. Runs that came to no result, or stopped early (--until), count by themselves."""
    max_size: OptionalText = None
    """Delete results until they take no more room than this (500MB, 20GB, 1.5TiB), least recently used first; what is
    pinned or belongs to a living run stays."""
    older_than: OptionalText = None
    """Delete results that were not used for this long (12h, 30d); what is pinned or belongs to a living run stays."""
    grace: str = f"{GRACE_SECONDS / 3600:g}h"
    """Nothing that was written or used within this time goes. While a run lives it is an hour at least."""
    dry_run: bool = False
    """Tell what would go, and delete nothing."""
    json: bool = False
    """Print one JSON document."""
    store: InStore = StoreOptions()
    """Where results are kept."""

    def run(self) -> int:
        if self.keep_runs is not None and self.keep_runs < 0:
            raise InputError(f"--keep-runs {self.keep_runs} is out of range; it must be 0 or more.")
        max_bytes = None if self.max_size is None else _parsed("--max-size", parse_bytes, self.max_size)
        unused = math.inf if self.older_than is None else _parsed("--older-than", parse_seconds, self.older_than)
        grace = _parsed("--grace", parse_seconds, self.grace)
        store = self.store.existing_store()
        wanted = Wanted(store, self.keep_runs, store.now() - grace)
        collected = collect(
            store,
            wanted,
            grace_seconds=grace,
            max_bytes=max_bytes,
            unused_seconds=unused,
            dry=self.dry_run,
        )
        losing = _runs_that_lose(store, collected.keys)
        runs = _delete(store, wanted.outdated, dry=self.dry_run)
        over = 0 if max_bytes is None else max(0, collected.left.bytes - max_bytes)
        self._tell(collected, losing, runs, over)
        return STATUS_EXIT["degraded" if over else "ok"]

    def _tell(self, collected: Collected, losing: list[dict[str, Any]], runs: Tally, over: int) -> None:
        rows = {step or "records that cannot be read": tally for step, tally in collected.results.items()}
        rows |= collected.others | ({"records of runs": runs} if runs.count else {})
        total, left = _sum(rows.values()), collected.left
        if self.json:
            removed = [{"what": what, **asdict(tally)} for what, tally in rows.items()]
            document = {"dry_run": self.dry_run, "removed": removed, "total": asdict(total), "left": asdict(left)}
            print(json.dumps(document | {"scenes": losing, "over_bytes": over}, indent=1))
            return
        out = console(json=False)
        print_table(_table("would go" if self.dry_run else "deleted", rows, {"total": total}), out)
        out.print(f"{left.count} results stay, {size_in_words(left.bytes)}")
        if losing:
            scenes = [f"{row['scene']} ({row['runs_that_lose']} of {row['runs']})" for row in losing]
            words = "would lose" if self.dry_run else "lost"
            out.print(escape(f"runs that {words} results: {first_of(scenes, SHOWN)}"))
        if over:
            out.print(
                f"[yellow]{size_in_words(over)} more than --max-size {self.max_size}:[/] the rest is pinned, belongs "
                "to a living run, or was used within the grace period"
            )


class Wanted:
    """What pins and runs need; called with the names of the living claims."""

    def __init__(self, store: Store, keep_runs: int | None, quiet_before: float) -> None:
        self._store, self._keep, self._quiet_before = store, keep_runs, quiet_before
        self.outdated: list[Run] = []
        """Runs that are not to be kept."""

    def __call__(self, living: set[str]) -> Roots:
        roots = Roots()
        for pinned in read_pins(self._store):
            roots.held.update(pinned.keys)
            roots.objects.update(pinned.objects)
        later: Counter[tuple[str, bool]] = Counter()
        sweeps: dict[tuple[str, bool], set[str]] = defaultdict(set)
        unknown = {name for name in living if name.startswith(RUN_CLAIM)}
        for run in latest_runs(self._store.runs):
            claim = RUN_CLAIM + run.folder.name
            whole = self._keep is None or run.is_whole()  # failures must not drive out the last results
            later[run.scene, whole] += 1
            rank = later[run.scene, whole]
            if "sweep" in run.header:  # of a scene, a sweep counts as one
                others = sweeps[scene_of(run.header), whole]
                others.add(run.header.get("asked", ""))
                rank = max(rank, len(others))
            if claim in living:
                unknown.discard(claim)
                roots.held.update(node["key"] for node in run.nodes())
                roots.objects.update(run.taken())
            elif self._keep is not None and rank > self._keep and self._is_quiet(run):
                self.outdated.append(run)
            else:
                roots.kept.update(node["key"] for node in run.nodes())
        if unknown:  # a store in a bucket: each machine keeps its own runs
            name = min(unknown).removeprefix(RUN_CLAIM)
            raise InputError(f"the run {name} of another machine is alive, and what it needs is not known here; wait.")
        return roots

    def _is_quiet(self, run: Run) -> bool:
        """Whether nothing was written for so long that this cannot be a run that has only just begun."""
        try:
            return max(path.stat().st_mtime for path in (run.folder, *run.folder.iterdir())) < self._quiet_before
        except FileNotFoundError:
            return False


def _runs_that_lose(store: Store, gone: frozenset[str]) -> list[dict[str, Any]]:
    """The scenes with runs that need one of these keys, and how many of their runs do. To be called before the records
    of runs are deleted."""
    scenes: dict[str, Counter[bool]] = defaultdict(Counter)
    for run in latest_runs(store.runs) if gone else ():
        scenes[scene_of(run.header)][any(node["key"] in gone for node in run.nodes())] += 1
    return [
        {"scene": scene, "runs": count.total(), "runs_that_lose": count[True]}
        for scene, count in scenes.items()
        if count[True]
    ]


def _delete(store: Store, runs: list[Run], *, dry: bool) -> Tally:
    """Delete the records of runs, each at once."""
    deleted = Tally()
    for run in runs:
        with contextlib.suppress(FileNotFoundError), store.temporary() as place:  # another collector may be faster
            size = sum(file.stat().st_size for file in run.folder.iterdir())
            if not dry:
                run.folder.rename(place)
            deleted.add(size)
    return deleted


@dataclass(frozen=True)
class CacheUsage:
    """Tell how much room results take, by step and by scene, and what is pinned."""

    by: Literal["step", "scene", "both"] = "both"
    """Which table."""
    json: bool = False
    """Print one JSON document."""
    store: InStore = StoreOptions()
    """Where results are kept."""

    def run(self) -> int:
        store = self.store.existing_store()
        survey, pins = Survey.of(store), read_pins(store)
        usages: dict[str, Usage] = {}
        if self.by != "scene":
            usages["step"] = survey.usage(survey.by_step())
        if self.by != "step":
            usages["scene"] = survey.usage(_keys_by_scene(store, pins))
        total = Tally(len(survey.actions), survey.bytes)
        if self.json:
            document = {"total": asdict(total), "pins": [asdict(pinned) for pinned in pins]}
            print(json.dumps(document | {f"by_{name}": asdict(usage) for name, usage in usages.items()}, indent=1))
            return 0
        out = console(json=False)
        for name, usage in usages.items():
            ends = {"of none of them": usage.unreachable, "total": total}
            print_table(_table(name, usage.rows, ends), out)
            if usage.shared_bytes:
                out.print(f"of the rows, {size_in_words(usage.shared_bytes)} are shared and counted more than once")
            out.print()
        tell_pins(pins)
        return 0


def _keys_by_scene(store: Store, pins: list[Pin]) -> dict[str, set[str]]:
    scenes: dict[str, set[str]] = {}
    for run in latest_runs(store.runs):
        scenes.setdefault(run.scene, set()).update(node["key"] for node in run.nodes())
    for pinned in pins:
        scenes.setdefault(pinned.scene or "(pinned)", set()).update(pinned.keys)
    return dict(sorted(scenes.items()))


@dataclass(frozen=True)
class CacheVerify:
    """Read the whole store, and take out what is damaged; the next run makes it again."""

    json: bool = False
    """Print one JSON document."""
    store: InStore = StoreOptions()
    """Where results are kept."""

    def run(self) -> int:
        store = self.store.existing_store()
        err = console(json=True)
        with Progress(console=err, transient=True, disable=not err.is_terminal) as display:
            task = display.add_task("reading")
            seen = verify(store, lambda done, total: display.update(task, completed=done, total=total))
        if self.json:
            print(json.dumps(asdict(seen), indent=1))
        else:
            out = console(json=False)
            rows = {"objects": seen.objects, "results": seen.actions, "parts of keys": seen.parts}
            print_table(_table("read", rows, {}), out)
            for damage in seen.damaged[:SHOWN]:
                out.print(escape(f"taken out: {damage.kind} {damage.name[:12]} {damage.reason}"))
            if len(seen.damaged) > SHOWN:
                out.print(f"... and {len(seen.damaged) - SHOWN} more; --json lists them all")
            if seen.incomplete:
                out.print(f"{seen.incomplete} results lack something, and are made again when they are needed")
            out.print("[yellow]damaged[/]" if seen.damaged else "all is whole")
        return STATUS_EXIT["degraded" if seen.damaged else "ok"]


def _sum(tallies: Iterable[Tally]) -> Tally:
    total = Tally()
    for tally in tallies:
        total.add(tally.bytes, tally.count)
    return total


def _table(what: str, rows: dict[str, Tally], ends: dict[str, Tally]) -> Table:
    table = Table(what, box=None)
    table.add_column("number", justify="right")
    table.add_column("size", justify="right")
    for name, tally in [*rows.items(), *ends.items()]:
        table.add_row(escape(name), str(tally.count), size_in_words(tally.bytes))
    return table


def _parsed(option: str, parse: Callable[[str], T], text: str) -> T:
    try:
        return parse(text)
    except ValueError as error:
        raise InputError(f"{option}: {error}") from None
