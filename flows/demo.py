"""Generated rooms on disk: the scene of `ss-flow demo`, and those that tables are measured on.

A room is photographed by a task, so its files come from the store whatever the folder that they are written to.
"""

from __future__ import annotations

import json
import tempfile
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path, PurePosixPath
from typing import Any, Literal

import numpy as np

from ss_flow.cache.store import Store
from ss_flow.engine import Report, Request, run_flows
from ss_flow.errors import InputError
from ss_flow.events import Reporter
from ss_flow.flows.generated import RoomParams, generate, write_scene
from ss_flow.resolution import Failure
from ss_flow.task import task
from ss_flow.tasks.artifacts import UInt8
from ss_flow.tasks.deliver.output import replacing
from ss_flow.tasks.deliver.places import Written, others, sizes

RECIPE = "recipe.json"
SCENE = Written(RECIPE, "the room", listing="names")

Masks = Literal["auto", "truth", "degraded"]


@dataclass(frozen=True)
class CaptureFile:
    """One file of a capture."""

    name: str
    """Its place in the capture's folder, with "/"."""
    content: UInt8
    """[bytes]."""


@task(name="demo.photographs")
def photographs(*, room: RoomParams, masks: Masks, annotated: str) -> tuple[CaptureFile, ...]:
    """Build a room and take its photos: the files of its capture, by name.

    masks: ready-made ones that lie beside the photos; "auto" is none. annotated: the name of the scan under which the
    capture also has all that tables are measured by, see `generated_scene`; "" leaves that out.
    """
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        built = generate(room)
        write_scene(built, folder, masks=None if masks == "auto" else masks)
        if annotated:
            from ss_flow.flows.generated.annotations import write_clicks, write_labels, write_scan
            from ss_flow.flows.reproduce import CLICKS

            write_scan(built, folder, annotated)
            write_labels(built, folder, [i * len(built) // 3 for i in range(3)])
            write_clicks(built, folder / CLICKS)
        return tuple(
            CaptureFile(file.relative_to(folder).as_posix(), np.fromfile(file, np.uint8))
            for file in sorted(folder.rglob("*"))
            if file.is_file()
        )


def generated_scene(
    folder: Path,
    room: RoomParams,
    masks: Masks,
    store: Store,
    reporter: Reporter,
    engine: Mapping[str, Any],
    *,
    annotated: bool = False,
) -> bool:
    """Have a room's capture in a folder; where the same one lies there already, no file is touched.

    reporter: hears of the photographing. engine: options of `run_flows`; in a dry run nothing is written. annotated:
    with all that tables are measured by: the annotated scan in ScanNet's files, the labels of three views in
    LERF-OVS's, and clicks on every object in the views that show most of it.
    Returns whether the capture is there. Raises InputError when the folder holds something else, or more.
    """
    known = _recipe(folder) if folder.exists() else None
    there = False

    def done(report: Report) -> None:
        nonlocal there
        if engine["dry"] and isinstance(report.values["files"], Failure):
            return
        digests = report.succeeded()["files"]
        recipe = {"room": asdict(room), "files": list(digests)}
        there = isinstance(known, dict) and all(known.get(part) == value for part, value in recipe.items())
        if there or engine["dry"]:
            return
        if isinstance(known, dict) and SCENE.listing in known and (beside := others(folder, SCENE)):
            raise InputError(f"{folder} holds {beside[0]}, which is no part of {SCENE.what}; move it away.")
        with replacing(folder) as filling:
            for digest in digests:
                _write(store.get(digest), filling)
            recipe[SCENE.listing] = list(sizes(filling))
            (filling / RECIPE).write_text(json.dumps(recipe, indent=1), encoding="utf-8")
        there = True

    def build() -> dict[str, Any]:
        return {"files": photographs(room=room, masks=masks, annotated=folder.name if annotated else "")}

    request = Request(build, str(folder.resolve()), reporter=reporter, done=done)
    run_flows([request], store, recorded=False, **engine)
    return there


def _recipe(folder: Path) -> Any:
    """What was written to a folder. Raises InputError when that was not a generated scene."""
    try:
        return json.loads((folder / RECIPE).read_text())
    except (OSError, ValueError):
        raise InputError(
            f"{folder} holds something else than a generated scene; name another folder with --out."
        ) from None


def _write(file: CaptureFile, folder: Path) -> None:
    """Raises InputError for a name that leads out of the folder: the store may be someone else's."""
    name = PurePosixPath(file.name)
    if name.is_absolute() or ".." in name.parts:
        raise InputError(f"the store holds a capture with a file {file.name!r} outside of it; use another store.")
    place = folder / name
    place.parent.mkdir(parents=True, exist_ok=True)
    file.content.tofile(place)
