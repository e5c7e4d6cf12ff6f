"""How much depth several views give without a sensor, how right it is, and what it costs.

    python tests/bench/bench_stereo.py CAPTURE [--stride 1] [--set STEP.PARAM=VALUE ...] [--pictures FOLDER]
    python tests/bench/bench_stereo.py --room 0 [--views 24]

CAPTURE is a posed capture; where it has a sensor's depth, that is the truth, else only what is known is told. A room is
generated, with exact depth. Printed after the sweep and after each round, by itself and as far as views agree, and at
last with surfaces that go on flat: the share of all pixels that are known, of these (where the truth is known) the
shares within 5 and 2 percent of the truth, the share of the truth's pixels that are known and within 5 percent, and CPU
seconds a view. Pictures show the photo, the truth, the agreed sweep, the agreed last round and the last line's depth of
ten views beside each other.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TypeVar

import cv2
import numpy as np

from ss_flow.flows import settings
from ss_flow.flows.generated import RoomParams, generate
from ss_flow.flows.params import Params
from ss_flow.task import FileRef
from ss_flow.tasks.artifacts import Cameras, DepthMap, Float32, Frame
from ss_flow.tasks.capture import ingest, sensor_depth
from ss_flow.tasks.capture.depth import agree, sweep
from ss_flow.tasks.capture.neighbors import neighbors
from ss_flow.tasks.capture.planes import planes
from ss_flow.tasks.capture.scene import open_scene
from ss_flow.tasks.capture.stereo import stereo
from ss_flow.tasks.geometry.cameras import cameras_by_view
from ss_flow.tasks.geometry.images import decode_rgb, encode_png

T = TypeVar("T")


def captured(path: Path, stride: int) -> tuple[tuple[Frame, ...], Cameras, list[Float32]]:
    """Frames, cameras and the sensor's depth (none: no maps) of every `stride`-th view."""
    scene = open_scene(path)
    assert scene.poses is not None and scene.lenses is not None, "a posed capture is needed"
    skip = slice(None, None, stride)

    def files(paths: Sequence[Path | None]) -> tuple[FileRef | None, ...]:
        return tuple(None if p is None else FileRef(p, p.name) for p in paths[skip])

    names, lenses = scene.names[skip], scene.lenses[skip]
    frames = ingest.frames(names=names, photos=files(scene.photos), valid=files(scene.valid), lenses=lenses)
    cameras = ingest.cameras(frames, names=names, lenses=lenses, poses=scene.poses[skip], metric=scene.metric)
    if scene.depths is None:
        return frames, cameras, []
    maps = sensor_depth.depth(
        frames,
        names=names,
        files=files(scene.depths),
        scale=scene.depth_scale,
        metric=scene.metric,
        lenses=lenses,
        depth_lens=scene.depth_lens,
    )
    return frames, cameras, [m.depth for m in maps]


def generated(seed: int, views: int) -> tuple[tuple[Frame, ...], Cameras, list[Float32]]:
    room = generate(RoomParams(objects=10, views=views, width=540, height=360, seed=seed, held_out=0))
    none = np.zeros(0, np.uint8)
    photos = zip(room.cameras.names, room.rgb, strict=True)
    return tuple(Frame(n, 540, 360, encode_png(p), none, 540, 360) for n, p in photos), room.cameras, list(room.depth)


def tell(step: str, maps: Sequence[DepthMap], truth: Sequence[Float32], seconds: float) -> None:
    known = np.mean([(m.depth > 0).mean() for m in maps])
    line = f"{step:18s} known {known:.3f}"
    if truth:
        compared, off = [], []
        for m, true in zip(maps, truth, strict=True):
            t = cv2.resize(true, m.depth.shape[::-1], interpolation=cv2.INTER_NEAREST)
            compared.append(m.depth[t > 0] > 0)
            off.append(np.abs(m.depth[t > 0] / t[t > 0] - 1))
        both, error = np.concatenate(compared), np.concatenate(off)
        within5, within2 = (np.mean(error[both] < limit) for limit in (0.05, 0.02))
        line += f", of these within 5 % {within5:.3f}, 2 % {within2:.3f}"
        line += f"; found and right {np.mean(both & (error < 0.05)):.3f}"
    print(f"{line}; {seconds / len(maps):.2f} CPU s a view", flush=True)


