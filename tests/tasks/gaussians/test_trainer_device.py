"""Where a training runs, and a picture is drawn: on the CPU or on the device."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from ray_cast_ball import ball_points, ball_view

from ss_flow.tasks.gaussians import rasterize, torch_render, trainer
from ss_flow.tasks.gaussians.backends import NativeBackend
from ss_flow.tasks.gaussians.render import render
from ss_flow.tasks.gaussians.trainer import TrainParams, train
from ss_flow.tasks.gaussians.views import TrainView


def test_small_views_are_trained_on_the_cpu_and_large_ones_on_the_device(monkeypatch):
    asked = []
    monkeypatch.setattr(rasterize, "device_here", lambda: "cuda")
    monkeypatch.setattr(rasterize, "usable_cores", lambda: 2)
    monkeypatch.setattr(trainer, "backend_for", lambda device, threads: asked.append(device) or NativeBackend(threads))
    for side in (199, 200):
        view = ball_view(0.0)
        camera = replace(view.camera, width=side, height=side)
        blank = np.zeros((side, side), bool)
        large = TrainView(
            camera, np.zeros((side, side, 3), np.float32), ~blank, blank, np.zeros(blank.shape, np.float32)
        )
        train(ball_points(), [large], params=TrainParams(iterations=1), extent=1.6, seed=1)
    assert asked == ["cpu", "cuda"]


@pytest.mark.parametrize(("cores", "small"), [(1, 40_000), (3, 40_000), (4, 52_000), (16, 208_000)])
def test_the_more_cores_the_larger_are_the_pictures_for_them(monkeypatch, cores, small):
    monkeypatch.setattr(rasterize, "device_here", lambda: "cuda")
    monkeypatch.setattr(rasterize, "usable_cores", lambda: cores)
    assert rasterize.device_for(small - 1) == "cpu"
    assert rasterize.device_for(small) == "cuda"


def test_small_pictures_are_drawn_on_the_cpu_and_large_ones_on_the_device(monkeypatch):
    drawn = []
    monkeypatch.setattr(rasterize, "device_here", lambda: "cuda")
    monkeypatch.setattr(rasterize, "usable_cores", lambda: 4)
    monkeypatch.setattr(torch_render, "draw", lambda device, parameters, labels, camera, settings: drawn.append(camera))
    view = ball_view(0.0).camera
    small, large = replace(view, width=259, height=200), replace(view, width=260, height=200)
    assert render(ball_points(), small).rgb.shape == (200, 259, 3)
    with pytest.raises(AttributeError):  # of the stand-in, which draws nothing
        render(ball_points(), large)
    assert drawn == [large]
