"""What captures and their views are called, and which files belong together by their names."""

from __future__ import annotations

import itertools
import re
import unicodedata
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path, PurePath

from ss_flow.errors import InputError


def named_after(path: Path) -> Path:
    """The folder or file that a capture is called after, resolved: for a transforms.json, as all of nerfstudio's
    captures have one, its folder."""
    return (path.parent if path.name == "transforms.json" else path).resolve()


def capture_name(path: Path) -> str:
    """What a capture is called: a folder by its name, a file by its stem."""
    place = named_after(path)
    return place.name if place.is_dir() else place.stem


def natural_key(text: str) -> tuple[tuple[int, int, str], ...]:
    """Sort key under which "2.jpg" comes before "10.jpg"."""
    # Digits are 0 to 9, unlike those of `str.isdigit`, of which int() does not read all, such as a superscript 2.
    parts = (part for part in re.split(r"([0-9]+)", text) if part)
    return tuple((0, int(part), "") if part[0] in "0123456789" else (1, 0, part) for part in parts)


def by_stem(paths: list[Path]) -> dict[str, Path]:
    """Files by their stem.

    Raises InputError when two share one.
    """
    return by_name([p.stem for p in paths], paths)


def by_name(names: Sequence[str], paths: Sequence[Path]) -> dict[str, Path]:
    """Files by the names of the views that they belong to.

    Raises InputError when two have one name.
    """
    found: dict[str, Path] = {}
    for name, path in zip(names, paths, strict=True):
        if found.get(name) == path:
            raise InputError(f"{path} is listed twice; every view needs a photo of its own.")
        if name in found:
            raise InputError(f"{found[name]} and {path} both belong to view {name}; every view needs its own stem.")
        found[name] = path
    return found


def spelt(name: str) -> str:
    """A name with each accent in one piece with its letter: a Mac may write the same letters otherwise."""
    return unicodedata.normalize("NFC", name)


def finder(names: Iterable[str]) -> Callable[[str], str | None]:
    """Says which of some names another is, whichever way both write accents: the same one, else one spelt alike."""
    known = {spelt(name): name for name in names} | {name: name for name in names}
    return lambda name: known.get(name) or known.get(spelt(name))


def view_names(photos: Sequence[PurePath], left_out: Sequence[PurePath] = ()) -> dict[PurePath, str]:
    """What views are called, by their photos: their stems; where photos in several folders have one stem, as those of
    a rig's cameras do, all bear the folders below the one that holds them: `cam1_image0001`.

    left_out: photos that are called likewise, but give no view.
    """
    files = [*photos, *left_out]
    if len({p.stem for p in photos}) == len(photos) or len({p.parent for p in photos}) == 1:
        return {p: p.stem for p in files}
    folders = {p.parent.parts for p in files}
    shared = next(i for i, parts in enumerate(itertools.zip_longest(*folders)) if len(set(parts)) > 1)
    return {p: "_".join([*p.parent.parts[shared:], p.stem]) for p in files}
