"""Keeping results on purpose: cache pin, cache unpin."""

from __future__ import annotations

import json
import re
import time
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro
from rich.markup import escape
from rich.table import Table

from ss_flow.cache.canonical import digests_of
from ss_flow.cache.pins import Pin, pin, read_pins, unpin
from ss_flow.cache.store import Store
from ss_flow.cache.survey import Survey
from ss_flow.errors import InputError
from ss_flow.flows.cli.context import InStore, OptionalPath, PositionalText, StoreOptions, console
from ss_flow.flows.cli.inspect import run_with
from ss_flow.flows.cli.telling import print_table
from ss_flow.flows.results import read_run
from ss_flow.runs import latest_runs
from ss_flow.tasks.deliver.output import RUN_FILE


@dataclass(frozen=True)
class CachePin:
    """Keep results from being deleted by `cache gc`; without a name, list what is pinned."""

    what: PositionalText = None
    """A step (propagate, segment[0003]) of the latest run that got to it, the first characters of a digest, an
    output folder: then all that it was made of; or a scene: then all of its latest run."""
    scene: OptionalPath = None
    """The scene that the step is of; the one that ran last, when left out."""
    json: bool = False
    """Print one JSON document."""
    store: InStore = StoreOptions()
    """Where results are kept."""

    def run(self) -> int:
        store = self.store.existing_store()
        if self.what is not None:
            made = self._pin(store, self.what)
            console(json=self.json).print(escape(f"pinned {_described(made)}"))
        if self.json:
            print(json.dumps([asdict(pinned) for pinned in read_pins(store)], indent=1))
        elif self.what is None:
            tell_pins(read_pins(store))
        return 0

    def _pin(self, store: Store, what: str) -> Pin:
        run, nodes = run_with(store, self.scene, what)
        if run:
            return _pin_results(store, what, run.scene, nodes)
        found = store.find(what)
        if len(found) == 1:
            makers = [key for key, action in Survey.of(store).actions.items() if found[0] in action.outputs]
            return pin(store, found[0], "", makers, found)
        if found:
            raise InputError(f"{what!r} stands for {len(found)} results; give more of the digest.")
        if (Path(what) / RUN_FILE).is_file():
            return _pin_output(store, Path(what))
        run = next(latest_runs(store.runs, str(Path(what).resolve())), None)
        if run is None:
            raise InputError(
                f"{what!r} is neither a step of the latest runs, nor a digest, nor an output folder, nor a scene that "
                "was run; `ss-flow cache ls` lists what there is."
            )
        return _pin_results(store, run.scene, run.scene, run.nodes())


def _pin_output(store: Store, folder: Path) -> Pin:
    """All that an output folder was made of, whether or not there is a record of its run; of an edit, also what it has
    of its source."""
    document = read_run(folder)
    made = [digest for value in document["results"].values() for digest in digests_of(value)]
    scene = str(Path(document["scene"]).resolve())
    return _pin_results(store, str(folder.resolve()), scene, document["nodes"], dict.fromkeys(made))


def _pin_results(
    store: Store, what: str, scene: str, nodes: Iterable[Mapping[str, Any]], objects: Iterable[str] = ()
) -> Pin:
    # Looking them up counts as a use, so that a `cache gc` that runs at the same time leaves them alone.
    keys = [key for key in dict.fromkeys(node["key"] for node in nodes) if store.action(key) is not None]
    if not keys:
        raise InputError(f"the results of {what!r} are no longer in the store; run {scene} again first.")
    return pin(store, what, scene, keys, [digest for digest in objects if digest in store])


@dataclass(frozen=True)
class CacheUnpin:
    """Let go what was pinned; `cache gc` may then delete it."""

    what: Annotated[str, tyro.conf.Positional]
    """What was pinned, as `cache pin` lists it; the first characters of a digest will do."""
    scene: OptionalPath = None
    """Only what was pinned of this scene."""
    store: InStore = StoreOptions()
    """Where results are kept."""

    def run(self) -> int:
        store = self.store.existing_store()
        pins = read_pins(store)
        asked = [pinned for pinned in pins if self._means(pinned)]
        if not asked:
            known = ", ".join(dict.fromkeys(pinned.what for pinned in pins)) or "none"
            raise InputError(f"{self.what!r} is not pinned; pinned are: {known}.")
        for pinned in asked:
            unpin(store, pinned)
            console(json=False).print(escape(f"unpinned {_described(pinned)}"))
        return 0

    def _means(self, pinned: Pin) -> bool:
        if self.scene is not None and pinned.scene != str(self.scene.resolve()):
            return False
        of_digest = bool(pinned.objects) and re.fullmatch("[0-9a-f]{2,}", self.what) is not None
        return pinned.what in (self.what, str(Path(self.what).resolve())) or (
            of_digest and pinned.what.startswith(self.what)
        )


def _described(pinned: Pin) -> str:
    about = "" if pinned.scene in ("", pinned.what) else f" of {pinned.scene}"
    return f"{pinned.what}{about}: {len(pinned.keys)} results"


def tell_pins(pins: list[Pin]) -> None:
    """Print what is pinned, a line a pin."""
    if not pins:
        console(json=False).print("nothing is pinned")
        return
    table = Table("pinned", "scene", "results", "since", box=None)
    for pinned in pins:
        since = time.strftime("%F %T", time.localtime(pinned.pinned))
        table.add_row(escape(pinned.what), escape(pinned.scene), str(len(pinned.keys)), since)
    print_table(table, console(json=False))
