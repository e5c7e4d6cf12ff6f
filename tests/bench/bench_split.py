"""How long Split's propagation takes: seconds, memory, and nanoseconds a (point, view) pair beside reading them once.

    python tests/bench/bench_split.py [--views 100] [--points 100000] [--width 640] [--height 480] [--profile]

A generated room of 50 objects with degraded masks (some missed, some in pieces, ragged borders). The yardstick is one
pass over what the pairs are made of: reading every visible point's index, pixel and depth once.
"""

from __future__ import annotations

import argparse
import cProfile
import os
import pstats
import time
from pathlib import Path

import numpy as np

from ss_flow.flows.generated import RoomParams, generate
from ss_flow.flows.generated_masks import DegradeParams, degrade
from ss_flow.tasks.artifacts import DepthMap, PointCloud
from ss_flow.tasks.capture.id_images import masks_of
from ss_flow.tasks.geometry.clustering import nearest_spacing
from ss_flow.tasks.split.propagate import PropagateParams, propagate
from ss_flow.tasks.split.visibility import visibility


def peak_mb() -> float:
    """The largest resident memory of this process since the last `reset_peak`."""
    status = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
    return int(status["VmHWM"].split()[0]) / 1024


def reset_peak() -> None:
    Path("/proc/self/clear_refs").write_text("5")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--views", type=int, default=100)
    parser.add_argument("--points", type=int, default=100_000)
    parser.add_argument("--width", type=int, default=640)
    parser.add_argument("--height", type=int, default=480)
    parser.add_argument("--profile", action="store_true")
    options = parser.parse_args()
    room = generate(RoomParams(objects=50, views=options.views, width=options.width, height=options.height, held_out=0))
    chosen = np.random.default_rng(0).permutation(len(room.points))[: options.points]
    points = room.points[chosen]
    cloud = PointCloud(points, room.point_colors[chosen], 1.0, nearest_spacing(points))
    depths = [DepthMap(name, d, "sensor") for name, d in zip(room.cameras.names, room.depth, strict=True)]
    masks = [
        masks_of(ids, name)
        for ids, name in zip(degrade(room.ids, DegradeParams(), seed=0), room.cameras.names, strict=True)
    ]
    reset_peak()
    before = peak_mb()
    begun = time.perf_counter()
    seen = tuple(visibility(cloud, room.cameras, d, view=k, tau_depth=0.02) for k, d in enumerate(depths))
    visible = time.perf_counter() - begun
    pairs = sum(len(v.point_index) for v in seen)

    begun = time.perf_counter()
    for view in seen:
        view.point_index.sum(), view.pixel.sum(), view.depth.sum()
    once = time.perf_counter() - begun

    profile = cProfile.Profile() if options.profile else None
    begun = time.perf_counter()
    if profile:
        profile.enable()
    labels = propagate(cloud, seen, tuple(masks), params=PropagateParams())
    if profile:
        profile.disable()
    seconds = time.perf_counter() - begun
    print(
        f"{options.views} views of {options.width}x{options.height}, {len(points)} points, {pairs} visible pairs, "
        f"{sum(len(m) for m in masks)} masks; load {os.getloadavg()[0]:.1f}"
    )
    print(f"visibility {visible:.2f} s, {1e9 * visible / (len(chosen) * options.views):.1f} ns a (point, view) pair")
    print(
        f"propagation {seconds:.2f} s, {1e9 * seconds / pairs:.0f} ns a visible pair, "
        f"{seconds / once:.0f} times one reading; {labels.num_labels} labels; {peak_mb() - before:.0f} MB more"
    )
    if profile:
        pstats.Stats(profile).sort_stats("tottime").print_stats(25)


if __name__ == "__main__":
    main()
