"""CPU time of rendering and its gradient, of a training step and of many small trainings, on one and two threads.

    python tests/bench/bench_rasterizer.py [--scaling PNG]

The scenes are a cloud of Gaussians all through the view, and the surfaces of a room. Times are the thread's own CPU
time, what a tenth of the calls stay below, so that neighbours on the machine matter less; its load stands beside them.
Efficiency is against the peak of the fused multiply-add units, measured in the same run.
"""

from __future__ import annotations

import argparse
import ctypes
import os
import resource
import subprocess
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np

from ss_flow.tasks.artifacts import Gaussians
from ss_flow.tasks.gaussians import library as native
from ss_flow.tasks.gaussians import native_pass
from ss_flow.tasks.gaussians.backends import NativeBackend
from ss_flow.tasks.gaussians.library import Workspace
from ss_flow.tasks.gaussians.native_pass import NativePass, Settings
from ss_flow.tasks.gaussians.render import render
from ss_flow.tasks.gaussians.trainer import TrainParams, train
from ss_flow.tasks.gaussians.views import TrainView
from ss_flow.tasks.geometry.cameras import Camera
from ss_flow.tasks.processor import CPUINFO, INSTRUCTION_SETS, features

CASES = ((2_000, 160, 120, 0), (10_000, 320, 240, 0), (10_000, 320, 240, 3), (50_000, 640, 480, 0))
FLAGS = {
    "avx512": ["-mavx512f", "-mfma", "-mprefer-vector-width=512"],
    "avx2": ["-mavx2", "-mfma"],
    "baseline": [],
}
FORWARD_FLOP, BACKWARD_FLOP = 528, 816
"""Floating-point operations for one Gaussian in one block of sixteen pixels."""


def scene(n: int, degree: int) -> tuple[np.ndarray, ...]:
    """Gaussians all through the view, smaller where there are more."""
    rng = np.random.default_rng(0)
    z = rng.uniform(2, 6, n)
    means = np.stack([rng.uniform(-0.7, 0.7, n) * z, rng.uniform(-0.5, 0.5, n) * z, z], axis=1)
    arrays = (
        means,
        rng.normal(size=(n, 4)),
        np.log(0.05) + 0.4 * rng.normal(size=(n, 3)) - np.log(n / 2000) / 3,
        rng.normal(size=n),
        0.3 * rng.normal(size=(n, (degree + 1) ** 2, 3)),
    )
    return tuple(np.ascontiguousarray(a, np.float32) for a in arrays)


