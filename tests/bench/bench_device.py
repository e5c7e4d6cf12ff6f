"""Training on a device beside the plain loop that gsplat's users write, steps a second, turn by turn in one run.

    python tests/bench/bench_device.py                                            # on CUDA: 100k Gaussians, 1920x1080
    python tests/bench/bench_device.py --device cpu --gaussians 500 --size 64x48  # the same code, without a GPU
    python tests/bench/bench_device.py --growth                                   # from which size a device pays

Ours: `train` on the torch backend: colour, alpha and depth, its own Adam, nothing checked from step to step. The plain
loop: six parameters with a fused `torch.optim.Adam` each, gsplat's `rasterization` and `DefaultStrategy` (which
densifies nothing in so few steps), L1 + SSIM by torchmetrics. On torch's CPU device the native rasterizer stands in
for gsplat's, and no figure of it says anything about a GPU.

--growth: trainings of growing size on the device and on the CPU, alone, and four side by side as a run has them: the
steps of all together.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import torch

from ss_flow.running import Surroundings, running
from ss_flow.tasks.artifacts import Gaussians
from ss_flow.tasks.gaussians.backends import Backend, NativeBackend
from ss_flow.tasks.gaussians.initialise import initialise, with_sh_degree
from ss_flow.tasks.gaussians.learning_rates import LearningRates
from ss_flow.tasks.gaussians.rasterize import GaussianTensors, rasterize
from ss_flow.tasks.gaussians.render import render
from ss_flow.tasks.gaussians.torch_backend import TorchBackend
from ss_flow.tasks.gaussians.trainer import TrainParams, train
from ss_flow.tasks.gaussians.views import TrainView
from ss_flow.tasks.geometry.cameras import Camera

RATES = LearningRates()
GROWTH = ((500, 64, 48), (1_000, 96, 96), (3_000, 160, 120), (10_000, 320, 240), (50_000, 640, 480))
SIDE_BY_SIDE = 4
NAMES = {"means": "means", "scales": "log_scales", "quats": "quaternions", "opacities": "opacity_logits"}


def scene(count: int, width: int, height: int, degree: int) -> tuple[Gaussians, list[TrainView]]:
    """A cloud of Gaussians, and what eight cameras before it see."""
    rng = np.random.default_rng(0)
    points = rng.uniform((-1.6, -0.9, 2), (1.6, 0.9, 4), (count, 3)).astype(np.float32)
    cloud = initialise(points, rng.integers(0, 256, (count, 3)).astype(np.uint8), 1, 1.0, opacity=0.5)
    views = []
    for x in np.linspace(-0.3, 0.3, 8):
        pose = np.eye(4)
        pose[0, 3] = x
        camera = Camera(width, height, width, width, width / 2, height / 2, pose)
        seen = render(cloud, camera)
        inside = np.ones(seen.alpha.shape, bool)
        depth = np.where(seen.alpha > 0.5, seen.depth / np.maximum(seen.alpha, 1e-6), 0).astype(np.float32)
        views.append(TrainView(camera, seen.rgb.clip(0, 1), inside, ~inside, depth))
    grey = np.zeros_like(cloud.sh)
    return with_sh_degree(Gaussians(**{**vars(cloud), "sh": grey}), degree), views


def ours(initial: Gaussians, views: list[TrainView], steps: int, backend: Backend) -> float:
    """Steps a second, the first 50 left out."""
    times = []

    def note(done: int, total: int, text: str) -> None:
        times.append((done, time.perf_counter()))

    params = TrainParams(iterations=50 + steps, densify="none", prune_opacity=0.0, prune_contribution=0.0)
    with running(Surroundings(note)):
        train(initial, views, params=params, extent=2.0, seed=0, backend=backend)
    (first, begun), (last, ended) = times[0], times[-1]
    return (last - first) / (ended - begun)


def plain(initial: Gaussians, views: list[TrainView], steps: int, device: str) -> float:
    """Steps a second, the first 50 left out."""
    from torchmetrics.functional.image import structural_similarity_index_measure as ssim

    values = {ours: torch.tensor(getattr(initial, name), device=device) for ours, name in NAMES.items()}
    sh = torch.tensor(initial.sh, device=device)
    values |= {"sh0": sh[:, :1].contiguous(), "shN": sh[:, 1:].contiguous()}
    rates = {"means": 2 * RATES.position, "scales": RATES.scale, "quats": RATES.rotation, "opacities": RATES.opacity}
    rates |= {"sh0": RATES.color, "shN": RATES.color / 20}
    params = {name: torch.nn.Parameter(value) for name, value in values.items() if value.numel()}
    optimizers = {
        name: torch.optim.Adam([{"params": param, "lr": rates[name]}], eps=1e-15, fused=True)
        for name, param in params.items()
    }
    photos = [torch.tensor(view.image, device=device) for view in views]
    draw, after = _with_gsplat(params, optimizers, device) if device != "cpu" else _on_the_cpu(params)
    for step in range(50 + steps):
        if step == 50:
            _wait(device)
            begun = time.perf_counter()
        view = step % len(views)
        image, info = draw(views[view].camera)
        x, y = (i.permute(2, 0, 1)[None] for i in (image, photos[view]))
        loss = 0.8 * (x - y).abs().mean() + 0.2 * (1 - ssim(x, y, data_range=1.0))
        loss.backward()
        for optimizer in optimizers.values():
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)
        after(step, info)
    _wait(device)
    return steps / (time.perf_counter() - begun)


def growth(steps: int, degree: int, device: str) -> None:
    """Print a table of steps a second by size."""
    ways: dict[str, tuple[int, Callable[[], Backend]]] = {
        device: (1, lambda: TorchBackend(device)),
        f"{device}, {SIDE_BY_SIDE} at once": (SIDE_BY_SIDE, lambda: TorchBackend(device)),
        "CPU, 1 thread": (1, lambda: NativeBackend(1)),
        f"CPU, {SIDE_BY_SIDE} at once": (SIDE_BY_SIDE, lambda: NativeBackend(1)),
        f"CPU, {SIDE_BY_SIDE} threads": (1, lambda: NativeBackend(SIDE_BY_SIDE)),
    }
    print(f"| Gaussians, picture | {' | '.join(ways)} |\n|---{'|---' * len(ways)}|")
    for count, width, height in GROWTH:
        made = scene(count, width, height, degree)
        rates = [together(*made, steps, many, make) for many, make in ways.values()]
        print(f"| {count}, {width}x{height} | {' | '.join(f'{rate:.0f}' for rate in rates)} |", flush=True)


def together(initial: Gaussians, views: list[TrainView], steps: int, many: int, make: Callable[[], Backend]) -> float:
    """Steps a second of so many trainings side by side."""
    with ThreadPoolExecutor(many) as pool:
        return sum(pool.map(lambda _: ours(initial, views, steps, make()), range(many)))


def _with_gsplat(params: dict, optimizers: dict, device: str) -> tuple[Callable, Callable]:
    from gsplat import DefaultStrategy, rasterization

    strategy = DefaultStrategy(refine_start_iter=10**6)
    state = strategy.initialize_state(scene_scale=1.0)

    def draw(camera: Camera):
        colors = torch.cat([params["sh0"], params["shN"]], 1) if "shN" in params else params["sh0"]
        pose = torch.tensor(camera.world_to_camera, dtype=torch.float32, device=device)[None]
        matrix = [[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]]
        images, _, info = rasterization(
            params["means"], params["quats"], torch.exp(params["scales"]), torch.sigmoid(params["opacities"]), colors,
            pose, torch.tensor([matrix], dtype=torch.float32, device=device), camera.width, camera.height,
            sh_degree=round(colors.shape[1] ** 0.5) - 1, packed=False,
        )  # fmt: skip
        strategy.step_pre_backward(params, optimizers, state, 0, info)
        return images[0], info

    return draw, lambda step, info: strategy.step_post_backward(params, optimizers, state, step, info)


def _on_the_cpu(params: dict) -> tuple[Callable, Callable]:
    def draw(camera: Camera):
        sh = torch.cat([params["sh0"], params["shN"]], 1) if "shN" in params else params["sh0"]
        gaussians = GaussianTensors(params["means"], params["quats"], params["scales"], params["opacities"], sh)
        return rasterize(gaussians, camera, background=(0.0, 0.0, 0.0)).rgb, None

    return draw, lambda step, info: None


def _wait(device: str) -> None:
    if device != "cpu":
        torch.cuda.synchronize()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cuda", choices=("cuda", "cpu"))
    parser.add_argument("--gaussians", type=int, default=100_000)
    parser.add_argument("--size", default="1920x1080", help="of the pictures, WIDTHxHEIGHT")
    parser.add_argument("--degree", type=int, default=0, help="of the colours, 0 to 3")
    parser.add_argument("--steps", type=int, default=200)
    parser.add_argument("--turns", type=int, default=3)
    parser.add_argument("--growth", action="store_true", help="trainings of growing size, on the device and on the CPU")
    asked = parser.parse_args()
    width, height = map(int, asked.size.split("x"))
    name = torch.cuda.get_device_name() if asked.device == "cuda" else "torch's CPU device, the native rasterizer"
    print(f"{name}; torch {torch.__version__}")
    if asked.growth:
        growth(asked.steps, asked.degree, asked.device)
        return
    print(f"{asked.gaussians} Gaussians, {asked.size}, degree {asked.degree}")
    initial, views = scene(asked.gaussians, width, height, asked.degree)
    rates: dict[str, list[float]] = {"ours": [], "plain": []}
    for _ in range(asked.turns):
        rates["ours"].append(ours(initial, views, asked.steps, TorchBackend(asked.device)))
        rates["plain"].append(plain(initial, views, asked.steps, asked.device))
    for way, measured in rates.items():
        print(f"{way:6} {statistics.median(measured):8.1f} steps a second ({', '.join(f'{r:.1f}' for r in measured)})")
    print(f"ours / plain: {statistics.median(a / b for a, b in zip(*rates.values(), strict=True)):.2f}")
    if asked.device == "cuda":
        print(f"most memory: {torch.cuda.max_memory_allocated() >> 20} MB")


if __name__ == "__main__":
    main()
