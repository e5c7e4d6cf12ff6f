"""Losses against torch autograd of their definitions."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from ss_flow.tasks.gaussians.library import Learnt, Workspace, address, library
from ss_flow.tasks.gaussians.losses import photometric, surface
from ss_flow.tasks.gaussians.objective import Target, Weights
from ss_flow.tasks.geometry.cameras import Camera


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


@pytest.mark.parametrize("left", [0, 5, 16, 37, 58])
def test_what_counts_in_a_part_of_an_image_has_the_loss_and_the_gradient_that_it_has_alone(left):
    rng = np.random.default_rng(left)
    image, target = rng.random((2, 40, 70, 3)).astype(np.float32)
    weight = np.zeros((40, 70), np.float32)
    part = slice(9, 22), slice(left, left + 12)
    weight[part] = rng.random((13, 12)) < 0.5
    weight[12:14] = 0
    whole, alone = photometric(image, target, weight), photometric(image[part], target[part], weight[part])
    assert (whole.loss, whole.ssim) == pytest.approx((alone.loss, alone.ssim), abs=1e-6)
    np.testing.assert_allclose(whole.gradient[part], alone.gradient, rtol=1e-5, atol=1e-8)
    assert not whole.gradient[weight == 0].any() and whole.gradient[weight > 0].all()


def test_equal_images_have_no_loss_and_nothing_to_judge_has_none_either():
    image = np.random.default_rng(2).random((12, 12, 3)).astype(np.float32)
    assert photometric(image, image, np.ones((12, 12), np.float32)).loss == pytest.approx(0, abs=1e-6)
    nothing = photometric(image, 1 - image, np.zeros((12, 12), np.float32))
    assert nothing.loss == 0 and not nothing.gradient.any()


def target_of(shape, inside, judged, depth, known, ids=None, labelled=None) -> Target:
    camera = Camera(shape[1], shape[0], 40.0, 40.0, 20.0, 20.0, np.eye(4))
    return Target(camera, np.zeros((*shape, 3), np.float32), inside, inside, judged, depth, known, ids, labelled)


@pytest.mark.parametrize("inverse", [False, True])
def test_the_surface_loss_agrees_with_autograd(inverse):
    rng = np.random.default_rng(4)
    shape = (37, 41)
    alpha, depth, mismatch, inside, judged, known = rng.random((6, *shape)).astype(np.float32)
    target_depth = (0.5 + rng.random(shape)).astype(np.float32)
    ids = rng.integers(-2, 3, shape).astype(np.int32)
    labelled = rng.random(shape).astype(np.float32)
    alpha[:5], depth[:5] = 0, 0  # where no Gaussian is
    target = target_of(shape, inside, judged, target_depth, known, ids, labelled)
    got = surface(alpha, depth, mismatch, target, Weights(0.2, 0.5, 2.0, 0.7, inverse))
    a, d = (torch.tensor(x, requires_grad=True) for x in (alpha, depth))
    alpha_loss = (torch.tensor(judged) * (a - torch.tensor(inside)).abs()).sum()
    if inverse:
        shown = d > 0
        error = torch.where(shown, a**2 / torch.where(shown, d, 1), 0) - 1 / torch.tensor(target_depth)
    else:
        error = d / torch.tensor(target_depth) - a
    depth_loss = (torch.tensor(known) * error.abs()).sum()
    (0.5 * alpha_loss + 2 * depth_loss).backward()
    assert got.alpha == pytest.approx(alpha_loss.item(), rel=1e-5)
    assert got.depth == pytest.approx(depth_loss.item(), rel=1e-5)
    assert got.labels == pytest.approx(float((labelled * (mismatch + (ids >= 0))).sum()), rel=1e-5)
    assert np.allclose(got.towards_alpha, a.grad.numpy(), rtol=1e-5, atol=1e-6)
    assert np.allclose(got.towards_depth, d.grad.numpy(), rtol=1e-5, atol=1e-6)


def test_images_of_two_sizes_are_refused():
    a, b = np.zeros((3, 4), np.float32), np.zeros((4, 3), np.float32)
    with pytest.raises(ValueError, match=r"must all be \[3, 4\]"):
        surface(a, b, None, target_of((3, 4), a, a, a, a), Weights(0.2, 1.0, 1.0, 0.0))


def test_threads_and_a_workspace_change_no_byte_of_the_colour_loss():
    rng = np.random.default_rng(9)
    workspace = Workspace()
    for height, width in ((70, 45), (20, 64), (70, 45)):
        image, target = rng.random((2, height, width, 3)).astype(np.float32)
        weight = (rng.random((height, width)) < 0.7).astype(np.float32)
        alone = photometric(image, target, weight)
        for threads in (1, 2, 5):
            got = photometric(image, target, weight, workspace=workspace, threads=threads)
            assert got.loss == alone.loss and got.gradient.tobytes() == alone.gradient.tobytes()


def test_threads_change_no_byte_of_the_losses_of_alpha_depth_and_labels():
    """More pixels than fit in one piece of a thread's work."""
    rng = np.random.default_rng(4)
    alpha, depth, mismatch, inside, judged, known, labelled = rng.random((7, 170, 250)).astype(np.float32)
    ids = rng.integers(-1, 3, alpha.shape).astype(np.int32)
    target = target_of(alpha.shape, inside, judged, 0.5 + depth, known, ids, labelled)
    one, three = (surface(alpha, depth, mismatch, target, Weights(0.2, 0.5, 2.0, 0.7), threads=n) for n in (1, 3))
    assert one[:3] == three[:3]
    assert all(a.tobytes() == b.tobytes() for a, b in zip(one[3:], three[3:], strict=True))


