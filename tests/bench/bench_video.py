"""How many frames of a video are enough, and which? By motion against evenly over time, on generated walks.

    python tests/bench/bench_video.py [--walks desk:7 room:4] [--preset fast] [--store DIR]
                                      [--frames motion=0.04 motion=0,max_frames=40 motion=0,max_frames=120 ...]

A walk of ten seconds, 24 frames each, goes round a generated desk, or round a composite room and looks outwards; for a
fifth of the time the camera stands still. Of each choice of frames (parameters of `capture.video`), with true poses and
depth by comparing photos, a run from an empty store: frames; whole (the share of things that are one predicted id) and
mIoU of the final masks of the frames that were taken, with those of walls and floor; PSNR of twelve views that lie
between; seconds of the processor, of all processes, and by the clock. Structure from motion is not in it.
"""

from __future__ import annotations

import argparse
import resource
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from bench_composite import ROOM
from bench_splat import cell, outcome
from generated_desk import TABLE, renderer_of_desk

from ss_flow.cache.store import Store
from ss_flow.flows import settings
from ss_flow.flows.cli.context import file_digests
from ss_flow.flows.generated import Views, renderer_of
from ss_flow.flows.generated.composite_room import GAZE
from ss_flow.flows.generated.room import looking_at, photographed, write_views
from ss_flow.flows.params import Params
from ss_flow.task import FileRef
from ss_flow.tasks.artifacts import Cameras, Float64, LabelMap
from ss_flow.tasks.capture.video import VideoParams, video_frames
from ss_flow.tasks.evaluate.instances import pooled
from ss_flow.tasks.evaluate.panoptic import whole

FRAMES, RATE = 240, 24
BETWEEN = 12
"""Views that are kept back."""


@dataclass(frozen=True)
class Walk:
    """What a camera sees on its way."""

    name: str
    seen: Views
    """Every frame of the video."""
    between: Views
    """From elsewhere beside the way."""


def walk(name: str, frames: int = FRAMES, width: int = 640) -> Walk:
    """desk:SEED or room:SEED."""
    kind, seed = name.split(":")
    room = replace(ROOM, seed=int(seed), width=width, height=width * 3 // 4)
    renderer = renderer_of_desk(room.seed) if kind == "desk" else renderer_of(room)
    round_it = _round_a_desk if kind == "desk" else _round_a_room
    time_ = np.linspace(0, 1, frames)
    way = np.interp(time_, [0, 0.3, 0.5, 1], [0, 0.5, 0.5, 1])  # stands still from .3 to .5
    rng = np.random.default_rng(room.seed)
    kept_back = (np.arange(BETWEEN) + 0.5) / BETWEEN
    views = [
        photographed(renderer, np.stack([round_it(place, beside) for place in places]), room, rng)
        for places, beside in ((way, 0.0), (kept_back, 0.05))
    ]
    return Walk(name, *views)


def _round_a_desk(place: float, beside: float) -> Float64:
    angle, rise = 2 * np.pi * place - np.pi / 2, 0.55 + 0.2 * np.sin(3 * np.pi * place) + beside
    out = np.array([np.cos(rise) * np.cos(angle), np.cos(rise) * np.sin(angle), np.sin(rise)])
    target = np.array([0, 0.03, TABLE[2] + 0.05])
    return looking_at(target + (0.95 + 0.1 * np.sin(5 * place)) * out, target)


def _round_a_room(place: float, beside: float) -> Float64:
    out = np.array([np.cos(2 * np.pi * place), np.sin(2 * np.pi * place), 0.0])
    height = np.array([0, 0, 1.5 + 0.2 * np.sin(6 * np.pi * place) + beside])
    return looking_at(1.2 * out + height, -0.5 * out + np.array([0, 0, GAZE]))


def written(of: Walk, place: Path) -> Path:
    """The video, as MJPEG."""
    file = place / f"{of.name.replace(':', '-')}.avi"
    height, width = of.seen.rgb.shape[1:3]
    writer = cv2.VideoWriter(str(file), cv2.VideoWriter_fourcc(*"MJPG"), RATE, (width, height))
    for rgb in of.seen.rgb:
        writer.write(np.ascontiguousarray(rgb[..., ::-1]))
    writer.release()
    return file


def only(views: Views, rows: Sequence[int]) -> Views:
    """Some of them."""
    chosen, cameras = list(rows), views.cameras
    return Views(
        **{name: getattr(views, name)[chosen] for name in ("rgb", "depth", "ids", "parts", "valid")},
        cameras=Cameras(
            tuple(cameras.names[row] for row in chosen),
            cameras.sizes[chosen],
            cameras.intrinsics[chosen],
            cameras.world_to_camera[chosen],
            cameras.metric,
        ),
    )


def video_params(text: str) -> VideoParams:
    """Of NAME=VALUE,NAME=VALUE, names as in `capture.video`."""
    params = settings.apply(Params(), [f"capture.video.{one}" for one in text.split(",")])
    return params.capture.video


def measured(of: Walk, video: Path, choice: str, params: Params, place: Path) -> str:
    """The line of a choice of frames."""
    folder, store = place / f"{video.stem}-{choice}", Store(place / f"store-{video.stem}-{choice}")
    frames = video_frames(video=FileRef(video.absolute(), file_digests(store)(video)), params=video_params(choice))
    taken = [int(frame.name.removeprefix("frame-")) for frame in frames]
    write_views(only(of.seen, taken), folder)
    write_views(of.between, folder / "held_out")
    return row_of(of, choice, taken, folder, params, store)


def row_of(of: Walk, choice: str, taken: Sequence[int], folder: Path, params: Params, store: Store) -> str:
    """The line of a choice of frames, of which the capture in a folder comes to consist."""
    used, begun = _processor_seconds(), time.perf_counter()
    found = outcome(folder, params, 2, store)
    used, seconds = _processor_seconds() - used, time.perf_counter() - begun
    truth = [LabelMap(frame.name, of.seen.ids[i]) for frame, i in zip(found.frames, taken, strict=True)]
    table = pooled(found.masks, truth).without(truth=0, predicted=0)
    return (
        f"| {of.name} | {choice} | {len(taken)} | {100 * whole(table).mean():.1f}, {100 * table.best_iou().mean():.1f} "
        f"| {cell(found.metrics, 'novel_view', 'psnr', 1, 2)} | {used:.0f} | {seconds:.0f} |"
    )


def _processor_seconds() -> float:
    both = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return sum(usage.ru_utime + usage.ru_stime for usage in both)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--walks", nargs="+", default=["desk:7", "room:4"])
    parser.add_argument("--frames", nargs="+", default=["motion=0.04", "motion=0,max_frames=40", "motion=0"])
    parser.add_argument("--preset", default="fast")
    parser.add_argument("--set", nargs="*", default=[])
    parser.add_argument("--store", type=Path, help="a folder to keep what is made")
    args = parser.parse_args()
    params: Any = settings.apply(settings.preset(Params(), args.preset), ["capture.depth=mvs", *args.set])
    print("| walk | frames | number | whole, mIoU | held out, dB | CPU s | s |\n" + "|---" * 7 + "|")
    with tempfile.TemporaryDirectory() as temporary:
        place = args.store or Path(temporary)
        for name in args.walks:
            of = walk(name)
            video = written(of, place)
            for choice in args.frames:
                print(measured(of, video, choice, params, place), flush=True)


if __name__ == "__main__":
    main()
