"""How long Split's propagation takes: seconds, memory, and nanoseconds a (point, view) pair beside reading them once.

    python tests/bench/bench_split.py [--views 100] [--points 100000] [--width 640] [--height 480] [--preset default]

A generated room of 50 objects with degraded masks (some missed, some in pieces, ragged borders), photographed from as
many places as `--views` says, up to `--distinct`; more views are these again. What Split makes of a view goes into a
store, as in a run, and is read from it view by view. The yardstick is one pass over what the pairs are made of:
reading every visible point's index, pixel and depth once.
"""

from __future__ import annotations

import argparse
import cProfile
import os
import pstats
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
from clouds import even_cloud

from ss_flow.cache.store import Store
from ss_flow.execute import Stream
from ss_flow.flows import settings
from ss_flow.flows.generated import Room, RoomParams, generate
from ss_flow.flows.generated.masks import DegradeParams, degrade
from ss_flow.flows.params import Params
from ss_flow.tasks.artifacts import DepthMap
from ss_flow.tasks.geometry.cameras import backproject, camera_of
from ss_flow.tasks.geometry.clustering import nearest_spacing
from ss_flow.tasks.geometry.visibility import VisibilityParams
from ss_flow.tasks.masks.pool import masks_by_id
from ss_flow.tasks.split.observe import observe
from ss_flow.tasks.split.propagate import propagate
from ss_flow.tasks.split.visibility import visibility


def peak_mb() -> float:
    """The largest resident memory of this process since the last `reset_peak`."""
    status = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
    return int(status["VmHWM"].split()[0]) / 1024


def reset_peak() -> None:
    Path("/proc/self/clear_refs").write_text("5")


def sampled(room: Room, count: int) -> tuple[np.ndarray, np.ndarray]:
    """So many points of the room's surfaces, at most one in each cube of 6 mm, and their colours."""
    points, colors = [], []
    for k in range(len(room)):
        points.append(backproject(room.depth[k], camera_of(room.cameras, k))[::7])
        colors.append(room.rgb[k].reshape(-1, 3)[::7])
    every, color = np.concatenate(points), np.concatenate(colors)
    _, first = np.unique(np.floor(every / 0.006).astype(np.int64), axis=0, return_index=True)
    chosen = np.sort(np.random.default_rng(0).permutation(first)[:count])
    return every[chosen].astype(np.float32), color[chosen]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--views", type=int, default=100)
    parser.add_argument("--points", type=int, default=100_000)
    parser.add_argument("--width", type=int, default=640)
    parser.add_argument("--height", type=int, default=480)
    parser.add_argument(
        "--distinct", type=int, default=400, help="places to photograph from; more views are these again"
    )
    parser.add_argument("--preset", default="default")
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--profile", action="store_true")
    options = parser.parse_args()
    split = settings.preset(Params(), options.preset).split
    taken = min(options.views, options.distinct)
    room = generate(RoomParams(objects=50, views=taken, width=options.width, height=options.height, held_out=0))
    points, colors = sampled(room, options.points)
    cloud = even_cloud(points, colors, 1.0, nearest_spacing(points))
    depths = [DepthMap(name, d, "sensor") for name, d in zip(room.cameras.names, room.depth, strict=True)]
    ids = degrade(room.ids, DegradeParams(), seed=0)
    cameras, names = room.cameras, room.cameras.names
    del room, points, colors
    with tempfile.TemporaryDirectory() as folder, ThreadPoolExecutor(options.workers) as pool:
        store = Store(Path(folder), memory_bytes=64 << 20)

        def look(k: int) -> tuple[str, str, float, float, int]:
            began = time.perf_counter()
            seen = visibility(cloud, camera_of(cameras, k % taken), depths[k % taken], params=VisibilityParams())
            middle = time.perf_counter()
            observed = observe(cloud, seen, masks_by_id(ids[k % taken], names[k % taken]), params=split.observe)
            ended = time.perf_counter()
            stored = store.put(replace(seen, name=str(k))), store.put(replace(observed, name=str(k)))
            return *stored, middle - began, ended - middle, len(seen.point_index)

        reset_peak()
        begun = time.perf_counter()
        views = list(pool.map(look, range(options.views)))
        prepared = time.perf_counter() - begun
        looked = peak_mb()
        pairs = sum(v[4] for v in views)
        seen, observed = (Stream(store, [v[i] for v in views]) for i in (0, 1))

        once = 0.0
        for view in seen:
            begun = time.perf_counter()
            view.point_index.sum(), view.pixel.sum(), view.depth.sum()
            once += time.perf_counter() - begun

        reset_peak()
        profile = cProfile.Profile() if options.profile else None
        begun = time.perf_counter()
        if profile:
            profile.enable()
        labels = propagate(cloud, seen, observed, params=split.propagate)
        if profile:
            profile.disable()
        seconds = time.perf_counter() - begun
        propagated = peak_mb()
    total = prepared + seconds
    print(
        f"{options.preset}: {options.views} views of {options.width}x{options.height}, {len(cloud.points)} points, "
        f"{pairs} visible pairs; {options.workers} workers, load {os.getloadavg()[0]:.1f}"
    )
    print(
        f"visibility {sum(v[2] for v in views):.1f} s, observation {sum(v[3] for v in views):.1f} s of all workers, "
        f"with the store {prepared:.1f} s; peak {looked:.0f} MB"
    )
    print(
        f"propagation {seconds:.1f} s, {1e9 * seconds / pairs:.0f} ns a visible pair, {seconds / once:.0f} times one "
        f"reading; {labels.num_labels} labels; peak {propagated:.0f} MB"
    )
    print(f"together {total:.1f} s, {1e9 * total / (len(cloud.points) * options.views):.1f} ns a (point, view) pair")
    if profile:
        pstats.Stats(profile).sort_stats("tottime").print_stats(25)


if __name__ == "__main__":
    main()
