"""What the trainings of single instances and the last pass over the whole scene each gain for their processor seconds.

    python tests/bench/bench_schedule.py room:10 CAPTURE [--schedules 200:2000 50:2500 1:3000] [--points 10000]
                                         [--preset default] [--set STEP.PARAM=VALUE ...] [--side 480]
                                         [--masks degraded] [--seed 0] [--store DIR]

A schedule is the steps of each instance (twice as many for the background where the preset says so) and those of the
last pass. Instances are trained on Split's masks from at most --points points, and not again after refinement; the last
pass sees the masks that a run of the preset refined. So a run is needed once up to these masks, and schedules cost
their own trainings alone. A line for each: processor seconds of both parts, held-out PSNR, the same with colours
fitted, SSIM; mean IoU of rendered and refined masks in the views trained on; Gaussians. --side: longest side of photos
in the last pass and of the views kept back, pixels.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, get_args

import numpy as np
from bench_quality import measured, view_of
from bench_splat import Masks, folder_of, held_out_of

from ss_flow.cache.store import Store
from ss_flow.engine import run_flow
from ss_flow.flows import settings
from ss_flow.flows.cli.context import file_digests
from ss_flow.flows.cli.prepare import RunOptions, prepare
from ss_flow.flows.params import Params
from ss_flow.running import Surroundings, running
from ss_flow.tasks.artifacts import Gaussians, InstanceMasks, LabelMap
from ss_flow.tasks.capture.scene import open_scene
from ss_flow.tasks.gaussians.views import TrainView, Views, whole_view
from ss_flow.tasks.geometry.cameras import cameras_by_view
from ss_flow.tasks.splat.global_pass import assemble, global_pass
from ss_flow.tasks.splat.merge import quality
from ss_flow.tasks.splat.reconstruct import reconstruct


@dataclass(frozen=True)
class Prepared:
    """What a run gives before anything is trained together."""

    views: Views
    instances: tuple[InstanceMasks, ...]
    """As Split found them."""
    masks: tuple[LabelMap, ...]
    """After refinement."""
    test: list[TrainView]
    """Those kept back; those trained on where there are none."""


def prepared(folder: Path, params: Params, side: int, store: Store) -> Prepared:
    """Run a scene up to its refined masks, and read what the trainings need."""
    run = prepare(open_scene(folder), params, RunOptions(until="unit"), file_digests(store))

    def build() -> dict[str, Any]:
        outputs = run.build()
        return {name: outputs[name] for name in ("ingest", "cameras", "depth", "unit", "reproject", "masks_refined")}

    values = run_flow(build, store, scene=run.name, header={}).values

    def many(name: str) -> list[Any]:
        return [store.get(digest) for digest in values[name]]

    frames, depths, cameras = many("ingest"), many("depth"), store.get(values["cameras"])
    (unit,) = many("unit")
    views = Views(frames, cameras_by_view(cameras), depths, unit, ())
    kept_frames, kept_cameras = held_out_of(folder, params, store) or (frames, cameras)
    # The depth of a view that is only looked at does not count.
    test = [view_of(frame, kept_cameras, depths[0], row, side) for row, frame in enumerate(kept_frames)]
    return Prepared(views, tuple(many("reproject")), tuple(many("masks_refined")), test)


def trained_alone(scene: Prepared, params: Params, steps: int, points: int) -> Gaussians:
    """Every instance, trained for so many steps, as one scene."""
    alone = replace(params.splat.reconstruct, min_iterations=steps, max_iterations=steps, max_points=points)
    visibility = params.split.visibility
    return assemble(
        tuple(reconstruct(scene.views, one, params=alone, visibility=visibility) for one in scene.instances)
    )


def mask_iou(scene: Prepared, gaussians: Gaussians, params: Params, side: int) -> float:
    """Mean over every sixth view and its instances."""
    ids = np.unique(gaussians.instance_id)
    channel_of = np.zeros(np.iinfo(np.uint16).max + 1, np.int32)
    channel_of[ids] = np.arange(len(ids))
    compared = scene.views.compared(params.split.visibility)
    some = range(0, len(scene.masks), 6)
    return quality(gaussians, [whole_view(compared, v, channel_of[scene.masks[v].ids], side) for v in some], ids).iou


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="+")
    parser.add_argument("--schedules", nargs="+", default=["200:2000", "50:2500", "1:3000"], help="INSTANCE:WHOLE")
    parser.add_argument("--points", type=int, nargs="+", default=[10_000], help="most that an instance starts from")
    parser.add_argument("--preset", default="default")
    parser.add_argument("--set", nargs="*", default=[])
    parser.add_argument("--side", type=int, default=480)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--masks", choices=get_args(Masks), default="degraded", help="of rooms; none: a segmenter's")
    parser.add_argument("--store", type=Path, default=Path(tempfile.gettempdir()) / "ss-flow-bench")
    args = parser.parse_args()
    params = settings.apply(settings.preset(Params(), args.preset), args.set)
    print("| scene | points | steps: instance, whole | CPU s | PSNR | colours fitted | SSIM | mask IoU | Gaussians |")
    print("|---" * 9 + "|")
    for name in args.scenes:
        folder = folder_of(name, args.seed, args.masks, args.store)
        scene = prepared(folder, params, args.side, Store(args.store))
        for points in args.points:
            alone: dict[int, tuple[Gaussians, float]] = {}
            for schedule in args.schedules:
                steps, together = (int(number) for number in schedule.split(":"))
                with running(Surroundings(cores=os.cpu_count() or 1)):
                    if steps not in alone:
                        begun = time.process_time()
                        gaussians = trained_alone(scene, params, steps, points)
                        alone[steps] = gaussians, time.process_time() - begun
                    gaussians, first = alone[steps]
                    last_pass = replace(params.splat.merge, global_iterations=together)
                    last_pass = replace(last_pass, crop=replace(last_pass.crop, max_side=args.side))
                    begun = time.process_time()
                    gaussians = global_pass(scene.views, gaussians, scene.masks, params=last_pass)
                    last = time.process_time() - begun
                psnr, fitted, ssim = measured(gaussians, scene.test)
                print(
                    f"| {folder.name} | {points} | {steps}, {together} | {first:.0f} + {last:.0f} | {psnr:.2f} | "
                    f"{fitted:.2f} | {ssim:.3f} | {100 * mask_iou(scene, gaussians, params, args.side):.1f} | "
                    f"{len(gaussians)} |",
                    flush=True,
                )
        print(f"  load {os.getloadavg()[0]:.1f}", file=sys.stderr)


if __name__ == "__main__":
    main()
