"""How many photos find their right place from the photos alone, in captures whose poses are known.

    python tests/bench/bench_poses.py CAPTURE [...] [--depth] [--stride N] [--set capture.sfm.STEP.PARAM=VALUE ...]
                                      [--store DIR]

A line for each capture: its photos; how many are placed; how many of these lie within 2 % of the extent of all places
from where the capture has them, under the similarity that most agree on, their median distance in per cent of it, and
that similarity's scale; the share of the matches that fit the poses that were found, and the capture's own; seconds of
the steps. Masks of what is to be ignored are used, poses, lenses and depth are not; with --depth, lenses and the
sensor's depth are too, and poses found by them. With --store, another run computes only what is new.
"""

from __future__ import annotations

import argparse
import tempfile
from collections import defaultdict
from pathlib import Path

import numpy as np

from ss_flow.cache.store import Store
from ss_flow.engine import run_flow
from ss_flow.flows import settings
from ss_flow.flows.capture import all_of
from ss_flow.flows.cli.context import file_digests, references
from ss_flow.flows.depths import measured
from ss_flow.flows.params import CaptureParams, Params
from ss_flow.flows.poses import compared, poses, poses_by_depth
from ss_flow.tasks.artifacts import Cameras, Float64
from ss_flow.tasks.capture.colmap import load_pycolmap
from ss_flow.tasks.capture.ingest import cameras, frames
from ss_flow.tasks.capture.pose_fit import matches_that_fit
from ss_flow.tasks.capture.scene import open_scene
from ss_flow.tasks.geometry.cameras import cameras_by_view

RIGHT = 0.02


def places(found: Cameras) -> Float64:
    """[V, 3] where the cameras stand."""
    return np.stack([camera.center for camera in cameras_by_view(found)])


def right_places(found: Float64, true: Float64) -> tuple[Float64, float]:
    """Distances of those that lie right, as a share of the extent of the true ones; and the scale that brings them
    there."""
    pycolmap = load_pycolmap()
    extent = np.linalg.norm(np.ptp(true, axis=0))
    options = pycolmap.RANSACOptions(max_error=RIGHT * extent, random_seed=0)
    onto = pycolmap.estimate_sim3d_robust(found, true, options)["tgt_from_src"]
    off = np.linalg.norm(onto * found - true, axis=1) / extent
    return off[off < RIGHT], onto.scale


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("captures", type=Path, nargs="+")
    parser.add_argument("--depth", action="store_true", help="place photos by their sensor's depth")
    parser.add_argument("--stride", type=int, default=1, help="every so many views")
    parser.add_argument("--set", nargs="*", default=[])
    parser.add_argument("--store", type=Path, help="a store to keep")
    options = parser.parse_args()
    asked = ["capture.sfm.min_registered=0", *options.set]
    params = settings.apply(Params(), asked).capture
    print("| capture | photos | placed | right | off | scale | fit | fit given poses | seconds |\n" + "|---" * 9 + "|")
    with tempfile.TemporaryDirectory() as temporary:
        store = Store(options.store or Path(temporary))
        for place in options.captures:
            print(line(place, options, params, store), flush=True)


def line(place: Path, options: argparse.Namespace, params: CaptureParams, store: Store) -> str:
    scene = open_scene(place).every(options.stride)
    reference = references(file_digests(store))

    def build() -> dict[str, object]:
        photos, valid = all_of(reference, scene.photos), all_of(reference, scene.valid)
        lenses = scene.lenses if options.depth else None
        own = frames(names=scene.names, photos=photos, valid=valid, lenses=lenses, params=params.ingest)
        given = cameras(own, names=scene.names, lenses=scene.lenses, poses=scene.poses, metric=True, sparse=None)
        found, _, matches = compared(own, params.sfm, None)
        if options.depth:
            placed = poses_by_depth(own, given, measured(scene, reference, own), params, scene.names)
        else:
            placed = poses(own, params.sfm, None)
        return {"placed": placed, "given": given, "features": found, "matches": matches}

    report = run_flow(build, store, scene=place.name, header={})
    placed, given = store.get(report.values["placed"]), store.get(report.values["given"])
    photos, matches = ([store.get(key) for key in report.values[name]] for name in ("features", "matches"))
    rows = [given.names.index(name) for name in placed.names]
    off, scale = right_places(places(placed), places(given)[rows])
    shares = [fit / max(total, 1) for fit, total in (matches_that_fit(c, photos, matches) for c in (placed, given))]
    seconds = defaultdict[str, float](float)
    for node in report.nodes:
        seconds[node["step"]] += node.get("seconds", 0.0)
    steps = ", ".join(f"{step.removeprefix('capture.')} {taken:.0f}" for step, taken in seconds.items() if taken > 0.5)
    counts = f"{len(photos)} | {len(placed)} | {len(off)} | {100 * np.median(off):.2f} | {scale:.3f}"
    return f"| {place.name} | {counts} | {shares[0]:.3f} | {shares[1]:.3f} | {steps} |"


if __name__ == "__main__":
    main()