def adam(value, gradient, first, second, rates, step, *, paces=None, active=None, head=0, threads=1):
    """rates: of the head, and of the rest."""
    width = value.shape[1]
    arrays = (address(a) for a in (value, gradient, first, second, paces))
    learnt = Learnt(*arrays, width, width if active is None else active, head, *rates)
    assert library().ss_adam(len(value), 1, learnt, step, 1e-15, threads) == 0


def test_adam_agrees_with_torch():
    rng = np.random.default_rng(3)
    value = rng.normal(size=(10, 6)).astype(np.float32)
    ours, first, second = value.copy(), np.zeros_like(value), np.zeros_like(value)
    parts = [torch.tensor(part.copy(), requires_grad=True) for part in (value[:, :2], value[:, 2:5])]
    optimizer = torch.optim.Adam([{"params": parts[0], "lr": 0.01}, {"params": parts[1], "lr": 0.1}], eps=1e-15)
    for step in range(1, 21):
        gradient = rng.normal(size=(10, 6)).astype(np.float32)
        parts[0].grad, parts[1].grad = torch.tensor(gradient[:, :2]), torch.tensor(gradient[:, 2:5])
        optimizer.step()
        adam(ours, gradient, first, second, (0.01, 0.1), step, active=5, head=2)
    expected = np.concatenate([*(part.detach().numpy() for part in parts), value[:, 5:]], axis=1)
    assert np.allclose(ours, expected, atol=1e-5)


@pytest.mark.parametrize(("width", "active", "head"), [(3, 3, 0), (3, 3, 3), (12, 6, 3)])
@pytest.mark.parametrize("paced", [False, True])
def test_threads_change_no_byte_of_adam(width, active, head, paced):
    """More rows than fit in one piece of a thread's work."""
    rng = np.random.default_rng(5)
    start, gradient = rng.normal(size=(2, 40_001, width)).astype(np.float32)
    paces = rng.uniform(0.01, 0.1, len(start)).astype(np.float32) if paced else None
    active = width if paced else active
    found = set()
    for threads in (1, 3):
        ours, first, second = start.copy(), np.zeros_like(start), np.zeros_like(start)
        for step in (1, 2):
            adam(ours, gradient, first, second, (0.01, 0.1), step,
                 paces=paces, active=active, head=head, threads=threads)  # fmt: skip
        found.add(ours.tobytes())
    assert len(found) == 1
    assert (ours[:, :active] != start[:, :active]).all() and (ours[:, active:] == start[:, active:]).all()


def test_rows_of_one_pace_go_as_far_as_at_that_rate():
    rng = np.random.default_rng(6)
    start, gradient = rng.normal(size=(2, 1000, 3)).astype(np.float32)
    at_rate, paced = start.copy(), start.copy()
    adam(at_rate, gradient, *np.zeros((2, 1000, 3), np.float32), (0, 0.05), 1)
    adam(paced, gradient, *np.zeros((2, 1000, 3), np.float32), (0, 0), 1, paces=np.full(1000, 0.05, np.float32))
    assert np.allclose(paced, at_rate, atol=1e-6)
