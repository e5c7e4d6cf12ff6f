"""How good Split's instances are on generated rooms, as a table: presets, and `default` without each of its additions.

    python tests/bench/bench_instances.py [--objects 10 50 200] [--seeds 10] [--masks perfect degraded merged sam]
                                          [--ablate] [--tau-depth 0.001 0.02 0.1] [--models DIR]

Masks: the room's own (perfect); with some missed, some in pieces and ragged borders (degraded); these with a tenth of
all touching pairs in one mask besides (merged); those of a segmenter (sam). Mean and standard deviation over the seeds.
Scored on the masks of all views pooled, and (mIoU of points) on the labelled points; `moved` is the share of points
whose label changes when the views come in another order.
"""

from __future__ import annotations

import argparse
import functools
import multiprocessing
import os
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ss_flow.flows import settings
from ss_flow.flows.generated import RoomParams, generate
from ss_flow.flows.generated.masks import DegradeParams, degrade
from ss_flow.flows.params import Params, SplitParams
from ss_flow.tasks.artifacts import (
    Cameras,
    DepthMap,
    Frame,
    Hierarchy,
    Int32,
    LabelMap,
    MaskSet,
    Observation,
    PointCloud,
    PointLabels,
    PointParts,
    SceneUnit,
    Visibility,
)
from ss_flow.tasks.evaluate.contingency import contingency
from ss_flow.tasks.evaluate.instances import evaluate_masks
from ss_flow.tasks.geometry.cameras import camera_of
from ss_flow.tasks.geometry.images import encode_png
from ss_flow.tasks.geometry.visibility import VisibilityParams
from ss_flow.tasks.masks.pool import masks_by_id
from ss_flow.tasks.models.catalogue import available, default_folders, find
from ss_flow.tasks.splat.resolve import resolve
from ss_flow.tasks.split.cut import cut
from ss_flow.tasks.split.dense import dense
from ss_flow.tasks.split.embed import embed
from ss_flow.tasks.split.hierarchy import hierarchy
from ss_flow.tasks.split.observe import observe
from ss_flow.tasks.split.propagate import propagate
from ss_flow.tasks.split.reproject import instances_in_view, reproject
from ss_flow.tasks.split.segment import segment
from ss_flow.tasks.split.tally import tally
from ss_flow.tasks.split.visibility import visibility

SIZES = {10: (24, 320, 240), 50: (36, 480, 360), 200: (60, 640, 480)}
"""Views, width and height of a room with so many objects."""
COLUMNS = (
    "miou",
    "macc25",
    "macc50",
    "pq",
    "pq_things",
    "over_segmentation",
    "under_segmentation",
    "points",
    "moved",
)
WITHOUT = {
    "views at once": {"propagate.views": "in_turn"},
    "votes of borders": {"propagate.at_once.border_vote": 1e-9},
    "votes against": {"propagate.at_once.background_vote": 0.0},
    "smoothing": {"propagate.smoothing": 0},
    "DBSCAN of labels": {"propagate.label_clusters.eps": 0.0},
    "touching labels": {"propagate.touching_merge": False},
    "best masks": {"reproject.selection.masks": "all"},
    "wholes": {"granularity": 1.0},
    "drawn masks": {"reproject.draw_missing": False},
    "exclusive masks": {"observe.nested": True},
    "erosion scaled and limited": {
        "observe.erosion.diagonal": 0.0,
        "observe.erosion.keep_share": 0.0,
        "observe.erosion.keep_pixels": 0,
    },
}
"""The additions of `default` to the paper, and how to do without each."""
WITH = {
    "DBSCAN of masks": {"observe.clusters.eps": 5.0},
}
"""What `default` leaves out, and how to have it."""


@dataclass(frozen=True)
class Scene:
    """A generated room as Split sees it."""

    cloud: PointCloud
    cameras: Cameras
    depths: tuple[DepthMap, ...]
    frames: tuple[Frame, ...]
    truth: tuple[LabelMap, ...]
    true_label: Int32
    """[N] id of each point by most of the views that see it, -1 where none does."""


