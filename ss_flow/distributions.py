"""Which installed distributions a module that is imported comes from, and their versions."""

from __future__ import annotations

import functools
import importlib.metadata
import re
from collections.abc import Iterator

ABSENT = "absent"
"""The version of what is not installed."""


def versions_of(module: str) -> dict[str, str]:
    """Versions, by name, of all distributions that hold a top-level module; under its own name where none does.

    OpenCV's `cv2`, for one, is in four distributions, and several of them may be installed over one another.
    """
    found = _distributions().get(module, [])
    return dict(map(_name_and_version, reversed(found))) if found else {module: ABSENT}


@functools.cache
def is_distributed(module: str) -> bool:
    """Whether an installed distribution holds a top-level module; not an editable one, whose version tells nothing."""
    found = _distributions().get(module, [])
    return bool(found) and not any('"editable": true' in (one.read_text("direct_url.json") or "") for one in found)


def version(distribution: str) -> str:
    """The version of an installed distribution."""
    try:
        return importlib.metadata.version(distribution)
    except importlib.metadata.PackageNotFoundError:
        return ABSENT


@functools.cache
def _distributions() -> dict[str, list[importlib.metadata.Distribution]]:
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
    return parts["Name"], parts["Version"]
