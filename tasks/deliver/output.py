"""The output folder: everything a user takes away, whole or not at all."""

from __future__ import annotations

import json
import os
import re
import shutil
import uuid
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

from ss_flow.errors import InputError
from ss_flow.tasks.artifacts import Frame, Gaussians, LabelMap
from ss_flow.tasks.capture.lens import Lens
from ss_flow.tasks.capture.photo_pixels import on_photo, photo_pixels
from ss_flow.tasks.deliver import ply
from ss_flow.tasks.geometry.images import encode_png

RUN_FILE = "run.json"


def check_place(folder: Path, mark: str = RUN_FILE, what: str = "an earlier result") -> None:
    """Raises InputError unless an output folder can be written here: a new one, or in the place of an earlier one,
    which holds the file `mark`.

    what: what is written, in words.
    """
    place = Path(os.path.realpath(folder))
    if os.path.lexists(place) and not place.is_dir():  # or a link in a circle
        raise InputError(f"{folder} is a file; --out must name a folder.")
    if folder.is_dir() and any(folder.iterdir()) and not (folder / mark).is_file():
        raise InputError(
            f"{folder} holds something else than {what}, since it has no {mark}; name another folder with --out, or "
            "move this one away."
        )
    _check_nearest(folder, place.parents)


def check_writable(folder: Path) -> None:
    """Raises InputError unless files can be written into this folder, which need not be there yet."""
    place = Path(os.path.realpath(folder))
    _check_nearest(folder, (place, *place.parents))


def check_file(file: Path, instead: str) -> None:
    """Raises InputError unless a file can be written here, in a folder that need not be there yet.

    instead: what the user may do where it cannot, in words.
    """
    if file.is_dir():
        raise InputError(f"{file} cannot be written: it is a folder; {instead}.")
    _check_nearest(file, file.absolute().parents, instead)


def check_named(file: Path, option: str) -> None:
    """Raises InputError unless the file that an option names can be written here, which no file of a result can."""
    instead = f"name another file with {option}"
    folders = Path(os.path.realpath(file)).parents[:2]  # of a file in instances/, the second
    if any(os.path.isfile(folder / RUN_FILE) for folder in folders):
        raise InputError(f"{file} cannot be written: its folder is that of a result; {instead}.")
    check_file(file, instead)


def _check_nearest(what: Path, places: Iterable[Path], instead: str = "name another folder with --out") -> None:
    """Check the first of these places that is there."""
    place = next(p for p in places if p.exists())
    if not place.is_dir() or not os.access(place, os.W_OK):
        raise InputError(f"{what} cannot be written: {place} is not a writable folder; {instead}.")


@contextmanager
def replacing(folder: Path) -> Iterator[Path]:
    """Yield a folder to fill, beside `folder`; when all went well it takes `folder`'s place.

    Of a symbolic link it is the place that it leads to: the link stays.
    A reader sees the old content or the new. After a crash the unfinished folder, whose name begins with a dot, may
    remain; the next run takes it away.
    """
    folder = Path(os.path.realpath(folder))
    folder.parent.mkdir(parents=True, exist_ok=True)
    unfinished = re.compile(rf"\.{re.escape(folder.name)}\.[0-9a-f]{{8}}(\.old)?\.partial")
    for stale in folder.parent.iterdir():
        if unfinished.fullmatch(stale.name):
            shutil.rmtree(stale, ignore_errors=True)
    filling = folder.parent / f".{folder.name}.{uuid.uuid4().hex[:8]}.partial"
    filling.mkdir()
    try:
        yield filling
        if folder.exists():
            old = filling.with_suffix(".old.partial")
            folder.rename(old)
            filling.rename(folder)
            shutil.rmtree(old)
        else:
            filling.rename(folder)
    finally:
        shutil.rmtree(filling, ignore_errors=True)


def write_scene(folder: Path, scene: Gaussians, instances: Mapping[str, Any]) -> None:
    """Write scene.ply, scene_labeled.ply, instances.json, and a PLY file for every instance that it names one for."""
    ply.write_gaussians(folder / "scene.ply", scene)
    ply.write_gaussians(folder / "scene_labeled.ply", scene, labelled=True)
    (folder / "instances.json").write_text(json.dumps(instances, indent=1), encoding="utf-8")
    (folder / "instances").mkdir()
    for entry in instances["instances"]:
        if entry["file"]:
            own = scene.instance_id == entry["id"]
            one = replace(scene, **{f.name: getattr(scene, f.name)[own] for f in fields(scene)})
            ply.write_gaussians(folder / entry["file"], one, labelled=True)


def write_masks(
    stages: Mapping[Path, Sequence[LabelMap]], frames: Sequence[Frame], lenses: Sequence[Lens | None]
) -> None:
    """Write one uint16 PNG of instance ids per frame and folder, in the pixels of the input photo.

    stages: the maps of all frames by the folder to write. lenses: what `photo_lens` gives for each frame; where there
    is one, its distortion is put back, and pixels of the photo that the frame does not show are 0.
    """
    alike: dict[tuple[Lens | None, int, int], list[int]] = {}
    for row, (frame, lens) in enumerate(zip(frames, lenses, strict=True)):
        alike.setdefault((lens, frame.width, frame.height), []).append(row)
    for folder, maps in stages.items():
        if len(maps) != len(frames):
            raise ValueError(f"{len(maps)} maps for {folder.name} of {len(frames)} frames")
        folder.mkdir()
    for (lens, *_), rows in alike.items():
        pixels = None if lens is None else photo_pixels(frames[rows[0]], lens)
        for folder, maps in stages.items():
            for row in rows:
                frame, ids = frames[row], maps[row].ids
                full = on_photo(ids, frame, pixels)
                (folder / f"{frame.name}.png").write_bytes(encode_png(full).tobytes())