def some(items: Sequence[T], places: list[int]) -> tuple[T, ...]:
    return tuple(items[k] for k in places)


def picture(frame: Frame, maps: Sequence[Float32]) -> np.ndarray:
    """The photo and depth maps side by side, in BGR, coloured by inverse depth over the range of the first map."""
    size = (frame.width * 360 // frame.height, 360)
    tiles = [cv2.resize(cv2.cvtColor(decode_rgb(frame), cv2.COLOR_RGB2BGR), size, interpolation=cv2.INTER_AREA)]
    near, far = np.quantile(maps[0][maps[0] > 0], (0.02, 0.98)) if maps[0].any() else (1.0, 2.0)
    for depth in maps:
        inverse = (1 / np.where(depth > 0, depth, far) - 1 / far) / (1 / near - 1 / far)
        colored = cv2.applyColorMap((np.clip(inverse, 0, 1) * 255).astype(np.uint8), cv2.COLORMAP_TURBO)
        tiles.append(cv2.resize(np.where(depth[..., None] > 0, colored, 0), size, interpolation=cv2.INTER_NEAREST))
    return np.hstack(tiles)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("capture", type=Path, nargs="?")
    parser.add_argument("--room", type=int, default=0, help="seed of the room, where no capture is named")
    parser.add_argument("--views", type=int, default=24, help="of the room")
    parser.add_argument("--stride", type=int, default=1, help="every n-th view of the capture")
    parser.add_argument("--set", nargs="*", default=[], help="of `capture`")
    parser.add_argument("--pictures", type=Path)
    options = parser.parse_args()
    cv2.setNumThreads(1)
    params = settings.apply(Params(), options.set).capture
    frames, cameras, truth = (
        captured(options.capture, options.stride) if options.capture else generated(options.room, options.views)
    )
    near, by_view = neighbors(cameras, params=params.neighbors), cameras_by_view(cameras)

    def of_each(step: str, work: Callable[[int, list[int]], DepthMap]) -> tuple[DepthMap, ...]:
        """A step of all views; `work` is told a view, and it with its neighbours."""
        begun = time.process_time()
        maps = tuple(work(k, near.around(k)) for k in range(len(frames)))
        tell(step, maps, truth, time.process_time() - begun)
        return maps

    def agreement(step: str, maps: tuple[DepthMap, ...]) -> tuple[DepthMap, ...]:
        def confirmed(_: int, around: list[int]) -> DepthMap:
            return agree(some(maps, around), some(by_view, around), params=params.agreement)

        return of_each(f"{step}, agreed", confirmed)

    found = of_each(
        "swept",
        lambda k, around: sweep(some(frames, around), some(by_view, around), span=near.span_of(k), params=params.sweep),
    )
    swept = agreed = agreement("swept", found)
    for number in range(params.stereo.rounds):
        before, confirmed, step = found, agreed, f"round {number + 1}"
        found = of_each(
            step,
            lambda k, around, before=before, confirmed=confirmed: stereo(
                some(frames, around), some(by_view, around), before[k], some(confirmed, around), params=params.stereo
            ),
        )
        agreed = agreement(step, found)
    flat = of_each("and going on flat", lambda k, _: planes(frames[k], agreed[k], params=params.planes))
    if options.pictures:
        options.pictures.mkdir(parents=True, exist_ok=True)
        for k in range(0, len(frames), max(1, len(frames) // 10)):
            maps = [*([truth[k]] if truth else []), swept[k].depth, agreed[k].depth, flat[k].depth]
            cv2.imwrite(str(options.pictures / f"{frames[k].name}.png"), picture(frames[k], maps))


if __name__ == "__main__":
    main()
