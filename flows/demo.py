"""The scene of `ss-flow demo`."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Literal

from ss_flow.cache.canonical import digest
from ss_flow.closure import code_closure
from ss_flow.errors import InputError
from ss_flow.flows.generated import RoomParams, generate, write_scene
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
    if folder.exists():
        try:
            known = json.loads((folder / RECIPE).read_text())
        except (OSError, ValueError):
            raise InputError(
                f"{folder} holds something else than a demo scene; name another folder with --out."
            ) from None
        if known == recipe:
            return folder
    with replacing(folder) as filling:
        write_scene(generate(params), filling, masks=None if masks == "auto" else masks)
        (filling / RECIPE).write_text(json.dumps(recipe, indent=1), encoding="utf-8")
    return folder
