"""A finished run, read back: its output folder, and its results in the store."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ss_flow.cache.store import Store
from ss_flow.errors import InputError
from ss_flow.graph import stored
from ss_flow.tasks.deliver.output import RUN_FILE

BACKGROUND = 0


@dataclass(frozen=True)
class Results:
    """The results of a run by name, read from the store when they are asked for."""

    store: Store
    digests: Mapping[str, Any]
    """Of each result: one digest, or a list of them."""

    def one(self, name: str) -> Any:
        """A result that is one artifact."""
        return self.store.get(self.digests[name])

    def all(self, name: str) -> list[Any]:
        """A result that is a list of artifacts."""
        return [self.store.get(value) for value in self.digests[name]]

    def node(self, name: str) -> Any:
        """A node for a result, in a flow."""
        return stored(name, self.digests[name])

    def nodes(self) -> dict[str, Any]:
        """A node for every result, by name."""
        return {name: self.node(name) for name in self.digests}

    def missing(self, names: Iterable[str]) -> list[str]:
        """Those of these results that the run did not have, or the store no longer holds."""

        def held(name: str) -> bool:
            value = self.digests.get(name, "")
            return all(digest in self.store for digest in ([value] if isinstance(value, str) else value))

        return [name for name in names if not held(name)]


@dataclass(frozen=True)
class FinishedRun:
    """A run whose results are at hand."""

    folder: Path
    document: dict[str, Any]
    """run.json."""
    instances: dict[str, Any]
    """instances.json."""
    results: Results

    @property
    def store(self) -> Store:
        return self.results.store

    def require(self, needed: Sequence[str]) -> None:
        """Raises InputError when the store no longer holds one of these results."""
        if gone := self.results.missing(needed):
            what = f"the store {self.store.location} no longer holds {', '.join(gone)} of {self.folder}"
            raise InputError(f"{what}; run it again.")

    @property
    def name(self) -> str:
        """What files that are made of it are called."""
        return self.folder.resolve().name

    @property
    def names(self) -> dict[str, str]:
        """Of the instances, by their ids as text."""
        return {str(entry["id"]): entry["name"] for entry in self.instances["instances"]}

    def ids(self, asked: Sequence[str]) -> tuple[int, ...]:
        """The ids of instances given by id or by name, ascending; 0 is the background.

        Raises InputError for one that the run does not have, or that has no Gaussians.
        """
        entries = self.instances["instances"]
        by_name = {entry["name"]: entry for entry in entries}
        by_id = {str(entry["id"]): entry for entry in entries}
        found = set()
        for word in asked:
            if word == str(BACKGROUND):
                found.add(BACKGROUND)
                continue
            entry = by_id.get(word) or by_name.get(word)
            if entry is None:
                known = ", ".join(f"{entry['id']} ({entry['name']})" for entry in entries[:8])
                raise InputError(
                    f"--instance {word!r} is no instance of {self.folder}; there are 0 (background), {known}."
                )
            if not entry["num_gaussians"]:
                raise InputError(f"instance {entry['id']} ({entry['name']}) of {self.folder} has no Gaussians.")
            found.add(int(entry["id"]))
        return tuple(sorted(found))

    def all_ids(self) -> tuple[int, ...]:
        """The instances that have a file of their own, ascending."""
        return tuple(sorted(int(entry["id"]) for entry in self.instances["instances"] if entry["file"]))


def read_run(folder: Path) -> dict[str, Any]:
    """The document run.json of an output folder. Raises InputError when there is none, or it is damaged."""
    if not (folder / RUN_FILE).is_file():
        raise InputError(f"{folder} is not the output folder of a run: it has no {RUN_FILE}.")
    return _read(folder / RUN_FILE, {"store", "scene", "params", "results"})


def finished_run(folder: Path, document: dict[str, Any], store: Store, needed: Sequence[str]) -> FinishedRun:
    """A run with its instances and results.

    document: its run.json. needed: the results that the store must still hold.
    Raises InputError when instances.json is damaged, or one of these is gone.
    """
    instances = _read(folder / "instances.json", {"instances"})
    run = FinishedRun(folder, document, instances, Results(store, document["results"]))
    run.require(needed)
    return run


def _read(file: Path, needed: set[str]) -> dict[str, Any]:
    try:
        document = dict(json.loads(file.read_text(encoding="utf-8")))
    except (OSError, ValueError, TypeError) as error:
        raise InputError(f"{file} is damaged ({error}); run the scene again.") from None
    if not needed <= document.keys():
        raise InputError(f"{file} is damaged: it lacks what a run writes; run the scene again.")
    return document
