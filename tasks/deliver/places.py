"""What a command may replace: what an earlier one wrote, and nothing that a user put there."""

from __future__ import annotations

import contextlib
import json
import os
import re
import unicodedata
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ss_flow.cache.files import write_atomically
from ss_flow.cache.location import is_url
from ss_flow.errors import InputError
from ss_flow.tasks.deliver.output import OWN_FILES, OWN_FOLDERS, RUN_FILE, check_place, replacing

BESIDE_FILE = "beside.json"
"""Name -> bytes of what commands wrote into a result's folder after the run: pages, films, exports."""
_LITTER = re.compile(r"\.DS_Store|Thumbs\.db|desktop\.ini|\._.*|\..+\.[0-9a-f]{32}")
"""What file managers leave in any folder, and what a command leaves that is killed while it writes a file."""


@dataclass(frozen=True)
class Written:
    """A kind of folder that commands write. Its file `mark` lists its files: as names, as entries that have a "file",
    or as name -> bytes."""

    mark: str
    what: str
    """An earlier one, in words."""
    unlisted: frozenset[str] = frozenset()
    """Files of it that the mark does not list."""
    listing: str = "files"
    """Where in the mark the list is."""


RESULT = Written(RUN_FILE, "an earlier result")


def check_replaceable(folder: Path, kind: Written, store: str | Path, inputs: Iterable[Path] = ()) -> None:
    """Raises InputError unless a folder of this kind can be written here, and nothing else is lost by that.

    store: its folder, or its URL. inputs: folders and files that the command reads.
    """
    check_place(folder, kind.mark, kind.what)
    check_outside(folder, store)
    place = os.path.realpath(folder)
    if not is_url(store) and _lies_in(os.path.realpath(store), place):
        raise InputError(f"{folder} holds the store {store}, which would be lost; name another folder with --out.")
    if not folder.is_dir():
        return
    for read in inputs:
        if _lies_in(os.path.realpath(read), place):
            raise InputError(f"{folder} holds {read}, which is read here; name another folder with --out.")
    _check_own(folder, kind)


def check_outside(folder: Path, store: str | Path) -> None:
    """Raises InputError for a folder to write that is the store, or lies in it. store: its folder, or its URL."""
    if not is_url(store) and _lies_in(os.path.realpath(folder), os.path.realpath(store)):
        raise InputError(f"{folder} lies in the store {store}, which is for results alone; name another with --out.")


@contextmanager
def replacing_own(folder: Path, kind: Written) -> Iterator[Path]:
    """As `replacing`, but raises InputError where the folder by then holds what no command wrote; all of it stays."""
    with replacing(folder) as filling:
        yield filling
        _check_own(folder, kind)


def note_beside(written: Path) -> None:
    """Where a file or a folder lies in a result's, note that a command wrote it, so that a run may replace it."""
    place = Path(os.path.realpath(written))
    result = next((folder for folder in place.parents if (folder / RUN_FILE).is_file()), None)
    if result is None:
        return
    files = [place / name for name in _files(place)] if place.is_dir() else [place]
    noted = {file.relative_to(result).as_posix(): file.stat().st_size for file in files}
    with contextlib.suppress(OSError):  # then it counts as the user's
        write_atomically(result / BESIDE_FILE, json.dumps(_read(result / BESIDE_FILE) | noted, indent=1))


def sizes(folder: Path) -> dict[str, int]:
    """The bytes of each file below a folder, by its name from there, with "/"."""
    return {name: (folder / name).stat().st_size for name in _files(folder)}


def _check_own(folder: Path, kind: Written) -> None:
    """Raises InputError where a folder holds what no command wrote."""
    listed, noted = _read(folder / kind.mark).get(kind.listing), _read(folder / BESIDE_FILE)
    own = {kind.mark, BESIDE_FILE, *kind.unlisted, *map(_name, listed or ())}
    if listed is None:  # by an older version
        own |= {name for name in _files(folder) if name in OWN_FILES or name.partition("/")[0] in OWN_FOLDERS}
    own = set(map(_spelt, own))
    for name in _files(folder):
        known = _spelt(name) in own or _LITTER.fullmatch(name.rpartition("/")[2])
        if not known and noted.get(name) != (folder / name).lstat().st_size:
            top = f"{name.partition('/')[0]}/"
            whole = top in name and not any(other.startswith(top) for other in own | noted.keys())
            raise InputError(
                f"{folder} holds {top if whole else name}, which is no part of {kind.what}; move it away, or name "
                "another folder with --out."
            )


def _name(entry: Any) -> str:
    """The file that an entry of a list of files names."""
    return str(entry.get("file") if isinstance(entry, dict) else entry)


def _spelt(name: str) -> str:
    """A file name with its accents as one, whichever way the disk that it was on has them."""
    return unicodedata.normalize("NFC", name)


def _files(folder: Path) -> list[str]:
    """All files below a folder, and links to folders, by their names from there, with "/"; in order."""
    found = []
    for place, folders, files in os.walk(folder):
        links = [name for name in folders if os.path.islink(os.path.join(place, name))]
        found += [Path(place, name).relative_to(folder).as_posix() for name in (*files, *links)]
    return sorted(found)


def _read(file: Path) -> dict[str, Any]:
    """A JSON document; empty where there is none, or it is damaged."""
    try:
        document = json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return document if isinstance(document, dict) else {}


def _lies_in(place: str, folder: str) -> bool:
    """Whether a place is a folder, or lies in it; both without links."""
    return Path(place).is_relative_to(folder)
