"""The backends of a trainer beside each other, and what they are compared on."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from ss_flow.tasks.gaussians.backends import NativeBackend
from ss_flow.tasks.gaussians.initialise import initialise, select
from ss_flow.tasks.gaussians.native_pass import PARAMETERS
from ss_flow.tasks.gaussians.objective import Objective, Target
from ss_flow.tasks.gaussians.rasterize import device_here, renderer_on
from ss_flow.tasks.gaussians.render import render
from ss_flow.tasks.gaussians.torch_backend import TorchBackend
from ss_flow.tasks.gaussians.trainer import TrainParams, train
from ss_flow.tasks.gaussians.views import TrainView
from ss_flow.tasks.geometry.cameras import Camera

NATIVE = NativeBackend(1)
CUDA = pytest.param("cuda", marks=pytest.mark.skipif(device_here() != "cuda", reason="no CUDA with gsplat here"))


def through_gsplat(device: str) -> TorchBackend:
    backend = TorchBackend(device)
    backend._renderer = renderer_on(torch.device("cuda"))
    return backend


def tolerance(backend: TorchBackend) -> float:
    """How far gradients may be from the native ones: gsplat has thresholds of its own."""
    return 2e-4 if backend._device.type == "cpu" else 2e-3


def put(backend, values):
    return {name: backend.put(value) for name, value in values.items()}


def example(seed: int, objective: Objective, *, with_labels: bool):
    rng = np.random.default_rng(seed)
    n, h, w = 120, 33, 46
    parameters = (
        rng.uniform((-0.8, -0.6, 1.5), (0.8, 0.6, 3.0), (n, 3)),
        rng.normal(size=(n, 4)),
        np.log(0.08) + 0.4 * rng.normal(size=(n, 3)),
        rng.normal(size=n),
        0.4 * rng.normal(size=(n, 4, 3)),
    )
    inside = rng.random((h, w)) < 0.6
    view = TrainView(
        Camera(w, h, 40.0, 40.0, w / 2, h / 2, np.eye(4)),
        rng.random((h, w, 3)).astype(np.float32),
        inside,
        ~inside & (rng.random((h, w)) < 0.5),
        np.where(rng.random((h, w)) < 0.8, 2.0 + rng.random((h, w)), 0).astype(np.float32),
        rng.integers(-2, 5, (h, w)).astype(np.int32) if with_labels else None,
    )
    labels = rng.integers(-1, 7, n).astype(np.int32) if with_labels else None
    values = {n: np.ascontiguousarray(p, np.float32) for n, p in zip(PARAMETERS, parameters, strict=True)}
    return values, labels, Target.of(view, objective, 7)


def trained(backend, params: TrainParams, seed: int = 1):
    """A few dozen Gaussians on four views of a scene of many."""
    rng = np.random.default_rng(seed)
    made = initialise(rng.uniform((-0.8, -0.6, 1.5), (0.8, 0.6, 3.0), (150, 3)).astype(np.float32),
                      rng.integers(0, 255, (150, 3)).astype(np.uint8), 3, 1.0, opacity=0.5)  # fmt: skip
    views = []
    for x in (-0.3, -0.1, 0.1, 0.3):
        pose = np.eye(4)
        pose[0, 3] = x
        camera = Camera(46, 33, 40.0, 40.0, 23.0, 16.5, pose)
        image = render(made, camera).rgb.clip(0, 1)
        inside = image.sum(axis=2) > 0.2
        views.append(TrainView(camera, image, inside, ~inside, np.zeros(inside.shape, np.float32)))
    first = select(made, np.arange(60))
    return train(first, views, params=params, extent=2.0, seed=seed, backend=backend)
