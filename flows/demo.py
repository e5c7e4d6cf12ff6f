"""Generated rooms on disk: the scene of `ss-flow demo`, and those that tables are measured on."""

from __future__ import annotations

import functools
import json
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, Literal

from ss_flow.cache.canonical import digest
from ss_flow.closure import code_closure
from ss_flow.errors import InputError
from ss_flow.flows.generated import RoomParams, generate, write_scene
from ss_flow.flows.generated.annotations import write_clicks, write_labels, write_scan
from ss_flow.flows.reproduce import CLICKS
from ss_flow.tasks.deliver.output import replacing

RECIPE = "recipe.json"


def demo_scene(out: Path, masks: Literal["auto", "truth", "degraded"], objects: int, views: int, seed: int) -> Path:
    """Build the room's capture in `out`/scene, unless the same one lies there. Returns its folder.

    Raises InputError when `out` holds something else.
    """
    folder = out / "scene"
    params = RoomParams(objects=objects, views=views, seed=seed)
    recipe = {
        "room": asdict(params),
        "masks": masks,
        "code": digest(code_closure(generate) | code_closure(write_scene)),
    }

    def fill(filling: Path) -> None:
        write_scene(generate(params), filling, masks=None if masks == "auto" else masks)

    return _built(folder, recipe, fill)


def generated_scenes(out: Path, rooms: Sequence[RoomParams], masks: Literal["auto", "truth", "degraded"]) -> None:
    """Build rooms that have all that tables are measured by, in `out`/room-SEED, unless the same ones lie there.

    Beside the capture itself: the annotated scan in ScanNet's files, the labels of three views in LERF-OVS's, and
    clicks on every object in the views that show most of it. Raises InputError when `out` holds something else.
    """
    for params in rooms:
        folder = out / f"room-{params.seed}"
        code = digest(code_closure(_annotated))
        recipe = {"room": asdict(params), "masks": masks, "code": code}
        _built(folder, recipe, functools.partial(_annotated, params, masks, folder.name))


def _annotated(params: RoomParams, masks: Literal["auto", "truth", "degraded"], name: str, filling: Path) -> None:
    room = generate(params)
    write_scene(room, filling, masks=None if masks == "auto" else masks)
    write_scan(room, filling, name)
    write_labels(room, filling, [i * len(room) // 3 for i in range(3)])
    write_clicks(room, filling / CLICKS)


def _built(folder: Path, recipe: dict[str, Any], fill: Callable[[Path], None]) -> Path:
    """A folder that `fill` writes, unless it is already there by the same recipe."""
    if folder.exists():
        try:
            known = json.loads((folder / RECIPE).read_text())
        except (OSError, ValueError):
            raise InputError(
                f"{folder} holds something else than a generated scene; name another folder with --out."
            ) from None
        if known == recipe:
            return folder
    with replacing(folder) as filling:
        fill(filling)
        (filling / RECIPE).write_text(json.dumps(recipe, indent=1), encoding="utf-8")
    return folder
