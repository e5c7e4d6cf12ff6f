"""PSNR and SSIM of plain 3DGS on held-out views (every eighth) after so many iterations.

python tests/bench/bench_quality.py CAPTURE --iterations 1000 5000 10000 [--colours] --densify classic none
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from ss_flow.cache.store import Store
from ss_flow.engine import run_flow
from ss_flow.flows.capture import capture
from ss_flow.flows.params import CaptureParams
from ss_flow.running import Surroundings, running
from ss_flow.task import FileRef
from ss_flow.tasks.artifacts import Cameras, ColourTransform, DepthMap, Frame, Gaussians, PointCloud, SceneUnit
from ss_flow.tasks.capture.colours import ColourParams, colours
from ss_flow.tasks.capture.scene import open_scene
from ss_flow.tasks.evaluate.neighbour_colours import NeighbourColours
from ss_flow.tasks.evaluate.novel_view import colour_fitted, psnr, ssim, to_8bit
from ss_flow.tasks.gaussians.initialise import initialise
from ss_flow.tasks.gaussians.learning_rates import SLOW_RATES
from ss_flow.tasks.gaussians.render import render
from ss_flow.tasks.gaussians.trainer import TrainParams, train
from ss_flow.tasks.gaussians.views import TrainView
from ss_flow.tasks.geometry.cameras import camera_of
from ss_flow.tasks.geometry.images import decode_rgb, decode_valid, transformed
from ss_flow.tasks.geometry.shape import box_diagonal
from ss_flow.tasks.models.catalogue import blake3_of
from ss_flow.tasks.splat.reconstruct import thin
from ss_flow.tasks.split.dense import DenseParams, dense


def load(path: Path, store: Store) -> tuple[list[Frame], Cameras, list[DepthMap], PointCloud]:
    """A capture as the DAG reads it."""

    def build() -> dict[str, object]:
        nodes = capture(open_scene(path), lambda p: FileRef(p, blake3_of(p)), CaptureParams(), None)
        points = dense(nodes.frames, nodes.cameras, nodes.depths, nodes.unit, params=DenseParams())
        return {"frames": nodes.frames, "cameras": nodes.cameras, "depths": nodes.depths, "points": points}

    values = run_flow(build, store, scene=str(path), header={}).values
    many = {name: [store.get(d) for d in values[name]] for name in ("frames", "depths")}
    return many["frames"], store.get(values["cameras"]), many["depths"], store.get(values["points"])


def view_of(frame: Frame, cameras: Cameras, depth: DepthMap, index: int, side: int) -> TrainView:
    """A whole photo to train on, its longer side at most `side`."""
    import cv2

    shrink = min(1.0, side / max(frame.width, frame.height))
    size = (round(frame.width * shrink), round(frame.height * shrink))
    camera = camera_of(cameras, index).scaled(*size)
    image = cv2.resize(decode_rgb(frame), size, interpolation=cv2.INTER_AREA).astype(np.float32) / 255
    inside = cv2.resize(decode_valid(frame).astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0
    z = cv2.resize(depth.depth, size, interpolation=cv2.INTER_NEAREST)
    return TrainView(camera, image, inside, np.zeros_like(inside), z)


def even(
    rows: Sequence[int], frames: list[Frame], cameras: Cameras, depths: list[DepthMap], unit: float
) -> tuple[ColourTransform, ...]:
    """What gives these rows of the frames the colours of one of them."""
    own = replace(
        cameras,
        names=tuple(cameras.names[row] for row in rows),
        sizes=cameras.sizes[rows],
        intrinsics=cameras.intrinsics[rows],
        world_to_camera=cameras.world_to_camera[rows],
    )
    known = tuple(frames[row] for row in rows), own, tuple(depths[row] for row in rows), SceneUnit(unit)
    return colours(*known, params=ColourParams())


def expected(scene: Gaussians, views: list[TrainView], beside: NeighbourColours, names: Sequence[str]) -> float:
    """PSNR in the colours that the photos beside let expect, mean over views."""
    values = []
    for view, name in zip(views, names, strict=True):
        rgb = beside.applied(render(scene, view.camera).rgb, name, scene, view.camera)
        values.append(psnr(to_8bit(rgb), to_8bit(view.image), view.inside))
    return float(np.mean(values))


def measured(scene: Gaussians, views: list[TrainView]) -> tuple[float, float, float]:
    """PSNR, PSNR after a fit of colours to each view, and SSIM: means over views."""
    values = []
    for view in views:
        rgb, photo = np.clip(render(scene, view.camera).rgb, 0, 1), to_8bit(view.image)
        image, fitted = to_8bit(rgb), to_8bit(colour_fitted(rgb, photo, view.inside))
        values.append(
            [psnr(image, photo, view.inside), psnr(fitted, photo, view.inside), ssim(image, photo, view.inside)]
        )
    plain, after, similarity = np.mean(values, axis=0).tolist()
    return plain, after, similarity


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("capture", type=Path)
    parser.add_argument("--iterations", type=int, nargs="+", default=[1000, 5000, 10_000])
    parser.add_argument("--densify", nargs="+", default=["classic"])
    parser.add_argument("--side", type=int, default=640)
    parser.add_argument("--points", type=int, default=50_000)
    parser.add_argument("--most", type=int, default=150_000)
    parser.add_argument("--sh-degree", type=int, default=3)
    parser.add_argument("--colours", action="store_true", help="even out the exposure of the photos first")
    parser.add_argument("--cores", type=int, default=2)
    parser.add_argument("--store", type=Path, default=Path(tempfile.gettempdir()) / "ss-flow-bench")
    args = parser.parse_args()
    frames, cameras, depths, cloud = load(args.capture, Store(args.store))
    views = [view_of(f, cameras, d, i, args.side) for i, (f, d) in enumerate(zip(frames, depths, strict=True))]
    held_out = [v for i, v in enumerate(views) if i % 8 == 0]
    rows_of_training = [i for i in range(len(views)) if i % 8]
    training = [views[i] for i in rows_of_training]
    transforms: tuple[ColourTransform, ...] = ()
    if args.colours:
        transforms = even(rows_of_training, frames, cameras, depths, cloud.unit)
        training = [replace(v, image=transformed(v.image, of)) for v, of in zip(training, transforms, strict=True)]
    rows = thin(cloud.points, args.points)
    initial = initialise(cloud.points[rows], cloud.colors[rows], 0, 1.0)
    print(f"{args.capture.name}: {len(training)} views to train, {len(held_out)} held out, {len(rows)} points")
    for strategy in args.densify:
        for iterations in args.iterations:
            params = TrainParams(
                iterations=iterations,
                sh_degree=args.sh_degree,
                densify=strategy,
                max_gaussians=args.most,
                rates=SLOW_RATES,
            )
            start = time.perf_counter()
            with running(Surroundings(cores=args.cores)):
                result = train(initial, training, params=params, extent=box_diagonal(cloud.points), seed=0)
            seconds = time.perf_counter() - start
            quality = measured(result.gaussians, held_out)
            print(
                f"{strategy} {result.iterations:6} iterations: PSNR {quality[0]:.2f} dB, colours fitted "
                f"{quality[1]:.2f} dB, SSIM {quality[2]:.3f}, "
                f"training views {measured(result.gaussians, training)[0]:.2f} dB, {len(result.gaussians)} Gaussians, "
                f"{seconds:.0f} s",
                flush=True,
            )
            if transforms:
                beside = NeighbourColours.of(result.gaussians, [view.camera for view in training], transforms)
                names = [frame.name for i, frame in enumerate(frames) if i % 8 == 0]
                metered, mean = (
                    expected(result.gaussians, held_out, one, names) for one in (beside, replace(beside, metering=0.0))
                )
                print(f"in the colours of the photos beside {metered:.2f} dB, without metering {mean:.2f}", flush=True)


if __name__ == "__main__":
    main()
