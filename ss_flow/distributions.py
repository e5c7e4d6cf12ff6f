"""Which installed distributions a module that is imported comes from, and their versions."""

from __future__ import annotations

import functools
import importlib.metadata
import importlib.util
import os
import re
import sys
import sysconfig
from collections.abc import Iterator
from pathlib import Path

from ss_flow.errors import ExecutorLost

Changes = tuple[int, ...]
_PYTHON = [Path(sysconfig.get_path(name)) for name in ("stdlib", "platstdlib")]
_SITE = ("site-packages", "dist-packages")
"""Where distributions are installed without a list of their files."""
ABSENT = "absent"
"""The version of what is not installed."""


def versions_of(module: str, changes: Changes = ()) -> dict[str, str]:
    """Versions, by name, of all distributions that hold a top-level module; under its own name where none does.

    OpenCV's `cv2`, for one, is in four distributions, and several of them may be installed over one another.
    changes: those since this process asked first; () = as it was then, since what is loaded stays as it is.
    """
    found = (_read(changes) if changes else _distributions()).get(module, [])
    return dict(map(_name_and_version, reversed(found))) if found else {module: ABSENT}


def changes() -> Changes:
    """Whether anything was installed or removed since this process asked first: () if not, else when it was."""
    now = tuple(map(_time_of_change, _folders()[0]))
    return () if now == _folders()[1] else now


@functools.cache
def is_distributed(module: str) -> bool:
    """Whether a top-level module is Python's own, or that of an installed distribution, whose version tells of an edit.

    An editable one's does not, nor that of one whose sources are beside what was put down when it was built; and a
    module of the same name that is found before it is another one.
    """
    places = _places_of(module)
    if module in sys.stdlib_module_names:
        folders = _PYTHON
    else:
        found = _distributions().get(module, [])
        folders = [Path(str(one.locate_file(""))) for one in found]
        if not found or any(map(_tells_nothing, found)):
            return False
    return all(any(place.is_relative_to(folder) for folder in folders) for place in places)


def _tells_nothing(distribution: importlib.metadata.Distribution) -> bool:
    """Whether the version stays as it is when the sources are edited."""
    if '"editable": true' in (distribution.read_text("direct_url.json") or ""):
        return True
    folder = Path(str(distribution.locate_file("")))
    is_installed = folder.name in _SITE or folder.suffix == ".egg" or distribution.read_text("RECORD") is not None
    return not is_installed and distribution.read_text("PKG-INFO") is not None


def _places_of(module: str) -> list[Path]:
    """Where a top-level module is found; nothing for one that is nowhere, or in the interpreter."""
    try:
        spec = importlib.util.find_spec(module)
    except (ImportError, ValueError):
        return []
    if spec is None:
        return []
    if spec.has_location and spec.origin:
        return [Path(spec.origin)]
    return [Path(folder) for folder in spec.submodule_search_locations or ()]


def version(distribution: str) -> str:
    """The version of an installed distribution."""
    try:
        return importlib.metadata.version(distribution)
    except importlib.metadata.PackageNotFoundError:
        return ABSENT


@functools.cache
def _distributions() -> dict[str, list[importlib.metadata.Distribution]]:
    """Those that were installed when this was asked first."""
    return _read(())


@functools.cache
def _folders() -> tuple[tuple[Path, ...], Changes]:
    """The folders that they are in, and when these were changed last."""
    found = {Path(str(one.locate_file(""))) for several in _distributions().values() for one in several}
    return tuple(found), tuple(map(_time_of_change, found))


def _time_of_change(folder: Path) -> int:
    try:
        return os.stat(folder).st_mtime_ns
    except OSError:
        return 0


@functools.lru_cache(maxsize=1)
def _read(changes: Changes) -> dict[str, list[importlib.metadata.Distribution]]:
    """Distributions by top-level module; of one that is installed twice, both, the one that is imported first.

    `importlib.metadata.packages_distributions` says the same, after a third of a second.
    """
    found: dict[str, list[importlib.metadata.Distribution]] = {}
    for distribution in importlib.metadata.distributions():
        for module in set(_top_level(distribution)):
            found.setdefault(module, []).append(distribution)
    return found


def _top_level(distribution: importlib.metadata.Distribution) -> Iterator[str]:
    declared = distribution.read_text("top_level.txt")
    if declared is not None:
        yield from declared.split()
        return
    yield from _FIRST.findall(distribution.read_text("RECORD") or "")


_FIRST = re.compile(r"^[^/,.\n]+", re.MULTILINE)
"""The top-level module or folder that a line of RECORD is about."""
_HEADER = re.compile(r"^(Name|Version): *(.+?) *$", re.MULTILINE)


@functools.cache
def _name_and_version(distribution: importlib.metadata.Distribution) -> tuple[str, str]:
    """Of its metadata only the two lines: parsing the whole takes longer than all the rest."""
    header = (distribution.read_text("METADATA") or distribution.read_text("PKG-INFO") or "").partition("\n\n")[0]
    parts = dict(_HEADER.findall(header))
    if not {"Name", "Version"} <= parts.keys():
        raise ExecutorLost(
            f"a package in {distribution.locate_file('')} was updated or removed since this process began: start anew."
        )
    return parts["Name"], parts["Version"]
