"""What Splat comes to on generated rooms and on captures, as tables: against plain 3DGS, against Split, and object by
object.

    python tests/bench/bench_splat.py room:10 room:50 CAPTURE [--presets default fast paper] [--set STEP.PARAM=VALUE]
                                      [--jobs 1 2] [--masks degraded] [--plain steps photos] [--seed 0] [--look DIR]
                                      [--store DIR] [--sensor]

room:N is a generated room of N objects, with degraded masks if not told otherwise, composite one of things of several
parts; with --sensor, their depth is that of a camera as the first Kinect. A line for each scene, preset and
number of jobs: held-out PSNR and SSIM; mIoU of the masks after Split, after refinement, and as the merged scene renders
them; dark fringes, floaters and what taking an object away changes elsewhere (mean over objects, and worst); seconds,
and instances a minute. --plain trains plain 3DGS from the same points to the same number of Gaussians: for as many
steps as all of Splat's trainings took together, or for as many as their crops make whole photos; with our learning
rates and with 3DGS's.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from bench_instances import SIZES
from bench_quality import view_of

sys.path.insert(0, str(Path(__file__).parents[1] / "support"))
from depth_sensor import sensed

from ss_flow.cache.store import Store
from ss_flow.engine import Report, run_flow
from ss_flow.flows import settings
from ss_flow.flows.capture import capture
from ss_flow.flows.cli.context import file_digests
from ss_flow.flows.cli.prepare import RunOptions, prepare
from ss_flow.flows.generated import RoomParams, generate, write_scene
from ss_flow.flows.params import Params
from ss_flow.running import Surroundings, running
from ss_flow.task import FileRef
from ss_flow.tasks.artifacts import REFINED, Cameras, DepthMap, Frame, Gaussians, InstanceMasks, LabelMap
from ss_flow.tasks.capture.scene import open_scene
from ss_flow.tasks.evaluate.novel_view import novel_view, to_8bit
from ss_flow.tasks.evaluate.objects import change_elsewhere, floaters, fringe_share
from ss_flow.tasks.gaussians.initialise import concatenate, initialise, select
from ss_flow.tasks.gaussians.learning_rates import LearningRates
from ss_flow.tasks.gaussians.render import render
from ss_flow.tasks.gaussians.trainer import TrainParams, train
from ss_flow.tasks.gaussians.views import CropParams, crop_camera
from ss_flow.tasks.geometry.cameras import camera_of
from ss_flow.tasks.geometry.images import decode_rgb, encode_png
from ss_flow.tasks.geometry.shape import box_diagonal
from ss_flow.tasks.splat.reconstruct import thin

Masks = Literal["degraded", "truth", "none"]
SPLIT_STEP = "masks_split"
RATES_OF_3DGS = LearningRates(1.6e-4, 1.6e-6, 2.5e-3, 0.05, 5e-3, 1e-3)
MAGENTA = (1.0, 0.0, 1.0)


@dataclass(frozen=True)
class Outcome:
    """A finished run, read back."""

    frames: list[Frame]
    cameras: Cameras
    depths: list[DepthMap]
    instances: list[InstanceMasks]
    """After refinement."""
    split: list[InstanceMasks]
    masks: list[LabelMap]
    scene: Gaussians
    metrics: dict[str, dict[str, float]]
    held_out: tuple[tuple[Frame, ...], Cameras] | None
    report: Report
    split_seconds: float
    splat_seconds: float


def room_of(scene: str, seed: int) -> RoomParams | None:
    """The room that is meant: room:N of N objects, or the one of composite things; None of a capture."""
    if scene == "composite":
        return RoomParams(composite=True, views=24, width=480, height=360, seed=seed)
    if not scene.startswith("room:"):
        return None
    objects = int(scene.removeprefix("room:"))
    views, width, height = SIZES[objects]
    return RoomParams(objects=objects, views=views, width=width, height=height, seed=seed)


def folder_of(scene: str, seed: int, masks: Masks, place: Path, sensor: bool = False) -> Path:
    """The capture that is meant; a room is written first. sensor: with the depth of a depth camera."""
    room = room_of(scene, seed)
    if room is None:
        return Path(scene)
    folder = place / f"{scene.replace(':', '-')}-{seed}-{masks}{'-sensor' * sensor}"
    if not folder.exists():
        made = generate(room)
        given = None if masks == "none" else masks
        write_scene(sensed(made, seed) if sensor else made, folder, masks=given, seed=seed)
    return folder


def outcome(folder: Path, params: Params, jobs: int, store: Store) -> Outcome:
    """Run Split, then the rest, and read what came of it."""
    reports, seconds = [], []
    for until in (SPLIT_STEP, None):
        options = RunOptions(until=until)
        prepared = prepare(open_scene(folder), params, options, file_digests(store))
        begun = time.perf_counter()
        reports.append(run_flow(prepared.build, store, scene=prepared.name, header={}, until=options.target, jobs=jobs))
        seconds.append(time.perf_counter() - begun)
    values: dict[str, Any] = reports[1].values

    def many(name: str) -> list[Any]:
        return [store.get(digest) for digest in values[name]]

    metrics = {
        name: store.get(values[name]).values
        for name in ("metrics_split", "metrics_refined", "metrics_splat", "novel_view")
        if isinstance(values.get(name), str)
    }
    return Outcome(
        many("ingest"), store.get(values["cameras"]), many("depth"), many("refine"), many("reproject"),
        many("masks_refined"), store.get(values["scene"]), metrics, held_out_of(folder, params, store), reports[1],
        *seconds,
    )  # fmt: skip


def held_out_of(folder: Path, params: Params, store: Store) -> tuple[tuple[Frame, ...], Cameras] | None:
    """The views kept back, as the run read them."""
    place = folder / "held_out"
    if not place.is_dir():
        return None
    digests = file_digests(store)

    def build() -> dict[str, Any]:
        nodes = capture(open_scene(place), lambda p: FileRef(p.absolute(), digests(p)), params.capture, None)
        return {"frames": nodes.frames, "cameras": nodes.cameras}

    values = run_flow(build, store, scene=str(place), header={}).values
    return tuple(store.get(d) for d in values["frames"]), store.get(values["cameras"])


def cell(metrics: dict[str, dict[str, float]], group: str, name: str, scale: float = 100, digits: int = 1) -> str:
    """A figure, "-" where it was not measured."""
    return f"{scale * metrics[group][name]:.{digits}f}" if name in metrics.get(group, {}) else "-"


def plain(found: Outcome, params: Params, steps: int, rates: LearningRates) -> tuple[Gaussians, float]:
    """Plain 3DGS from the points that Splat starts from, to as many Gaussians as Splat came to; and seconds."""
    settings_ = params.splat.reconstruct
    starts = []
    for instance in found.split:
        if len(instance.points) and not instance.weak:
            rows = thin(instance.points, round(settings_.max_points * settings_.scale_of(instance)))
            starts.append(initialise(instance.points[rows], instance.colors[rows], 0, 1.0))
    start = concatenate(starts)
    full = int(found.cameras.sizes.max())
    views = [
        view_of(frame, found.cameras, depth, index, full)
        for index, (frame, depth) in enumerate(zip(found.frames, found.depths, strict=True))
    ]
    most = len(found.scene)
    if len(start) > most:
        start = select(start, np.linspace(0, len(start) - 1, most).astype(int))
    begun = time.perf_counter()
    with running(Surroundings(cores=2)):
        result = train(
            start,
            views,
            params=TrainParams(
                iterations=steps, sh_degree=params.splat.merge.sh_degree, max_gaussians=most, rates=rates
            ),
            extent=box_diagonal(start.means),
            seed=0,
        )
    return result.gaussians, time.perf_counter() - begun


def total_steps(found: Outcome, params: Params) -> tuple[int, int]:
    """Steps of all trainings of a run, and how many whole photos their crops make up.

    A pair's steps count as if it were seen in all views, its crops as large as the mean of the instances'.
    """
    of, merge = params.splat.reconstruct, params.splat.merge
    steps, photos, shares = 0, 0.0, []
    for before, after in zip(found.split, found.instances, strict=True):
        if before.weak or not before.views:
            continue
        share = float(np.mean([crop_share(found.cameras, before, row, of.crop) for row in range(len(before.views))]))
        count = of.iterations(before)
        if (after.origin == REFINED).any() and of.retrain_share:
            count += max(1, round(of.retrain_share * of.iterations(after)))
        steps, photos = steps + count, photos + share * count
        shares.append(share)
    pairs = sum(n["event"] in ("hit", "finished") and n["step"] == "splat.merge_pair" for n in found.report.nodes)
    in_pairs = pairs * merge.iterations(len(found.frames))
    together = merge.global_iterations
    return steps + in_pairs + together, round(photos + np.mean(shares) * in_pairs + together)


def crop_share(cameras: Cameras, instance: InstanceMasks, row: int, crop: CropParams) -> float:
    """How much of a photo's pixels are rendered to train on one view of an instance."""
    full = camera_of(cameras, cameras.names.index(instance.views[row]))
    camera = crop_camera(full, instance.mask(row), instance.points, crop)
    return camera.width * camera.height / (full.width * full.height)


