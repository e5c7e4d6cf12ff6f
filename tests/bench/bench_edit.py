"""How well an edit of a generated room agrees with the room generated anew with that change.

    ss-flow demo --out DEMO --masks truth [--objects 6 --views 12]
    python tests/bench/bench_edit.py DEMO [--cache STORE] [--pictures DIR] [--only CHANGE]

For every small thing: removed, removed and filled, moved by 30 cm in the air, given another colour with its light and
shade. The changed region is where the true pictures before and after differ by more than 8 of 255 in any channel,
widened by two pixels; it holds the shadows of what has left, which the edit cannot know. PSNR in it of the edited
scene against the changed room (`edited`), and for comparison of the scene before against the room before (`before`).
`elsewhere` is the PSNR of the rendering after against that before, outside of the region. The views are those of the
capture and those kept back.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from ss_flow.cache.store import Store
from ss_flow.flows.demo import RECIPE
from ss_flow.flows.edit import open_edit, run_edit
from ss_flow.flows.generated import RoomParams, generate
from ss_flow.flows.generated.layout import COLORS, Thing, furnish
from ss_flow.flows.generated.render import Renderer
from ss_flow.tasks.artifacts import Gaussians
from ss_flow.tasks.gaussians.render import render
from ss_flow.tasks.geometry.cameras import camera_of

UNDERGROUND = (0.0, 0.0, -50.0)
"""Where a thing goes that is removed: the others keep their texture."""
AWAY = (0.0, 0.0, 0.3)


class Quiet:
    """A generator without noise."""

    def normal(self, mean: float, deviation: float, shape: Any) -> np.ndarray:
        return np.full(shape, mean)


def photos(things: list[Thing], seed: int, cameras: list[Any]) -> np.ndarray:
    renderer = Renderer(things, seed)
    return np.stack([renderer.render(camera, Quiet())[0] for camera in cameras])


def renders(scene: Gaussians, cameras: list[Any]) -> np.ndarray:
    images = np.stack([render(scene, camera).rgb for camera in cameras])
    return np.rint(255 * images.clip(0, 1)).astype(np.uint8)


def psnr(a: np.ndarray, b: np.ndarray, region: np.ndarray) -> float:
    error = (a[region].astype(np.float64) - b[region]) ** 2
    return 10 * float(np.log10(255**2 / max(error.mean(), 1e-6))) if region.any() else float("nan")


def changed(before: np.ndarray, after: np.ndarray) -> np.ndarray:
    differ = (np.abs(before.astype(int) - after) > 8).any(axis=-1)
    return np.stack([cv2.dilate(mask.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0 for mask in differ])


def ids_of(demo: Path) -> dict[int, int]:
    """The instance of the result that each true one is, by the masks of all views."""

    def stack(folder: Path) -> np.ndarray:
        return np.stack([cv2.imread(str(path), -1) for path in sorted(folder.iterdir())]).astype(np.int64)

    truth, found = stack(demo / "scene" / "instance"), stack(demo / "result" / "masks")
    both = np.zeros((truth.max() + 1, found.max() + 1))
    np.add.at(both, (truth, found), 1)
    iou = both / (both.sum(axis=1, keepdims=True) + both.sum(axis=0) - both)
    return {i: int(iou[i, 1:].argmax()) + 1 for i in range(1, len(iou)) if iou[i, 1:].max() >= 0.5}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("demo", type=Path)
    parser.add_argument("--cache", type=Path)
    parser.add_argument("--pictures", type=Path)
    parser.add_argument("--only", help="one change, such as recoloured")
    options = parser.parse_args()
    params = RoomParams(**json.loads((options.demo / "scene" / RECIPE).read_text())["room"])
    things = list(furnish(params.objects, np.random.default_rng(params.seed)))
    room = generate(params)
    cameras = [camera_of(c, k) for c in (room.cameras, room.held_out.cameras) for k in range(len(c))]
    result = options.demo / "result"
    document = json.loads((result / "run.json").read_text())
    store = Store(options.cache or Path(document["store"]))
    scene = store.get(document["results"]["scene"])
    true_before, before = photos(things, params.seed, cameras), renders(scene, cameras)
    found = ids_of(options.demo)
    print("thing, change, share of pixels changed, before, edited, elsewhere (dB), filled, unmeasured pixels")
    for thing in [t for t in things if t.instance_id > 3 and t.instance_id in found]:
        own, row = found[thing.instance_id], things.index(thing)
        other = next(name for name in COLORS if name not in (thing.color, "black"))
        luma = np.array(thing.material.shades) @ (0.2126, 0.7152, 0.0722)
        shades = tuple(tuple(round(c * share) for c in COLORS[other]) for share in luma / luma.max())
        painted = replace(thing.material, shades=shades)
        recoloured = replace(thing, material=painted)
        gone = replace(thing, mesh=thing.mesh.moved(*UNDERGROUND))
        lifted = replace(thing, mesh=thing.mesh.moved(*AWAY))
        for change, anew, operation in (
            ("removed", gone, {"op": "remove", "instances": own}),
            ("removed, filled", gone, {"op": "remove", "instances": own, "fill": True}),
            ("moved", lifted, {"op": "transform", "instances": own, "move": list(AWAY)}),
            ("moved, filled", lifted, {"op": "transform", "instances": own, "move": list(AWAY), "fill": True}),
            ("recoloured", recoloured, {"op": "recolour", "instances": own}),
        ):
            if options.only not in (None, change):
                continue
            true_after = photos([*things[:row], anew, *things[row + 1 :]], params.seed, cameras)
            if change == "recoloured":
                mask = np.concatenate([room.ids, room.held_out.ids]) == thing.instance_id
                operation["color"] = [int(c) for c in np.rint(true_after[mask].mean(axis=0))]
            script = {"operations": [operation]}
            edit = open_edit(result, script, store)
            told = run_edit(edit, store, options.demo / "edited", jobs=1)
            after = renders(store.get(told["results"]["scene"]), cameras)
            region = changed(true_before, true_after)
            hole = told["edit"]["holes"][0]["unmeasured"] if told["edit"]["holes"] else 0
            print(
                f"{thing.name}, {change}, {region.mean():.3f}, {psnr(before, true_before, region):.1f}, "
                f"{psnr(after, true_after, region):.1f}, {psnr(after, before, ~region):.1f}, "
                f"{told['edit']['num_filled']}, {hole}",
                flush=True,
            )
            if options.pictures:
                options.pictures.mkdir(parents=True, exist_ok=True)
                view = int(region.mean(axis=(1, 2)).argmax())
                row_of = np.concatenate([before[view], true_after[view], after[view]], axis=1)
                name = f"{thing.name} {change}".replace(" ", "_").replace(",", "")
                cv2.imwrite(str(options.pictures / f"{name}.png"), row_of[..., ::-1])


if __name__ == "__main__":
    main()
