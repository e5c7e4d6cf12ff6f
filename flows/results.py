"""A finished run, read back: its output folder, and its results in the store."""

from __future__ import annotations

import shlex
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ss_flow.cache.canonical import DIGEST, digests_of
from ss_flow.cache.location import is_url, open_store
from ss_flow.cache.plain_json import read_json
from ss_flow.cache.store import Store
from ss_flow.errors import InputError
from ss_flow.graph import stored
from ss_flow.runs import Run
from ss_flow.tasks.deliver.compressed import Thumbnail
from ss_flow.tasks.deliver.output import RUN_FILE
from ss_flow.tasks.words import first_of

BACKGROUND = 0
GIVEN = ("masks", "hints", "correct")
"""Options of `ss-flow run` that name files beside the capture, as run.json keeps them."""
_OF_INSTANCE = {
    "id", "name", "named_by", "kind", "color", "parent", "parts", "bbox", "centroid", "views", "confidence",
    "num_parts", "num_points", "num_gaussians", "weak", "crumb", "file",
}  # fmt: skip
"""What instances.json says of each."""
_KNOWN = 8
"""Instances that a message names; those whose names hold the word come first."""


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

    def thumbnails(self) -> tuple[Thumbnail, ...]:
        """A small picture of each instance; cut out of the photos where the run kept none; none where they are gone."""
        if not self.missing(("thumbnails",)):
            return tuple(self.all("thumbnails"))
        if self.missing(("ingest", "masks")):
            return ()
        from ss_flow.tasks.deliver.thumbnails import thumbnails

        return thumbnails(self.all("ingest"), self.all("masks"))

    def missing(self, names: Iterable[str]) -> list[str]:
        """Those of these results that the run did not have, or the store no longer holds."""

        def held(name: str) -> bool:
            if name not in self.digests:
                return False
            value = self.digests[name]
            return all(digest in self.store for digest in digests_of(value))

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

    def __repr__(self) -> str:  # not the whole of the documents
        return f"FinishedRun({str(self.folder)!r}, {len(self.results.digests)} results)"

    @property
    def store(self) -> Store:
        return self.results.store

    def require(self, needed: Sequence[str]) -> None:
        """Raises InputError when the store no longer holds one of these results, or an edited run never had it."""
        never = [name for name in needed if name not in self.document["results"]]
        if never and "edit" in self.document:
            raise not_of_an_edit(self.folder, self.document, ", ".join(never))
        if gone := self.results.missing(needed):
            what = f"the store {self.store.location} no longer holds {', '.join(gone)} of {self.folder}"
            raise InputError(f"{what}; {again(self.folder, self.document)}.")

    @property
    def name(self) -> str:
        """What files that are made of it are called."""
        return self.folder.resolve().name

    @property
    def names(self) -> dict[str, str]:
        """Of the instances, by their ids as text."""
        return {str(entry["id"]): entry["name"] for entry in self.instances["instances"]}

    def ids(self, asked: Sequence[str], *, solid: bool = True) -> tuple[int, ...]:
        """The ids of instances given by id or by name, ascending; 0 is the background.

        solid: whether they must have Gaussians. Raises InputError for one that the run does not have, or that has none.
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
                like = sorted(entries, key=lambda entry: word.lower() not in entry["name"].lower())
                known = first_of([f"{entry['id']} ({entry['name']})" for entry in like], _KNOWN)
                where = " (instances.json)" if len(like) > _KNOWN else ""
                raise InputError(
                    f"--instance {word!r} is no instance of {self.folder}; there are 0 (background), {known}{where}."
                )
            if solid and not entry["num_gaussians"]:
                raise InputError(f"instance {entry['id']} ({entry['name']}) of {self.folder} has no Gaussians.")
            found.add(int(entry["id"]))
        return tuple(sorted(found))

    def digests(self, name: str) -> list[str]:
        """Of a result, by its name in run.json; one, or those of a list.

        Raises InputError when the run has no such result, or the store no longer holds it.
        """
        if name not in self.results.digests:
            raise InputError(f"{self.folder} has no result {name!r}; it has {', '.join(self.results.digests)}.")
        self.require([name])
        return digests_of(self.results.digests[name])

    def artifact(self, name: str) -> Any:
        """A result by its name in run.json, as "propagate": an artifact, or a list. Raises as `digests` does."""
        found = [self.store.get(digest) for digest in self.digests(name)]
        return found[0] if isinstance(self.results.digests[name], str) else found

    def show(self, name: str) -> Any:
        """A result for a notebook, drawn with the run's photos and cameras. Raises as `digests` does."""
        from ss_flow.flows.notebook import shown

        return shown(self, name)

    def _repr_html_(self) -> str:
        from ss_flow.flows.notebook import run_html

        return run_html(self)

    def all_ids(self, *, solid: bool = True) -> tuple[int, ...]:
        """The instances that have a file of their own, ascending; unless `solid`, all but crumbs."""
        entries = self.instances["instances"]
        return tuple(sorted(e["id"] for e in entries if (e["file"] if solid else not e["crumb"])))


def of_type(store: Store, run: Run, kind: type) -> list[Any]:
    """What the first step of a run that gives this type gives; empty where none does.

    The flow's own results count before those of other steps, which may have been changed since.
    """
    for digests in (*run.results().values(), *(node["outputs"] for node in run.nodes())):
        if digests and digests[0] in store and isinstance(first := store.get(digests[0]), kind):
            return [first, *(store.get(digest) for digest in digests[1:])]
    return []