@dataclass(frozen=True)
class Cleanliness:
    """Of one object."""

    instance_id: int
    fringe: float
    """Share of the object's pixels."""
    floaters: float
    """Share of its Gaussians."""
    elsewhere: float
    """What taking it away changes outside its masks, 0..1."""


def cleanliness(found: Outcome) -> Iterator[Cleanliness]:
    """Of every object of the merged scene, over up to eight of the views that have a mask of it."""
    for instance in found.instances:
        own = select(found.scene, found.scene.instance_id == instance.instance_id)
        if instance.instance_id == 0 or not len(own):
            continue
        dark = shown = 0
        changes = []
        for name in instance.views[:: -(-len(instance.views) // 8)]:
            view = found.cameras.names.index(name)
            camera = camera_of(found.cameras, view)
            fringe, pixels = fringe_share(own, camera)
            dark, shown = dark + fringe, shown + pixels
            mask = found.masks[view].ids == instance.instance_id
            changes.append(change_elsewhere(found.scene, instance.instance_id, camera, mask))
        points = instance.points
        yield Cleanliness(
            instance.instance_id,
            dark / max(shown, 1),
            float(floaters(own, points).mean()),
            float(np.mean(changes or [0])),
        )


def look(found: Outcome, plainly: Gaussians | None, place: Path) -> None:
    """Pictures to look at: photo, merged scene, plain scene, ids; and every object alone before magenta."""
    import cv2

    place.mkdir(parents=True, exist_ok=True)
    rows = []
    for view in np.linspace(0, len(found.frames) - 1, 4).astype(int):
        camera = camera_of(found.cameras, view)
        row = [decode_rgb(found.frames[view])]
        row += [to_8bit(render(s, camera).rgb) for s in (found.scene, plainly) if s is not None]
        row.append(np.random.default_rng(3).integers(0, 255, (65536, 3), np.uint8)[found.masks[view].ids])
        rows.append(np.hstack(row))
    (place / "scene.png").write_bytes(encode_png(np.vstack(rows)).tobytes())
    tiles = []
    for instance in found.instances:
        own = select(found.scene, found.scene.instance_id == instance.instance_id)
        if instance.instance_id and len(own) and instance.views:
            row = int(instance.areas().argmax())
            largest, mask = found.cameras.names.index(instance.views[row]), instance.mask(row)
            y, x = np.nonzero(mask)
            margin = 20
            box = np.s_[max(0, y.min() - margin) : y.max() + margin, max(0, x.min() - margin) : x.max() + margin]
            both = [decode_rgb(found.frames[largest])[box]]
            both.append(to_8bit(render(own, camera_of(found.cameras, largest), background=MAGENTA).rgb)[box])
            tiles.append(np.hstack([cv2.resize(tile, (240, 240)) for tile in both]))
    across = 4
    tiles += [np.zeros_like(tiles[0])] * (-len(tiles) % across)
    sheet = np.vstack([np.hstack(tiles[i : i + across]) for i in range(0, len(tiles), across)])
    (place / "objects.png").write_bytes(encode_png(sheet).tobytes())


def seconds_by_step(report: Report) -> dict[str, tuple[int, float]]:
    """How often each step of Splat ran, and its seconds in all."""
    found: dict[str, list[float]] = defaultdict(list)
    for node in report.nodes:
        if node["event"] in ("hit", "finished") and node["step"].startswith("splat."):
            found[node["step"]].append(node["seconds"])
    return {step: (len(values), sum(values)) for step, values in found.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="+")
    parser.add_argument("--presets", nargs="+", default=["default"])
    parser.add_argument("--set", nargs="*", default=[])
    parser.add_argument("--jobs", type=int, nargs="+", default=[2])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--masks", choices=get_args(Masks), default="degraded", help="of rooms; none: a segmenter's")
    parser.add_argument("--sensor", action="store_true", help="rooms with the depth of a depth camera")
    parser.add_argument("--plain", nargs="*", choices=["steps", "photos"], default=[])
    parser.add_argument("--objects", action="store_true", help="a line for every object")
    parser.add_argument("--look", type=Path, help="a folder for pictures")
    parser.add_argument("--store", type=Path, help="a store to keep; each line computes anew otherwise")
    args = parser.parse_args()
    print("| scene | preset | jobs | PSNR | colours fitted | SSIM | mIoU Split | refined | rendered | PQ rendered |"
          " fringe % | worst |"
          " floaters % | elsewhere /255 | worst | Gaussians | rounds | Split s | Splat s | objects/min |")  # fmt: skip
    print("|---" * 20 + "|")
    with tempfile.TemporaryDirectory() as temporary:
        for scene in args.scenes:
            folder = folder_of(scene, args.seed, args.masks, Path(args.store or temporary), args.sensor)
            for preset in args.presets:
                for jobs in args.jobs:
                    with tempfile.TemporaryDirectory() as own:
                        told(folder, preset, jobs, Store(args.store or Path(own)), args)


def told(folder: Path, preset: str, jobs: int, store: Store, args: argparse.Namespace) -> None:
    """Run, measure, print a line."""
    params = settings.apply(settings.preset(Params(), preset), args.set)
    found = outcome(folder, params, jobs, store)
    clean = list(cleanliness(found))
    metrics = found.metrics
    steps = seconds_by_step(found.report)
    rounds = steps.get("splat.plan", (1, 0))[0] - 1
    objects = len(clean)
    of = {name: [getattr(c, name) for c in clean] or [0.0] for name in ("fringe", "floaters", "elsewhere")}
    print(
        f"| {folder.name} | {preset} | {jobs} | {cell(metrics, 'novel_view', 'psnr', 1, 2)} | "
        f"{cell(metrics, 'novel_view', 'psnr_colour_fitted', 1, 2)} | "
        f"{cell(metrics, 'novel_view', 'ssim', 1, 3)} | {cell(metrics, 'metrics_split', 'miou')} | "
        f"{cell(metrics, 'metrics_refined', 'miou')} | {cell(metrics, 'metrics_splat', 'miou')} | "
        f"{cell(metrics, 'metrics_splat', 'pq')} | {100 * np.mean(of['fringe']):.2f} | {100 * max(of['fringe']):.2f} | "
        f"{100 * np.mean(of['floaters']):.2f} | {255 * np.mean(of['elsewhere']):.3f} | "
        f"{255 * max(of['elsewhere']):.3f} | {len(found.scene)} | {rounds} | {found.split_seconds:.0f} | "
        f"{found.splat_seconds:.0f} | {60 * objects / max(found.splat_seconds, 1e-9):.1f} |",
        flush=True,
    )
    print("  " + ", ".join(f"{step} {n} x {s / n:.1f} s" for step, (n, s) in steps.items()), file=sys.stderr)
    peak = max(n["peak_rss_mb"] for n in found.report.nodes if "peak_rss_mb" in n)
    print(f"  load {os.getloadavg()[0]:.1f}, peak {peak:.0f} MB", file=sys.stderr)
    if args.objects:
        for c in clean:
            print(f"  {c.instance_id}: fringe {100 * c.fringe:.2f} %, floaters {100 * c.floaters:.2f} %, "
                  f"elsewhere {255 * c.elsewhere:.3f}", file=sys.stderr)  # fmt: skip
    scene = None
    if args.plain:
        kept_back = found.held_out or (tuple(found.frames), found.cameras)
        merged = novel_view(*kept_back, found.scene).values
        print(f"  merged: PSNR {merged['psnr']:.2f}, SSIM {merged['ssim']:.3f}", flush=True)
        for what in args.plain:
            steps = total_steps(found, params)[what == "photos"]
            for whose, rates in (("our", LearningRates()), ("3DGS's", RATES_OF_3DGS)):
                scene, seconds = plain(found, params, steps, rates)
                kept = novel_view(*kept_back, scene).values
                print(f"  plain 3DGS, as many {what}, {whose} rates: {steps} steps, {len(scene)} Gaussians, "
                      f"{seconds:.0f} s, PSNR {kept['psnr']:.2f}, SSIM {kept['ssim']:.3f}",
                      flush=True)  # fmt: skip
    if args.look:
        look(found, scene, args.look / f"{folder.name}-{preset}")


if __name__ == "__main__":
    main()
