"""Losses against torch autograd of their definitions."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from ss_flow.tasks.gaussians.library import address, library
from ss_flow.tasks.gaussians.losses import photometric, weighted_l1


def reference(image, target, weight, ssim_weight):
    x, y = (torch.where(weight[..., None] > 0, t, 0.0).permute(2, 0, 1)[:, None] for t in (image, target))
    offsets = torch.arange(-5, 6, dtype=torch.float64)
    window = torch.exp(-offsets.square() / 4.5)
    window = torch.outer(window, window)[None, None] / window.sum() ** 2

    def blur(t):
        return torch.nn.functional.conv2d(t, window, padding=5)

    mx, my = blur(x), blur(y)
    vx, vy, cov = blur(x * x) - mx * mx, blur(y * y) - my * my, blur(x * y) - mx * my
    ssim = ((2 * mx * my + 1e-4) * (2 * cov + 9e-4)) / ((mx * mx + my * my + 1e-4) * (vx + vy + 9e-4))
    share = weight / weight.sum() / 3
    l1 = ((x - y).abs()[:, 0] * share).sum()
    similarity = (ssim[:, 0] * share).sum()
    return (1 - ssim_weight) * l1 + ssim_weight * (1 - similarity), l1, similarity


@pytest.mark.parametrize(("height", "width"), [(31, 45), (7, 9), (1, 1), (3, 40)])
@pytest.mark.parametrize("ssim_weight", [0.0, 0.2, 1.0])
def test_the_colour_loss_and_its_gradient_agree_with_autograd(height, width, ssim_weight):
    rng = np.random.default_rng(height)
    image, target = rng.random((2, height, width, 3)).astype(np.float32)
    weight = (rng.random((height, width)) < 0.7).astype(np.float32)
    weight[0, 0] = 1
    got = photometric(image, target, weight, ssim_weight)
    exact = torch.tensor(image, dtype=torch.float64, requires_grad=True)
    loss, l1, similarity = reference(exact, torch.tensor(target).double(), torch.tensor(weight).double(), ssim_weight)
    loss.backward()
    assert got.loss == pytest.approx(float(loss), abs=2e-6)
    assert got.l1 == pytest.approx(float(l1), abs=2e-6)
    if ssim_weight:
        assert got.ssim == pytest.approx(float(similarity), abs=2e-6)
    assert np.linalg.norm(got.gradient - exact.grad.numpy()) < 1e-4 * np.linalg.norm(exact.grad.numpy())


def test_ignored_pixels_change_neither_loss_nor_gradient():
    rng = np.random.default_rng(1)
    image, target = rng.random((2, 20, 20, 3)).astype(np.float32)
    weight = np.ones((20, 20), np.float32)
    weight[5:9, 5:9] = 0
    other = image.copy()
    other[5:9, 5:9] = 7
    a, b = photometric(image, target, weight), photometric(other, target, weight)
    assert a.loss == b.loss and np.array_equal(a.gradient, b.gradient)
    assert not a.gradient[5:9, 5:9].any()


def test_equal_images_have_no_loss_and_nothing_to_judge_has_none_either():
    image = np.random.default_rng(2).random((12, 12, 3)).astype(np.float32)
    assert photometric(image, image, np.ones((12, 12), np.float32)).loss == pytest.approx(0, abs=1e-6)
    nothing = photometric(image, 1 - image, np.zeros((12, 12), np.float32))
    assert nothing.loss == 0 and not nothing.gradient.any()


def test_weighted_l1_of_a_hand_computed_example():
    loss, gradient = weighted_l1(*(np.array(a, np.float32) for a in ([1, 2, 3], [2, 2, 1], [0.5, 1, 2])))
    assert loss == 4.5 and gradient.tolist() == [-0.5, 0, 2]


def test_adam_agrees_with_torch():
    rng = np.random.default_rng(3)
    value = rng.normal(size=100).astype(np.float32)
    ours, first, second = value.copy(), np.zeros_like(value), np.zeros_like(value)
    theirs = torch.tensor(value, requires_grad=True)
    optimizer = torch.optim.Adam([theirs], lr=0.01, eps=1e-15)
    for step in range(1, 21):
        gradient = rng.normal(size=100).astype(np.float32)
        theirs.grad = torch.tensor(gradient)
        optimizer.step()
        library().ss_adam(100, address(ours), address(gradient), address(first), address(second), 0.01, step, 1e-15)
    assert np.allclose(ours, theirs.detach().numpy(), atol=1e-5)
