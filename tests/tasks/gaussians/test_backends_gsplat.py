"""The adapter to gsplat, over a stand-in with its rules."""

from __future__ import annotations

import inspect

import gsplat_on_the_cpu
import numpy as np
import pytest
import torch
from trainer_backends import example

from ss_flow.tasks.gaussians.native_pass import Settings
from ss_flow.tasks.gaussians.objective import Objective
from ss_flow.tasks.gaussians.rasterize import GaussianTensors, renderer_on
from ss_flow.tasks.geometry.cameras import Camera


def test_the_stand_in_takes_what_gsplat_takes():
    gsplat = pytest.importorskip("gsplat")
    for name in ("fully_fused_projection", "isect_tiles", "isect_offset_encode", "rasterize_to_pixels",
                 "rasterize_to_indices_in_range", "spherical_harmonics"):  # fmt: skip
        ours, theirs = (inspect.signature(getattr(one, name)) for one in (gsplat_on_the_cpu, gsplat))
        assert [(p.name, p.default) for p in ours.parameters.values()] == [
            (p.name, p.default) for p in theirs.parameters.values()
        ]


def test_through_gsplat_a_crop_shows_what_its_photo_shows_there(stand_in):
    values, _, target = example(12, Objective(), with_labels=False)
    # Some lie far outside the crop, where its own limit of slopes would be another one.
    gaussians = GaussianTensors(**{n: torch.tensor(v) for n, v in values.items()})
    gaussians.log_scales += 1
    renderer, device = renderer_on(torch.device("cuda")), torch.device("cpu")
    drawn = []
    for camera in (target.camera, target.camera.cropped(30, 5, 44, 20)):
        where, settings = renderer.camera_on(device, camera), Settings((0.1, 0.2, 0.3), 0, 1, winners=True)
        background = torch.tensor(settings.background)
        drawn.append(renderer.draw(gaussians, where, background, None, settings, torch.zeros(120, 2)))
    whole, part = drawn
    for name in ("rgb", "alpha", "depth"):
        torch.testing.assert_close(getattr(part, name), getattr(whole, name)[5:20, 30:44], rtol=0, atol=1e-5)
    assert torch.equal(part.top_contributor, whole.top_contributor[5:20, 30:44])
    assert 0 < int((part.radii > 0).sum()) < int((whole.radii > 0).sum())


def test_through_gsplat_a_pixel_that_an_opaque_gaussian_ends_gives_no_weight_to_those_behind(stand_in):
    """gsplat lists 256 at a time: with 255 in front, the opaque one is the last of a list and the faint ones begin the
    next."""
    camera, device, settings = (
        Camera(1, 1, 1.0, 1.0, 0.5, 0.5, np.eye(4)),
        torch.device("cpu"),
        Settings((0, 0, 0), 0, 0, True),
    )
    renderer = renderer_on(torch.device("cuda"))
    for front in (200, 255, 300):
        opacity = torch.tensor([0.0117] * front + [0.9996, 0.9, 0.0117])
        n = len(opacity)
        gaussians = GaussianTensors(
            means=torch.stack([torch.zeros(n), torch.zeros(n), torch.linspace(1, 2, n)], dim=1),
            quaternions=torch.tensor([[1.0, 0, 0, 0]]).repeat(n, 1),
            log_scales=torch.full((n, 3), np.log(5.0)),
            opacity_logits=torch.logit(opacity),
            sh=torch.zeros(n, 1, 3),
        )
        where = renderer.camera_on(device, camera)
        drawn = renderer.draw(gaussians, where, torch.zeros(3), None, settings, torch.zeros(n, 2))
        assert drawn.max_contribution.sum() == pytest.approx(float(drawn.alpha), abs=1e-5)
        assert not drawn.max_contribution[front:].any()
