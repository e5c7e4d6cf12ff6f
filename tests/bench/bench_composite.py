"""How many things are exactly one instance: Split with a segmenter's masks on generated rooms of composite things.

    python tests/bench/bench_composite.py [--seeds 0 1] [--preset default] [--set STEP.PARAM=VALUE ...]
                                          [--gripper | --sensor | --objects N | --bedroom | --desk | --kitchen | ...]
                                          [--photos] [--lying] [--shaken MM,DEG [--drift]] [--larger FACTOR]
                                          [--dark] [--uneven] [--bent RADIAL] [--focal FACTOR] [--arm]
                                          [--store DIR] [--look DIR]

SS_FLOW_MODELS names the folder of the segmenter's weights. A line for each seed, on the pixels of all views pooled:
whole (the share of things that are one predicted id, which has an IoU of at least 0.5, while no second covers more
than a tenth), mIoU, PQ, over- and under-segmentation, in per cent; the predicted ids, the true things, seconds. Then
for each thing its best IoU, and of how many predicted ids each covers at least a tenth of it. With --store, rooms and
results are kept: a run with other parameters computes only what they change. --look draws photo, truth (parts as
shades) and prediction of some views. With --sensor, rooms have the depth of a camera as the first Kinect. With
--objects, it is a room of so many small things of one piece, in 40 views. With --desk, of small things on a table, in
few near views of a depth sensor; with --bedroom, a bedroom, with --kitchen, a kitchen, with --shelf, a shelf of goods,
with --walk, a table in a garden, with --tote, goods in a heap, with --office, a work place instead
(`tests/support/generated_*.py`). With --photos, from the photos alone: without depth and poses. With --lying, photos
lie on their side, as a phone stores them. With --shaken, poses are off by so many millimetres and degrees (root mean
square), each for itself, or, with --drift, each farther off than the one before. With --larger, depth is so many times
as large as it should be. With --dark, photos are half as bright, blurred and noisy; with --uneven, each has an
exposure and a white balance of its own. With --bent, photos have a first radial distortion of which nothing is said;
with --focal, focal lengths are stated so many times as long as they are. With --arm, an arm reaches into each photo,
elsewhere in each; it is no instance.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
import time
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "support"))
from altered_captures import altered, bend, darken, enlarge, expose_each, lay_down, reach_in, read_image, shake, zoom
from depth_sensor import sensed
from generated_bedroom import generate_bedroom
from generated_desk import generate_desk
from generated_flat import generate_flat
from generated_kitchen import generate_kitchen
from generated_office import generate_office
from generated_orbit import generate_orbit
from generated_shelf import generate_shelf
from generated_tote import generate_tote
from generated_walk import generate_walk

from ss_flow.cache.store import Store
from ss_flow.engine import run_flow
from ss_flow.flows import settings
from ss_flow.flows.cli.context import file_digests
from ss_flow.flows.cli.prepare import RunOptions, prepare
from ss_flow.flows.generated import RoomParams, generate, write_scene
from ss_flow.flows.params import Params
from ss_flow.tasks.artifacts import Frame, LabelMap
from ss_flow.tasks.capture.scene import open_scene
from ss_flow.tasks.evaluate.contingency import Contingency
from ss_flow.tasks.evaluate.instances import evaluate_masks, pooled
from ss_flow.tasks.evaluate.panoptic import pieces, whole
from ss_flow.tasks.geometry.images import decode_rgb, encode_png

ROOM = RoomParams(composite=True, views=24, width=480, height=360, held_out=0)
OTHERS = {
    "bedroom": generate_bedroom,
    "desk": generate_desk,
    "flat": generate_flat,
    "kitchen": generate_kitchen,
    "office": generate_office,
    "orbit": generate_orbit,
    "shelf": generate_shelf,
    "tote": generate_tote,
    "walk": generate_walk,
}
COLUMNS = ("whole", "miou", "pq", "over_segmentation", "under_segmentation")
COUNTS = ("num_predicted", "num_truth")
STEPS = "ingest", "masks_split", "truth"


@dataclass(frozen=True)
class Outcome:
    """What Split made of a room, and what is in it."""

    frames: tuple[Frame, ...]
    truth: tuple[LabelMap, ...]
    predicted: tuple[LabelMap, ...]
    seconds: float


def folder_of(room: RoomParams, place: Path, sensor: bool = False) -> Path:
    """The capture of a room; it is written first where it is not there. sensor: with the depth of a depth camera."""
    folder = place / f"composite-{room.seed}{'-gripper' * room.gripper}{'-sensor' * sensor}"
    if not folder.exists():
        made = generate(room)
        write_scene(sensed(made, room.seed) if sensor else made, folder)
    return folder


def crowded_of(objects: int, seed: int, place: Path) -> Path:
    """The capture of a room of so many small things, likewise."""
    folder = place / f"crowded-{objects}-{seed}"
    if not folder.exists():
        room = RoomParams(objects=objects, views=40, width=640, height=480, seed=seed, held_out=0)
        write_scene(generate(room), folder)
    return folder


def other_of(kind: str, seed: int, place: Path) -> Path:
    """The capture of a bedroom, a desk, a kitchen, a shelf or a garden, likewise."""
    folder = place / f"{kind}-{seed}"
    if not folder.exists():
        write_scene(OTHERS[kind](seed), folder)
    return folder


def capture_of(kind: str, seed: int, place: Path) -> Path:
    """The capture of any kind, likewise; "sensor" is a room with the depth of a camera, "crowded" one of 100 things."""
    if kind == "crowded":
        return crowded_of(100, seed, place)
    if kind in ("room", "sensor"):
        return folder_of(replace(ROOM, seed=seed), place, kind == "sensor")
    return other_of(kind, seed, place)


def outcome(folder: Path, params: Params, store: Store, photos: bool = False) -> Outcome:
    """Run Split on a capture, or on its photos alone, and read what came of it."""
    scene = open_scene(folder / "color" if photos else folder)
    prepared = prepare(scene, params, RunOptions(), file_digests(store))

    def build() -> dict[str, Any]:
        return {name: node for name, node in prepared.build().items() if name in STEPS}

    begun = time.perf_counter()
    values: dict[str, Any] = run_flow(build, store, scene=prepared.name, header={}).values
    seconds = time.perf_counter() - begun
    frames, predicted, *found = (tuple(map(store.get, values[name])) for name in STEPS if name in values)
    if found:  # in the pixels of the frames, out of which a distortion may have been taken
        return Outcome(frames, found[0], predicted, seconds)
    truth = tuple(LabelMap(frame.name, read_image(folder / "instance" / f"{frame.name}.png")) for frame in frames)
    return Outcome(frames, truth, predicted, seconds)


def things(folder: Path, table: Contingency) -> list[str]:
    """A line for each thing: best IoU, predicted ids on at least a tenth of it, whether it is whole."""
    names = json.loads((folder / "instances.json").read_text())
    columns = zip(table.truth_ids, table.best_iou(), pieces(table), whole(table), strict=True)
    return [
        f"| {names[str(i)]} | {100 * iou:.1f} | {count} | {'whole' if one else ''} |" for i, iou, count, one in columns
    ]


def look(found: Outcome, folder: Path, place: Path) -> None:
    """Photo, truth and prediction of every fourth view, and of the close view after it."""
    place.mkdir(parents=True, exist_ok=True)
    colors = np.random.default_rng(3).integers(40, 255, (65536, 3)).astype(np.uint8)
    colors[0] = 0
    rows = []
    for i in [i for i in range(len(found.frames)) if i % 4 < 2]:
        truth = colors[found.truth[i].ids]
        if (file := folder / "part" / f"{found.frames[i].name}.png").exists():
            truth = truth * (1 - 0.12 * (read_image(file) % 6))[..., None]
        row = [decode_rgb(found.frames[i]), truth.astype(np.uint8), colors[found.predicted[i].ids]]
        rows.append(np.hstack(row))
    for page in range(0, len(rows), 4):
        path = place / f"{folder.name}-{page // 4}.png"
        path.write_bytes(encode_png(np.vstack(rows[page : page + 4])).tobytes())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1])
    parser.add_argument("--preset", default="default")
    parser.add_argument("--set", nargs="*", default=[])
    scene = parser.add_mutually_exclusive_group()
    scene.add_argument("--gripper", action="store_true", help="with a gripper before the lens")
    scene.add_argument("--sensor", action="store_true", help="with the depth of a depth camera")
    scene.add_argument("--objects", type=int, help="a room of so many small things")
    for kind in OTHERS:
        scene.add_argument(f"--{kind}", dest="kind", action="store_const", const=kind, help=f"a {kind}, not a room")
    parser.add_argument("--photos", action="store_true", help="from the photos alone")
    parser.add_argument("--lying", action="store_true", help="photos that lie on their side")
    parser.add_argument("--shaken", help="how far poses are off, as in 15,1: millimetres, degrees")
    parser.add_argument("--drift", action="store_true", help="each pose farther than the one before")
    parser.add_argument("--larger", type=float, help="factor on all depth")
    parser.add_argument("--dark", action="store_true", help="dark, noisy photos")
    parser.add_argument("--uneven", action="store_true", help="photos of different exposure")
    parser.add_argument("--bent", type=float, help="first radial distortion coefficient of the photos, not stated")
    parser.add_argument("--focal", type=float, help="factor on the stated focal lengths")
    parser.add_argument("--arm", action="store_true", help="an arm in each photo")
    parser.add_argument("--store", type=Path, help="a store to keep")
    parser.add_argument("--look", type=Path, help="a folder for pictures")
    args = parser.parse_args()
    params = settings.apply(settings.preset(Params(), args.preset), args.set)
    with nullcontext(args.store) if args.store else tempfile.TemporaryDirectory() as kept:
        for seed in args.seeds:
            room = replace(ROOM, seed=seed, gripper=args.gripper)
            if args.objects:
                folder = crowded_of(args.objects, seed, Path(kept))
            elif args.kind:
                folder = other_of(args.kind, seed, Path(kept))
            else:
                folder = folder_of(room, Path(kept), args.sensor)
            if args.lying:
                folder = altered(folder, "lying", lay_down)
            if args.shaken:
                how = "drift" if args.drift else "shaken"
                folder = altered(folder, f"{how}-{args.shaken}", lambda copy: shake(copy, args.shaken, args.drift))
            if args.larger:
                folder = altered(folder, f"larger-{args.larger}", lambda copy: enlarge(copy, args.larger))
            if args.dark:
                folder = altered(folder, "dark", darken)
            if args.uneven:
                folder = altered(folder, "uneven", expose_each)
            if args.bent:
                folder = altered(folder, f"bent-{args.bent}", lambda copy: bend(copy, args.bent))
            if args.focal:
                folder = altered(folder, f"focal-{args.focal}", lambda copy: zoom(copy, args.focal))
            if args.arm:
                folder = altered(folder, "arm", reach_in)
            found = outcome(folder, params, Store(Path(kept)), args.photos)
            values = evaluate_masks(found.predicted, found.truth, None, found.frames).values
            cells = [f"{100 * values[name]:.1f}" for name in COLUMNS] + [f"{values[name]:.0f}" for name in COUNTS]
            print(f"\n| seed | {' | '.join(COLUMNS + COUNTS)} | seconds |")
            print("|---" * (len(cells) + 2) + "|")
            print(f"| {seed} | {' | '.join(cells)} | {found.seconds:.0f} | (load {os.getloadavg()[0]:.1f})\n")
            table = pooled(found.predicted, found.truth, found.frames).without(truth=0, predicted=0)
            print("| thing | best IoU | ids on it | |\n|---|---|---|---|")
            print("\n".join(things(folder, table)), flush=True)
            if args.look:
                look(found, folder, args.look)


if __name__ == "__main__":
    main()
