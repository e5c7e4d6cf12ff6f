"""What a command may replace: what an earlier one wrote. What else lies there stays."""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ss_flow.cache.files import UNFINISHED
from ss_flow.cache.location import is_url
from ss_flow.cache.plain_json import read_json
from ss_flow.errors import InputError
from ss_flow.tasks.capture.names import spelt
from ss_flow.tasks.deliver.output import OWN_FILES, OWN_FOLDERS, RUN_FILE, check_place, replacing

_LITTER = re.compile(rf"\.DS_Store|Thumbs\.db|desktop\.ini|\._.*|{UNFINISHED.pattern}")
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
    """Raises InputError unless a folder of this kind can be written here, and nothing that is in use is lost by that.

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


def check_outside(folder: Path, store: str | Path) -> None:
    """Raises InputError for a folder to write that is the store, or lies in it. store: its folder, or its URL."""
    if not is_url(store) and _lies_in(os.path.realpath(folder), os.path.realpath(store)):
        raise InputError(f"{folder} lies in the store {store}, which is for results alone; name another with --out.")


@contextmanager
def replacing_own(folder: Path, kind: Written) -> Iterator[Path]:
    """As `replacing`, but what no command wrote in the folder is there afterwards, too, as another name of the file.

    Raises InputError where something of the same name was filled in; all of the folder stays as it was then.
    """

    def keep(filling: Path) -> None:
        for name in others(folder, kind):
            if os.path.lexists(filling / name):
                raise InputError(
                    f"{folder} holds {name}, which no command wrote and a new file would replace; move it away, or "
                    "name another folder with --out."
                )
            (filling / name).parent.mkdir(parents=True, exist_ok=True)
            try:
                os.link(folder / name, filling / name, follow_symlinks=False)
            except OSError:  # a disk that knows no second names
                shutil.copy2(folder / name, filling / name, follow_symlinks=False)

    with replacing(folder, keep) as filling:
        yield filling


def sizes(folder: Path) -> dict[str, int]:
    """The bytes of each file below a folder, by its name from there, with "/"."""
    return {name: (folder / name).stat().st_size for name in _files(folder)}


def others(folder: Path, kind: Written) -> list[str]:
    """The files in a folder that no command wrote as part of it, and links, by their names from there, with "/"."""
    names, listed = _files(folder), _read(folder / kind.mark).get(kind.listing)
    own = {kind.mark, *kind.unlisted, *map(_name, listed or ())}
    if listed is None:  # by an older version
        own |= {name for name in names if name in OWN_FILES or name.partition("/")[0] in OWN_FOLDERS}
    own = set(map(spelt, own))
    return [name for name in names if spelt(name) not in own and not _LITTER.fullmatch(name.rpartition("/")[2])]


def _name(entry: Any) -> str:
    """The file that an entry of a list of files names."""
    return str(entry.get("file") if isinstance(entry, dict) else entry)


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
        document = read_json(file.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return document if isinstance(document, dict) else {}


def _lies_in(place: str, folder: str) -> bool:
    """Whether a place is a folder, or lies in it; both without links."""
    return Path(place).is_relative_to(folder)