def read_run(folder: Path) -> dict[str, Any]:
    """The document run.json of an output folder. Raises InputError when there is none, or it is damaged."""
    if not (folder / RUN_FILE).is_file():
        raise InputError(f"{folder} is not the output folder of a run: it has no {RUN_FILE}.")
    document = _read(folder / RUN_FILE, {"store", "scene", "params", "results"})
    results = document["results"]
    if not isinstance(results, dict) or not all(map(_are_digests, results.values())):
        raise InputError(f"{folder / RUN_FILE} is damaged: its results are no digests; run the scene again.")
    return document


def read_instances(folder: Path) -> dict[str, Any]:
    """The document instances.json of an output folder. Raises InputError when there is none, or it is damaged."""
    file = folder / "instances.json"
    document = _read(file, {"instances", "groups"})
    if not isinstance(document["instances"], list) or not all(map(_is_instance, document["instances"])):
        raise InputError(f"{file} is damaged: an instance lacks what a run writes of it; run the scene again.")
    return document


def _is_instance(entry: Any) -> bool:
    """Whether this says what a run writes of an instance."""
    if not isinstance(entry, dict) or not entry.keys() >= _OF_INSTANCE:
        return False
    return isinstance(entry["id"], int) and isinstance(entry["name"], str) and isinstance(entry["file"], str | None)


def _are_digests(value: Any) -> bool:
    """Whether this is a digest, or a list of them."""
    several = value if isinstance(value, list) else [value]
    return all(isinstance(one, str) and DIGEST.fullmatch(one) for one in several)


def source_of(folder: Path, document: Mapping[str, Any]) -> tuple[Path, str]:
    """The run that an edited run was made of, and what is to be said of it: "" where it is as it was.

    document: the edited run's run.json. The source is looked for where it was, then at the same place as seen from the
    edited run, since both may have been moved together.
    """
    edit = document["edit"]
    places = [Path(edit["source"]), (folder / edit.get("source_from_here", edit["source"])).resolve()]
    source = next((place for place in places if (place / RUN_FILE).is_file()), None)
    if source is None:
        return places[0], "which is no longer there"
    made_of = edit.get("source_content")
    if made_of not in (None, read_run(source).get("content")):
        return source, "which was run anew since, so that other instances may have its ids"
    return source, ""


def source_in_words(folder: Path, document: Mapping[str, Any]) -> str:
    """The same in one phrase."""
    source, remark = source_of(folder, document)
    return f"its source, {source}, {remark}" if remark else f"its source, {source}"


def not_of_an_edit(folder: Path, document: Mapping[str, Any], what: str) -> InputError:
    """What to say where an edited run is asked for something that only its source has. document: its run.json."""
    source = source_in_words(folder, document)
    return InputError(f"{folder} is an edited run, which has no {what} of its own; take {source}.")


def again(folder: Path, document: Mapping[str, Any]) -> str:
    """What to say of how to get the results of an output folder again. document: its run.json."""
    if "edit" in document:
        return f"edit {source_in_words(folder, document)}, again"
    return f"run it again: `{run_command(folder, document)}`{'' if 'set' in document else ' and its other options'}"


def run_command(folder: Path, document: Mapping[str, Any], **given: str) -> str:
    """The command that makes the output folder of a run again, from wherever one stands.

    document: its run.json. given: files to name in the place of those that were given to it, by option.
    """
    files = document.get("given", {}) | {"scene": document.get("given_scene")} | given
    words = ["ss-flow", "run", document["scene"]]
    words += [word for name, path in files.items() if path for word in (f"--{name}", path)]
    words += ["--preset", document["preset"]] if "preset" in document else []
    words += [f"--set={text}" for text in document.get("set", ())]
    words += ["--undistorted"] if any(name.startswith("undistorted/") for name in document.get("files", {})) else []
    return shlex.join([*words, "--out", str(folder.absolute()), "--cache", document["store"]])


def open_finished(folder: str | Path, store: Store | None = None) -> FinishedRun:
    """A finished run by its output folder, to look into from Python.

    store: where its results are; None = where the run says.
    Raises InputError when the folder is not that of a run, or there is no store.
    """
    document = read_run(Path(folder))
    if store is None:
        location = document["store"]
        if not is_url(location) and not Path(location).is_dir():
            raise InputError(f"there is no store {location}, which {folder} names; give another.")
        store = open_store(location if is_url(location) else Path(location))
    return finished_run(Path(folder), document, store, ())


def finished_run(folder: Path, document: dict[str, Any], store: Store, needed: Sequence[str]) -> FinishedRun:
    """A run with its instances and results.

    document: its run.json. needed: the results that the store must still hold.
    Raises InputError when instances.json is damaged, or one of these is gone.
    """
    run = FinishedRun(folder, document, read_instances(folder), Results(store, document["results"]))
    run.require(needed)
    return run


def _read(file: Path, needed: set[str]) -> dict[str, Any]:
    try:
        document = dict(read_json(file.read_text(encoding="utf-8")))
    except (OSError, ValueError, TypeError) as error:
        raise InputError(f"{file} is damaged ({error}); run the scene again.") from None
    if not needed <= document.keys():
        raise InputError(f"{file} is damaged: it lacks what a run writes; run the scene again.")
    return document