@functools.lru_cache(maxsize=1)
def scene(objects: int, seed: int) -> Scene:
    views, width, height = SIZES[objects]
    room = generate(RoomParams(objects=objects, views=views, width=width, height=height, seed=seed, held_out=0))
    names = room.cameras.names
    depths = tuple(DepthMap(name, depth, "sensor") for name, depth in zip(names, room.depth, strict=True))
    nothing = np.zeros(0, np.uint8)
    frames = tuple(
        Frame(name, width, height, np.frombuffer(encode_png(rgb).tobytes(), np.uint8), nothing, width, height)
        for name, rgb in zip(names, room.rgb, strict=True)
    )
    cloud = dense(frames, room.cameras, depths, SceneUnit(1.0), params=SplitParams().dense)
    truth = tuple(LabelMap(name, ids.astype(np.uint16)) for name, ids in zip(names, room.ids, strict=True))
    counts = np.zeros((len(cloud.points), int(room.ids.max()) + 1), np.uint16)
    for k, depth in enumerate(depths):
        seen = visibility(cloud, camera_of(room.cameras, k), depth, params=VisibilityParams())
        counts[seen.point_index, room.ids[k].ravel()[seen.pixel]] += 1
    label = np.where(counts.any(axis=1), counts.argmax(axis=1), -1).astype(np.int32)
    return Scene(cloud, room.cameras, depths, frames, truth, label)


def masks_for(objects: int, seed: int, kind: str, preset: str, folder: str | None) -> tuple[MaskSet, ...]:
    """The masks of all views; only a segmenter's depend on the preset."""
    room = scene(objects, seed)
    ids = np.stack([truth.ids for truth in room.truth])
    if kind == "sam":
        return segmented(objects, seed, preset, folder)
    if kind != "perfect":
        ids = degrade(ids, DegradeParams(merged=0.1 if kind == "merged" else 0.0), seed=seed)
    return tuple(masks_by_id(image, frame.name) for image, frame in zip(ids, room.frames, strict=True))


@functools.lru_cache(maxsize=2)
def segmented(objects: int, seed: int, preset: str, folder: str | None) -> tuple[MaskSet, ...]:
    folders = [Path(folder)] if folder else default_folders()
    model = find(available("segmenter", folders)[0].name, folders)
    assert model is not None
    params = settings.preset(Params(), preset).split.segment
    return tuple(
        segment(frame, embed(frame, model=model), params=params, model=model) for frame in scene(objects, seed).frames
    )


@dataclass(frozen=True)
class Variant:
    """A way to run Split."""

    name: str
    preset: str
    split: SplitParams


def variants(names: Sequence[str], ablate: bool, tau_depth: Sequence[float]) -> Iterator[Variant]:
    for name in names:
        yield Variant(name, name, settings.preset(Params(), name).split)
    changes: dict[str, dict[str, object]] = {}
    if ablate:
        changes |= {f"default without {what}": values for what, values in WITHOUT.items()}
        changes |= {f"default with {what}": values for what, values in WITH.items()}
    changes |= {f"default, tau_depth {tau}": {"visibility.tau_depth": tau} for tau in tau_depth}
    for what, values in changes.items():
        assignments = [f"split.{name}={value}" for name, value in values.items()]
        yield Variant(what, "default", settings.apply(Params(), assignments).split)