def surfaces(n: int, degree: int) -> tuple[np.ndarray, ...]:
    """Opaque discs on five walls of a room and on eight balls in it, half of them each, as close as they are wide."""
    rng = np.random.default_rng(0)
    low, high = np.array([-3.0, -2, 1]), np.array([3.0, 2, 6])
    walls = np.array([(2, 1), (0, 0), (0, 1), (1, 0), (1, 1)])  # axis that the wall is across; 0 = low side, 1 = high
    size = high - low
    areas = size.prod() / size[walls[:, 0]]
    axis, side = walls[rng.choice(5, n // 2, p=areas / areas.sum())].T
    on_walls = low + size * rng.uniform(size=(n // 2, 3))
    on_walls[np.arange(n // 2), axis] = np.where(side, high[axis], low[axis])
    normals = np.eye(3)[axis] * np.where(side, -1, 1)[:, None]

    centers, radii = rng.uniform((-2, -1, 3), (2, 1.5, 5), (8, 3)), rng.uniform(0.3, 0.7, 8)
    ball = rng.choice(8, n - n // 2, p=radii**2 / (radii**2).sum())
    outward = rng.normal(size=(len(ball), 3))
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    means = np.concatenate([on_walls, centers[ball] + radii[ball, None] * outward])
    normals = np.concatenate([normals, outward])

    spacing = np.sqrt((areas.sum() + 4 * np.pi * (radii**2).sum()) / n)
    z = np.array([0, 0, 1.0])
    # The turn that takes z to the normal; where that is -z, half a turn about x.
    turns = np.concatenate([1 + normals @ z[:, None], np.cross(z, normals)], axis=1)
    turns[np.linalg.norm(turns, axis=1) < 1e-6] = (0, 1, 0, 0)
    along = -0.5 + 0.3 * rng.normal(size=(n, 2))
    log_scales = np.log(spacing) + np.column_stack([along, np.full(n, -2.5)])
    arrays = (means, turns, log_scales, rng.normal(2, 1, n), 0.3 * rng.normal(size=(n, (degree + 1) ** 2, 3)))
    mixed = rng.permutation(n)
    return tuple(np.ascontiguousarray(a[mixed], np.float32) for a in arrays)


def camera_of(width: int, height: int, shift: float = 0.0) -> Camera:
    return Camera(width, height, 0.75 * width, 0.75 * width, width / 2 + shift, height / 2, np.eye(4))


def milliseconds(call: Callable[[], object], seconds: float = 0.7) -> float:
    """What a tenth of the calls stay below, of the thread's CPU time, in calls for so long, five at least.

    Not the median: a neighbour on the same core takes its caches and units too, which counts as our time.
    """
    taken: list[float] = []
    while len(taken) < 5 or sum(taken) < seconds:
        start = time.thread_time()
        call()
        taken.append(time.thread_time() - start)
    return 1e3 * float(np.quantile(taken, 0.1))


def fma_peak(name: str) -> float:
    """GFLOP/s of one thread with an instruction set."""
    with tempfile.TemporaryDirectory() as folder:
        target = Path(folder) / "peak.so"
        source = Path(__file__).with_name("fma_peak.cpp")
        compiler = os.environ.get("CXX", "c++")
        command = [compiler, "-O3", "-std=c++17", "-shared", "-fPIC", *FLAGS[name], str(source), "-o", str(target)]
        subprocess.run(command, check=True)
        measure = ctypes.CDLL(str(target)).fma_peak
        measure.restype, measure.argtypes = ctypes.c_double, [ctypes.c_int64, ctypes.c_float, ctypes.c_void_p]
        sink = np.zeros(1, np.float32)
        return max(float(measure(20_000_000, 0.5, sink.ctypes.data)) for _ in range(5))


def passes(parameters: tuple[np.ndarray, ...], width: int, height: int, degree: int) -> tuple[float, float, int]:
    """Milliseconds forward and backward, and the entries of one scene."""
    camera = camera_of(width, height)
    settings = Settings((0.1, 0.2, 0.3), 0, degree, winners=False)
    workspace = Workspace()
    done = NativePass(parameters, None, camera, settings, workspace=workspace)
    towards = np.full_like(done.rgb, 1e-3)
    surface = np.full_like(done.alpha, 1e-3)
    out = done.backward(towards, surface, surface, None)
    backward = milliseconds(lambda: done.backward(towards, surface, surface, None, out=out))
    entries = done.entries
    forward = milliseconds(lambda: NativePass(parameters, None, camera, settings, workspace=workspace))
    return forward, backward, entries


def processor() -> str:
    """The processor's name, where the system tells."""
    for line in CPUINFO.read_text().splitlines() if CPUINFO.exists() else ():
        if line.startswith("model name"):
            return line.partition(":")[2].strip()
    return "unknown processor"


def rendering() -> None:
    """The four sizes of both scenes on each instruction set."""
    print(f"\n{processor()}")
    for name in (n for n in FLAGS if INSTRUCTION_SETS[n] <= features()):
        chosen = native.library(name)
        native_pass.library = lambda chosen=chosen: chosen  # type: ignore[assignment]
        peak = fma_peak(name)
        print(f"\n{name}: {peak:.0f} GFLOP/s at the peak of one thread")
        print("| scene, Gaussians, image | forward ms | forward + backward ms | ns an entry | share of the peak |")
        print("|---|---|---|---|---|")
        for made, (n, width, height, degree) in ((m, c) for m in (scene, surfaces) for c in CASES):
            forward, backward, entries = passes(made(n, degree), width, height, degree)
            flops = ((FORWARD_FLOP, forward), (BACKWARD_FLOP, backward))
            shares = (100 * flop * entries / (1e6 * ms) / peak for flop, ms in flops)
            kind = "surfaces" if made is surfaces else "cloud"
            print(
                f"| {kind}, {n // 1000}k, {width}x{height}, SH{degree} | {forward:.2f} | {forward + backward:.2f} "
                f"| {1e6 * forward / entries:.1f}, {1e6 * backward / entries:.1f} | "
                + ", ".join(f"{s:.0f} %" for s in shares)
                + " |"
            )


def training_scene(n: int, side: tuple[int, int], labels: int) -> tuple[Gaussians, list[TrainView]]:
    """A scene slightly out of place, and six views of where it should be."""
    rng = np.random.default_rng(1)
    ids = rng.integers(1, max(labels, 1) + 1, n).astype(np.int32)
    ones, zeros = np.ones(n, np.float32), np.zeros(n, np.int32)
    still = Gaussians(*scene(n, 0), instance_id=ids, instance_conf=ones, part_id=zeros)
    views, everywhere = [], np.ones(side[::-1], bool)
    for k in range(6):
        camera = camera_of(*side, shift=3 * k)
        seen = render(still, camera, label_ids=range(1, labels + 1))
        owner = seen.label_masks.argmax(axis=0).astype(np.int32) if labels else None
        views.append(TrainView(camera, np.clip(seen.rgb, 0, 1), everywhere, ~everywhere, seen.depth, owner))
    moved = still.means + 0.01 * rng.normal(size=still.means.shape).astype(np.float32)
    return replace(still, means=moved), views


def steps_a_second(n: int, side: tuple[int, int], labels: int, threads: int, iterations: int = 300) -> float:
    start, views = training_scene(n, side, labels)
    params = TrainParams(iterations=iterations, sh_degree=0, densify="none", mask_weight=1.0 if labels else 0.0)
    began = time.perf_counter()
    train(
        start, views, params=params, extent=4.0, seed=0, label_ids=range(1, labels + 1), backend=NativeBackend(threads)
    )
    return iterations / (time.perf_counter() - began)


def training() -> None:
    """Steps a second: render, L1 + SSIM + alpha + depth, gradient, Adam."""
    print("\nTraining, steps a second:")
    for threads in (1, 2):
        plain, labelled = (steps_a_second(10_000, (320, 240), labels, threads) for labels in (0, 20))
        print(
            f"10k Gaussians, 320x240, SH0, {threads} threads: {plain:.0f}; with 20 labels {labelled:.0f} "
            f"({100 * (plain / labelled - 1):+.0f} % time)"
        )
    rate = steps_a_second(100_000, (640, 480), 0, 2, 20)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss >> 10
    print(f"100k Gaussians, 640x480, 2 threads: {rate:.1f}; the process has used {peak} MB at most")


def small_trainings() -> None:
    """Sixteen instances in crops of 96x96, as the executor runs them."""
    start, views = training_scene(1_000, (96, 96), 0)
    params = TrainParams(iterations=300, sh_degree=0)

    def one(seed: int) -> None:
        train(start, views, params=params, extent=4.0, seed=seed, backend=NativeBackend(1))

    seconds = {}
    for workers in (1, 2):
        began = time.perf_counter()
        with ThreadPoolExecutor(workers) as pool:
            list(pool.map(one, range(16)))
        seconds[workers] = time.perf_counter() - began
    print(
        f"\n16 instances, 1k Gaussians, 96x96, 300 steps: {16 / seconds[1]:.2f} a second with one worker, "
        f"{16 / seconds[2]:.2f} with two ({100 * seconds[1] / seconds[2] / 2:.0f} % of twice as fast)"
    )


def scaling(path: Path) -> None:
    """Time from 1k to 1M Gaussians and from 160x120 to 1920x1080, and how well two prices explain it: one for a
    Gaussian, one for an entry, a (Gaussian, block) pair."""
    from matplotlib.figure import Figure
    from scipy.optimize import nnls

    sizes = ((160, 120), (320, 240), (640, 480), (1920, 1080))
    rows = []
    print("\n| Gaussians, image | entries | forward ms | backward ms |\n|---|---|---|---|")
    for width, height in sizes:
        for n in (1_000, 10_000, 100_000, 1_000_000):
            forward, backward, entries = passes(scene(n, 0), width, height, 0)
            rows.append((width, n, entries, forward, backward))
            print(f"| {n // 1000}k, {width}x{height} | {entries} | {forward:.2f} | {backward:.2f} |", flush=True)
    table = np.array(rows, float)
    figure = Figure(figsize=(9.6, 4.2), layout="constrained")
    for axes, column, name in zip(figure.subplots(1, 2), (3, 4), ("forward", "backward"), strict=True):
        counts, measured = table[:, 1:3], table[:, column]
        prices, _ = nnls(counts / measured[:, None], np.ones(len(table)))  # least squares of relative errors
        for width, height in sizes:
            chosen = table[:, 0] == width
            axes.loglog((counts @ prices)[chosen], measured[chosen], "o-", label=f"{width}x{height}")
        ends = np.array([measured.min(), measured.max()])
        axes.loglog(ends, ends, "k--", linewidth=1)
        axes.set_xlabel(f"{1e6 * prices[0]:.0f} ns x Gaussians + {1e6 * prices[1]:.1f} ns x entries, in ms")
        axes.set_ylabel("measured CPU time of one thread, ms")
        axes.set_title(f"{name}: off by {100 * np.abs(counts @ prices / measured - 1).mean():.0f} % in the mean")
        axes.grid(True, which="both", alpha=0.3)
        axes.legend(fontsize=8)
    figure.savefig(path, dpi=100)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scaling", type=Path, help="only measure how time grows, and plot it here")
    args = parser.parse_args()
    print(f"load of the machine: {os.getloadavg()[0]:.2f}")
    if args.scaling:
        scaling(args.scaling)
    else:
        training()
        small_trainings()
        rendering()


if __name__ == "__main__":
    main()
