"""The output folder: everything a user takes away, whole or not at all."""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import re
import shutil
import time
import uuid
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from ss_flow.cache.errors import StoreFailure
from ss_flow.cache.files import AT_WORK_SECONDS, hidden
from ss_flow.errors import InputError, OutputFailure
from ss_flow.tasks.artifacts import Frame, Gaussians, LabelMap
from ss_flow.tasks.capture.lens import Lens
from ss_flow.tasks.capture.photo_pixels import on_photo, photo_pixels
from ss_flow.tasks.deliver import ply
from ss_flow.tasks.gaussians.initialise import select
from ss_flow.tasks.geometry.images import encode_png

RUN_FILE = "run.json"
OWN_FILES = {RUN_FILE, "report.html", "instances.json", "descriptors.npz", "descriptors.png"}
OWN_FILES |= {"scene.ply", "scene_labeled.ply", "cloud_labeled.ply"}
OWN_FOLDERS = {"instances", "masks", "masks_split", "undistorted"}
"""What a result consists of; other files beside these are the user's."""


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
    """Raises InputError unless the file that an option names can be written here, which those of a result cannot."""
    instead = f"name another file with {option}"
    place = Path(os.path.realpath(file))
    own = place.parent if place.name in OWN_FILES else place.parents[1] if place.parent.name in OWN_FOLDERS else None
    if own and (own / RUN_FILE).is_file():
        raise InputError(f"{file} cannot be written: it is part of a result; {instead}.")
    check_file(file, instead)


def _check_nearest(what: Path, places: Iterable[Path], instead: str = "name another folder with --out") -> None:
    """Check the first of these places that is there."""
    place = next(p for p in places if p.exists())
    if not place.is_dir() or not os.access(place, os.W_OK):
        raise InputError(f"{what} cannot be written: {place} is not a writable folder; {instead}.")


@contextmanager
def writing_output(place: Path) -> Iterator[None]:
    """Within this, an OSError becomes the OutputFailure of this place; not one that says already what to do."""
    try:
        yield
    except (StoreFailure, OutputFailure):
        raise
    except OSError as error:
        raise OutputFailure(
            f"the output {place} cannot be written: {error.strerror or error}; what was computed is kept, run again "
            "when there is room and permission."
        ) from error


@contextmanager
def replacing(folder: Path, keep: Callable[[Path], None] = lambda filling: None) -> Iterator[Path]:
    """Yield a folder to fill, beside `folder`; when all went well it takes `folder`'s place.

    Of a symbolic link it is the place that it leads to: the link stays.

    keep: called with what was filled, just before that takes the place of `folder`, which stays the same meanwhile.

    Raises OutputFailure for every OSError, also one that is raised while the folder is filled.

    Notes
    -----
    *Readers* see the old content or the new, or for the moment between two renames none.

    *Crash.* The unfinished folder, whose name begins with a dot, may remain, and the old content beside it under such a
    name; the next call puts the old content back where there is none, and takes away the rest.

    *Several at once*, on one machine, fill a folder each, which they hold locked; the last to end stays. They begin and
    end one after the other, while they hold the folder above locked.
    """
    with contextlib.ExitStack() as stack:
        stack.enter_context(writing_output(folder))
        folder = Path(os.path.realpath(folder))
        folder.parent.mkdir(parents=True, exist_ok=True)
        filling = folder.parent / f"{hidden(folder.name)}.{uuid.uuid4().hex[:8]}.partial"
        old = filling.with_suffix(".old.partial")
        with _locked(folder.parent):
            _tidy(folder)
            filling.mkdir()
            stack.callback(shutil.rmtree, filling, ignore_errors=True)
            stack.enter_context(_locked(filling))
        yield filling
        with _locked(folder.parent):
            keep(filling)
            try:
                with contextlib.suppress(FileNotFoundError):
                    folder.rename(old)
                filling.rename(folder)
            except BaseException:  # Ctrl-C, too
                if old.exists() and not folder.exists():
                    old.rename(folder)
                raise
        shutil.rmtree(old, ignore_errors=True)


@contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Within this, nobody else on this machine holds the folder locked; where the file system has locks."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        with contextlib.suppress(OSError):
            fcntl.flock(handle, fcntl.LOCK_EX)
        yield
    finally:
        os.close(handle)


def _tidy(folder: Path) -> None:
    """Clear away what calls of `replacing` left that were killed."""
    unfinished = re.compile(rf"{re.escape(hidden(folder.name))}\.([0-9a-f]{{8}})(\.old)?\.partial")
    for left in list(folder.parent.iterdir()):
        found = unfinished.fullmatch(left.name)
        if found is None or _is_filled(folder.parent / f"{hidden(folder.name)}.{found[1]}.partial"):
            continue
        if found[2] and not folder.exists():
            with contextlib.suppress(OSError):  # another one has put its content there just now
                left.rename(folder)
        else:
            shutil.rmtree(left, ignore_errors=True)


def _is_filled(filling: Path) -> bool:
    """Whether a living process fills this folder; where the file system has no locks, by age."""
    try:
        handle = os.open(filling, os.O_RDONLY)
    except OSError:
        return False
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        return False
    except BlockingIOError:
        return True
    except OSError:
        return time.time() - os.fstat(handle).st_mtime < AT_WORK_SECONDS
    finally:
        os.close(handle)


def write_scene(folder: Path, scene: Gaussians, instances: Mapping[str, Any]) -> None:
    """Write scene.ply, scene_labeled.ply, instances.json, and a PLY file for every instance that it names one for."""
    ply.write_gaussians(folder / "scene.ply", scene)
    ply.write_gaussians(folder / "scene_labeled.ply", scene, labelled=True)
    (folder / "instances.json").write_text(json.dumps(instances, indent=1), encoding="utf-8")
    (folder / "instances").mkdir()
    for entry in instances["instances"]:
        if entry["file"]:
            own = select(scene, scene.instance_id == entry["id"])
            ply.write_gaussians(folder / entry["file"], own, labelled=True)


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