def score(room: Scene, masks: tuple[MaskSet, ...], split: SplitParams) -> dict[str, float]:
    """The columns of the table, and the seconds from visibility to labels."""
    begun = time.perf_counter()
    seen = tuple(
        visibility(room.cloud, camera_of(room.cameras, k), depth, params=split.visibility)
        for k, depth in enumerate(room.depths)
    )
    observed = tuple(
        observe(room.cloud, view, pool, params=split.observe) for view, pool in zip(seen, masks, strict=True)
    )
    labels, tree = labelled(room, seen, masks, observed, split)
    seconds = time.perf_counter() - begun
    order = np.random.default_rng(1).permutation(len(seen))
    again, _ = labelled(room, *([of[k] for k in order] for of in (seen, masks, observed)), split)
    whole = PointParts(np.zeros_like(labels.label))
    in_views = tuple(
        instances_in_view(view, pool, labels, params=split.reproject) for view, pool in zip(seen, masks, strict=True)
    )
    instances = reproject(room.cloud, labels, whole, tree, in_views, min_views=split.reproject.min_views)
    maps = resolve(room.cameras, instances)
    values = evaluate_masks(maps, room.truth, tree).values
    known = room.true_label >= 0
    on_points = contingency(room.true_label[known], labels.label[known]).without(truth=0, predicted=0)
    return values | {
        "points": float(on_points.best_iou().mean()),
        "moved": moved(labels.label, again.label),
        "labels": values["num_predicted"],
        "seconds": seconds,
    }


def labelled(
    room: Scene,
    seen: Sequence[Visibility],
    masks: Sequence[MaskSet],
    observed: Sequence[Observation],
    split: SplitParams,
) -> tuple[PointLabels, Hierarchy]:
    """The instances of the points, and the tree that they were cut from."""
    pieces = propagate(room.cloud, seen, observed, params=split.propagate)
    counted = [tally(view, pool, pieces) for view, pool in zip(seen, masks, strict=True)]
    tree = hierarchy(room.cloud, room.cameras, seen, pieces, counted, params=split.hierarchy)
    return cut(room.cloud, pieces, tree, granularity=split.granularity), tree


def moved(before: Int32, after: Int32) -> float:
    """Share of the points whose label is not what it became under the best one-to-one renaming."""
    from scipy.optimize import linear_sum_assignment

    table = np.zeros((int(before.max()) + 1, int(after.max()) + 1), np.int64)
    np.add.at(table, (before, after), 1)
    kept = table[1:, 1:]
    return 1 - float(kept[linear_sum_assignment(kept, maximize=True)].sum() + table[0, 0]) / len(before)


def scores(job: tuple[int, int, str, list[Variant], str | None]) -> list[dict[str, float]]:
    objects, seed, kind, ways, folder = job
    return [score(scene(objects, seed), masks_for(objects, seed, kind, way.preset, folder), way.split) for way in ways]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--objects", type=int, nargs="+", default=[10, 50], choices=sorted(SIZES))
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--masks", nargs="+", default=["perfect", "degraded"])
    parser.add_argument("--presets", nargs="+", default=["default", "paper", "reference"])
    parser.add_argument("--ablate", action="store_true", help="default without each addition, and with what it leaves")
    parser.add_argument("--tau-depth", type=float, nargs="*", default=[])
    parser.add_argument("--models", help="a folder of models; by default SS_FLOW_MODELS")
    parser.add_argument("--workers", type=int, default=2)
    options = parser.parse_args()
    ways = list(variants(options.presets, options.ablate, options.tau_depth))
    with ProcessPoolExecutor(options.workers, multiprocessing.get_context("spawn")) as pool:
        for objects in options.objects:
            for kind in options.masks:
                jobs = [(objects, seed, kind, ways, options.models) for seed in range(options.seeds)]
                results = list(pool.map(scores, jobs))
                print(f"\n{objects} objects, {kind} masks, {options.seeds} seeds, load {os.getloadavg()[0]:.1f}\n")
                print("| |", " | ".join((*COLUMNS, "labels", "seconds")), "|")
                print("|---" * (len(COLUMNS) + 3) + "|")
                for row, way in enumerate(ways):
                    cells = [_cell([result[row][name] for result in results], 100) for name in COLUMNS]
                    cells += [_cell([result[row][name] for result in results], 1) for name in ("labels", "seconds")]
                    print(f"| {way.name} |", " | ".join(cells), "|", flush=True)


def _cell(values: list[float], scale: float) -> str:
    return f"{scale * np.mean(values):.1f} ± {scale * np.std(values):.1f}"


if __name__ == "__main__":
    main()
