"""What Split makes of depth that was taken by another camera: warped to the photo with holes, or not registered to it.

    python tests/bench/bench_depth.py [--seeds 3] [--views 8]

Rooms of six things, photos of 320x240, masks without network weights. Depth is rendered by a camera of its own, at the
photos' place. Warped: each pixel is carried to the photo's grid, which leaves lines without depth (focal length 1/1.112
of the photo's) or three of four pixels without (half the size); once with these holes open and once as Split closes
them. Unregistered: depth of a shorter focal length or a moved principal point that passes for registered; as it is,
and with calibrate=depth. Printed: mIoU of the masks after Split, mean over the rooms, and each room's.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

from ss_flow.flows.cli.main import main as ss_flow
from ss_flow.flows.generated import Room, RoomParams, generate, write_scene
from ss_flow.flows.generated.layout import furnish
from ss_flow.flows.generated.render import Renderer
from ss_flow.tasks.artifacts import Float32
from ss_flow.tasks.geometry.cameras import camera_of
from ss_flow.tasks.split import segment_rgbd

WIDTH, HEIGHT = 320, 240
RATIO = 585 / 526


def taken(room: Room, params: RoomParams, size: float, focal: float, shift: tuple[float, float]) -> Float32:
    """[K, h, w] exact depth by a camera of `size` times the photos' pixels and `focal` times their focal length, its
    principal point moved by `shift`."""
    renderer = Renderer(furnish(params.objects, np.random.default_rng(params.seed)), params.seed)
    width, height = round(WIDTH * size), round(HEIGHT * size)
    maps = []
    for k in range(len(room)):
        camera = camera_of(room.cameras, k)
        own = replace(
            camera,
            width=width,
            height=height,
            fx=camera.fx * focal,
            fy=camera.fy * focal,
            cx=width / 2 + shift[0],
            cy=height / 2 + shift[1],
        )
        maps.append(renderer.render(own, np.random.default_rng(0))[1])
    return np.stack(maps)


def warped(depth: Float32, focal: float) -> Float32:
    """[K, HEIGHT, WIDTH] depth carried pixel by pixel to the photos' grid; of several the nearest stays."""
    _, h, w = depth.shape
    v, u = np.mgrid[:h, :w] + 0.5
    x = np.floor((u - w / 2) / focal + WIDTH / 2).astype(int)
    y = np.floor((v - h / 2) / focal + HEIGHT / 2).astype(int)
    seen = (x >= 0) & (x < WIDTH) & (y >= 0) & (y < HEIGHT)
    result = np.full((len(depth), HEIGHT, WIDTH), np.inf, np.float32)
    for k, view in enumerate(depth):
        np.minimum.at(result[k], (y[seen], x[seen]), view[seen])
    return np.where(np.isfinite(result), result, 0).astype(np.float32)


def split(scene: Path, store: Path, *more: str) -> tuple[float, list[str]]:
    """The mIoU after Split, and what the run warned of."""
    told = io.StringIO()
    options = ["--set", "split.segmenter=none", "--until", "metrics_split", "--json", "--cache", str(store)]
    with contextlib.redirect_stdout(told), contextlib.redirect_stderr(io.StringIO()):
        ss_flow(["run", str(scene), *options, *more])
    document = json.loads(told.getvalue())
    return document["metrics"]["split"]["miou"], [text for node in document["nodes"] for text in node["warnings"]]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--views", type=int, default=8)
    options = parser.parse_args()
    found: dict[str, list[float]] = {}
    close_holes = segment_rgbd.close_holes
    for seed in range(options.seeds):
        params = RoomParams(objects=6, views=options.views, width=WIDTH, height=HEIGHT, seed=seed, held_out=0)
        room = generate(params)
        cases = {
            "exact": room.depth,
            "warped, lines": warped(taken(room, params, 1, 1 / RATIO, (0, 0)), 1 / RATIO),
            "warped, three of four": warped(taken(room, params, 0.5, 0.5, (0, 0)), 0.5),
            "unregistered, focal length": taken(room, params, 1, 1 / RATIO, (0, 0)),
            "unregistered, shift": taken(room, params, 1, 1, (4, -3)),
            "unregistered, both": taken(room, params, 1, 1 / RATIO, (4, -3)),
        }
        for name, depth in cases.items():
            with tempfile.TemporaryDirectory() as base:
                scene, store = Path(base) / "room", Path(base) / "store"
                write_scene(replace(room, depth=depth), scene)
                found.setdefault(name, []).append(split(scene, store)[0])
                if name.startswith("warped"):
                    segment_rgbd.close_holes = lambda depth: depth
                    # A store of its own: the key does not know of what was put in a function's place.
                    found.setdefault(f"{name}, open", []).append(split(scene, Path(base) / "other")[0])
                    segment_rgbd.close_holes = close_holes
                if name.startswith("unregistered"):
                    miou, warnings = split(scene, store, "--calibrate", "depth")
                    found.setdefault(f"{name}, calibrated", []).append(miou)
                    print(f"room {seed}, {name}: {warnings[0]}", flush=True)
    for name, values in found.items():
        print(f"{name:38s} {np.mean(values):.3f}   {' '.join(f'{v:.3f}' for v in values)}")


if __name__ == "__main__":
    main()
