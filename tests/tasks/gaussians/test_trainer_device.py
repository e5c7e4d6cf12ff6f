"""Where a training runs, on the CPU or on the device."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from ray_cast_ball import ball_points, ball_view

from ss_flow.running import Surroundings, running
from ss_flow.tasks.gaussians import trainer
from ss_flow.tasks.gaussians.backends import NativeBackend
from ss_flow.tasks.gaussians.trainer import TrainParams, train
from ss_flow.tasks.gaussians.views import TrainView
from ss_flow.tasks.geometry.cameras import Camera


def test_small_views_are_trained_on_the_cpu_and_large_ones_on_the_device(monkeypatch):
    asked = []
    monkeypatch.setattr(trainer, "device_here", lambda: "cuda")
    monkeypatch.setattr(trainer, "backend_for", lambda device, threads: asked.append(device) or NativeBackend(threads))
    for side in (199, 200):
        view = ball_view(0.0)
        camera = replace(view.camera, width=side, height=side)
        blank = np.zeros((side, side), bool)
        large = TrainView(
            camera, np.zeros((side, side, 3), np.float32), ~blank, blank, np.zeros(blank.shape, np.float32)
        )
        with running(Surroundings(cores=2)):
            train(ball_points(), [large], params=TrainParams(iterations=1), extent=1.6, seed=1)
    assert asked == ["cpu", "cuda"]


@pytest.mark.parametrize(
    ("machine", "own", "small"),
    [
        (2, 2, 40_000), (16, 3, 40_000), (4, 4, 52_000), (16, 16, 208_000),
        (1, 1, 13_000), (4, 1, 52_000), (16, 1, 208_000),
    ],
)  # fmt: skip
def test_the_more_cores_or_trainings_at_once_the_larger_are_those_for_the_cpu(monkeypatch, machine, own, small):
    monkeypatch.setattr(trainer, "device_here", lambda: "cuda")
    monkeypatch.setattr(trainer, "usable_cores", lambda: machine)

    def view(pixels: int) -> TrainView:
        camera = Camera(pixels // 100, 100, 60.0, 60.0, 0.0, 0.0, np.eye(4))
        return TrainView(camera, *(np.zeros(0),) * 4)

    with running(Surroundings(cores=own)):
        assert trainer._device([view(small - 1000), view(small)]) == "cpu"
        assert trainer._device([view(small - 1000), view(small + 1000)]) == "cuda"
