"""A finished run's output folder, and its results in the store."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ss_flow.cache.store import Store
from ss_flow.errors import InputError
from ss_flow.flows.cli.context import StoreOptions
from ss_flow.flows.cli.query import read_run
from ss_flow.graph import stored
from ss_flow.tasks.capture.scene_files import read_json

BACKGROUND = 0


@dataclass(frozen=True)
class FinishedRun:
    """A run whose results are at hand."""

    folder: Path
    document: dict[str, Any]
    """run.json."""
    instances: list[dict[str, Any]]
    """Those of instances.json."""
    store: Store

    @property
    def name(self) -> str:
        """What files that are made of it are called."""
        return self.folder.resolve().name

    @property
    def names(self) -> dict[str, str]:
        """Of the instances, by their ids as text."""
        return {str(entry["id"]): entry["name"] for entry in self.instances}

    def node(self, result: str) -> Any:
        """A node for one of the results."""
        return stored(result, self.document["results"][result])

    def load(self, result: str) -> Any:
        """A result that is one artifact."""
        return self.store.get(self.document["results"][result])

    def ids(self, asked: Sequence[str]) -> tuple[int, ...]:
        """The ids of instances given by id or by name, ascending; 0 is the background.

        Raises InputError for one that the run does not have, or that has no Gaussians.
        """
        by_name = {entry["name"]: entry for entry in self.instances}
        by_id = {str(entry["id"]): entry for entry in self.instances}
        found = set()
        for word in asked:
            if word == str(BACKGROUND):
                found.add(BACKGROUND)
                continue
            entry = by_id.get(word) or by_name.get(word)
            if entry is None:
                known = ", ".join(f"{entry['id']} ({entry['name']})" for entry in self.instances[:8])
                raise InputError(
                    f"--instance {word!r} is no instance of {self.folder}; there are 0 (background), {known}."
                )
            if not entry["num_gaussians"]:
                raise InputError(f"instance {entry['id']} ({entry['name']}) of {self.folder} has no Gaussians.")
            found.add(int(entry["id"]))
        return tuple(sorted(found))

    def all_ids(self) -> tuple[int, ...]:
        """The instances that have a file of their own, ascending."""
        return tuple(sorted(int(entry["id"]) for entry in self.instances if entry["file"]))


def open_run(folder: Path, options: StoreOptions, needed: Sequence[str]) -> FinishedRun:
    """Open a run's output folder.

    needed: the results that the store must still hold.
    Raises InputError when the folder is not that of a run, is damaged, or a result is gone.
    """
    document = read_run(folder)
    chosen = options if options.cache else StoreOptions(document["store"])
    store = chosen.existing_store()
    for name in needed:
        digests = document["results"].get(name)
        if digests is None or not all(value in store for value in ([digests] if isinstance(digests, str) else digests)):
            raise InputError(f"the store {store.location} no longer holds `{name}` of {folder}; run it again.")
    instances = read_json(folder / "instances.json")
    if not isinstance(instances, dict) or not isinstance(instances.get("instances"), list):
        raise InputError(f"{folder / 'instances.json'} is damaged: it lacks what a run writes; run the scene again.")
    return FinishedRun(folder, document, instances["instances"], store)
