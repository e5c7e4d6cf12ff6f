"""The contract of `rasterize` on every device: a dense float64 reference, and where scenes degenerate."""

from __future__ import annotations

import platform
from dataclasses import replace

import gaussian_reference as reference
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from native_builds import skip_without

from ss_flow.tasks.gaussians import library, native_pass
from ss_flow.tasks.gaussians.library import BUILDS, Workspace
from ss_flow.tasks.gaussians.library import library as native_library
from ss_flow.tasks.gaussians.native_pass import PARAMETERS, NativePass, Settings
from ss_flow.tasks.gaussians.rasterize import GaussianTensors, backend_identity, device_here, rasterize
from ss_flow.tasks.geometry.cameras import Camera

DEVICES = [
    "cpu",
    pytest.param("cuda", marks=pytest.mark.skipif(device_here() != "cuda", reason="no CUDA with gsplat here")),
]
IMAGES = ("rgb", "alpha", "depth", "label_masks")


def camera_at(rng: np.random.Generator, width: int, height: int, cx: float | None = None) -> Camera:
    angle = rng.normal(size=3) * 0.15
    pose = np.eye(4)
    pose[:3, :3] = reference.rotations(torch.tensor([[1.0, *angle]], dtype=torch.float64))[0].numpy()
    pose[:3, 3] = rng.normal(size=3) * 0.1
    return Camera(width, height, 30.0, 33.0, width / 2 + 0.3 if cx is None else cx, height / 2 - 0.2, pose)


def scene(rng: np.random.Generator, n: int, coefficients: int = 1, size: float = 0.12) -> GaussianTensors:
    arrays = (
        rng.uniform((-0.8, -0.8, 1.2), (0.8, 0.8, 3.5), size=(n, 3)),
        rng.normal(size=(n, 4)),
        np.log(size) + rng.normal(size=(n, 3)) * 0.6,
        rng.normal(size=n) * 2,
        rng.normal(size=(n, coefficients, 3)) * 0.4,
    )
    return GaussianTensors(*(torch.tensor(a, dtype=torch.float32, requires_grad=True) for a in arrays))


def doubles(gaussians: GaussianTensors) -> list[torch.Tensor]:
    return [t.detach().double().requires_grad_() for t in gaussians.tensors()]


def relative(a: torch.Tensor, b: torch.Tensor) -> float:
    return float((a.double() - b.double()).norm() / b.double().norm().clamp(min=1e-12))


def compare(gaussians, camera, *, device="cpu", labels=None, num_labels=0, degree=0, seed=0, tolerance=1e-4):
    """Images and gradients of one scene from both sides. Smooth random weights make the loss.

    gsplat's kernels have thresholds of their own, so CUDA is held to 2e-3.
    """
    tolerance = max(tolerance, 2e-3) if device == "cuda" else tolerance
    there = GaussianTensors(*(t.detach().to(device).requires_grad_() for t in gaussians.tensors()))
    background = torch.tensor([0.2, 0.5, 0.7], device=device, requires_grad=True)
    ours = rasterize(
        there, camera, background=background, labels=None if labels is None else labels.to(device),
        num_labels=num_labels, sh_degree=degree, winners=device == "cpu",
    )  # fmt: skip
    exact, exact_background = doubles(gaussians), background.detach().cpu().double().requires_grad_()
    theirs = reference.render(exact, camera, exact_background, labels, num_labels, degree)
    generator = torch.Generator().manual_seed(seed)
    loss, exact_loss = torch.zeros(()), torch.zeros((), dtype=torch.float64)
    for name in IMAGES:
        image = getattr(ours, name).cpu()
        weight = torch.rand(theirs[name].shape, generator=generator)
        # A pixel where a threshold (1/255, T < 1e-4) falls the other way by rounding says nothing of the mathematics.
        off = (image.detach() - theirs[name].detach()).abs() > 2e-3
        assert off.float().mean() < 0.01 if off.numel() else True, name
        weight = torch.where(off, 0.0, weight)
        assert relative(image.detach() * weight, theirs[name].detach() * weight) < tolerance / 5, name
        loss = loss + (image * weight).sum()
        exact_loss = exact_loss + (theirs[name] * weight.double()).sum()
    loss.backward()
    exact_loss.backward()
    for name, a, b in zip(PARAMETERS, there.tensors(), exact, strict=True):
        if float(b.grad.norm()) > 1e-6:
            assert relative(a.grad.cpu(), b.grad) < tolerance, (name, relative(a.grad.cpu(), b.grad))
        else:
            assert float(a.grad.norm()) < 1e-4, name
    assert relative(background.grad.cpu(), exact_background.grad) < tolerance
    return ours, theirs


@settings(max_examples=200, deadline=None, derandomize=True)
@given(
    seed=st.integers(0, 10_000),
    n=st.integers(1, 40),
    degree=st.integers(0, 3),
    num_labels=st.integers(0, 4),
    width=st.integers(1, 23),
    height=st.integers(1, 19),
)
def test_images_and_gradients_agree_with_the_reference(seed, n, degree, num_labels, width, height):
    rng = np.random.default_rng(seed)
    labels = torch.tensor(rng.integers(-1, num_labels, n), dtype=torch.int32) if num_labels else None
    compare(
        scene(rng, n, 16 if degree == 3 else (degree + 1) ** 2),
        camera_at(rng, width, height),
        labels=labels, num_labels=num_labels, degree=degree, seed=seed,
    )  # fmt: skip


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("degree", [0, 3])
def test_every_device_agrees_with_the_reference(device, degree):
    rng = np.random.default_rng(21)
    labels = torch.tensor(rng.integers(-1, 3, 60), dtype=torch.int32)
    compare(
        scene(rng, 60, 16), camera_at(rng, 61, 50), device=device, labels=labels, num_labels=3, degree=degree,
    )  # fmt: skip


@pytest.fixture
def on_build(monkeypatch):
    """Renders with the library of an instruction set from here on, given its name."""

    def use(name: str) -> None:
        skip_without(name)
        monkeypatch.setattr(native_pass, "library", lambda: native_library(name))
        monkeypatch.setattr(library, "library", lambda: native_library(name))

    return use


@pytest.mark.parametrize("name", BUILDS)
def test_every_instruction_set_agrees_with_the_reference(name, on_build):
    on_build(name)
    rng = np.random.default_rng(22)
    labels = torch.tensor(rng.integers(-1, 3, 80), dtype=torch.int32)
    compare(scene(rng, 80, 16), camera_at(rng, 45, 70), labels=labels, num_labels=3, degree=3)


def test_a_dense_scene_agrees_with_the_reference():
    rng = np.random.default_rng(5)
    ours, theirs = compare(scene(rng, 300), camera_at(rng, 37, 26))
    same = ours.top_contributor == theirs["top_contributor"]
    assert same.float().mean() > 0.99
    assert np.allclose(ours.max_contribution.numpy(), theirs["max_contribution"].numpy(), atol=1e-3)


def test_the_reference_agrees_with_finite_differences():
    rng = np.random.default_rng(2)
    camera, background = camera_at(rng, 5, 4), torch.full((3,), 0.3, dtype=torch.float64)
    exact = doubles(scene(rng, 3, 4, size=0.4))
    labels = torch.tensor([0, 1, 0], dtype=torch.int32)

    def images(*parameters):
        out = reference.render(parameters, camera, background, labels, 2, 1)
        return tuple(out[name] for name in IMAGES)

    assert torch.autograd.gradcheck(images, exact, eps=1e-6, atol=1e-5)


@pytest.mark.parametrize("image", ["depth", "label_masks", "alpha"])
def test_each_image_alone_sends_the_reference_gradient(image):
    rng = np.random.default_rng(11)
    gaussians, camera = scene(rng, 30), camera_at(rng, 20, 20)
    labels = torch.tensor(rng.integers(0, 3, 30), dtype=torch.int32)
    ours = rasterize(gaussians, camera, background=(0, 0, 0), labels=labels, num_labels=3)
    exact = doubles(gaussians)
    theirs = reference.render(exact, camera, torch.zeros(3, dtype=torch.float64), labels, 3)
    weight = torch.rand(theirs[image].shape, generator=torch.Generator().manual_seed(1))
    (getattr(ours, image) * weight).sum().backward()
    (theirs[image] * weight).sum().backward()
    for a, b in zip(gaussians.tensors()[:4], exact, strict=False):
        assert relative(a.grad, b.grad) < 3e-4
    assert float(gaussians.sh.grad.abs().max()) == 0


def test_an_empty_scene_shows_the_background():
    empty = GaussianTensors(*(torch.zeros(0, *shape) for shape in ((3,), (4,), (3,), (), (1, 3))))
    out = rasterize(empty, Camera(5, 3, 10, 10, 2, 1, np.eye(4)), background=(0.1, 0.2, 0.3), winners=True)
    assert torch.equal(out.rgb, torch.tensor([0.1, 0.2, 0.3]).expand(3, 5, 3))
    assert float(out.alpha.abs().max()) == 0 and bool((out.top_contributor == -1).all())


def one(mean=(0.0, 0, 2), scale=(0.1, 0.1, 0.1), logit=2.0) -> GaussianTensors:
    parameters = (mean, (1.0, 0, 0, 0), np.log(scale), logit, ((0.5, 0.0, -0.5),))
    return GaussianTensors(*(torch.tensor(np.array([p]), dtype=torch.float32, requires_grad=True) for p in parameters))


CAMERA = Camera(16, 12, 20.0, 20.0, 8.0, 6.0, np.eye(4))


@pytest.mark.parametrize(
    "gaussians",
    [
        one(scale=(3.0, 1e-5, 1e-5)),
        one(mean=(0.02, 0.01, 2), scale=(1e-6, 1e-6, 1e-6)),
        one(scale=(500.0, 500.0, 500.0)),
        one(logit=-20.0),
        one(logit=-200.0),
        one(logit=20.0),
        one(logit=200.0),
        one(scale=(1e-30, 1e-30, 1e-30)),
        one(mean=(0.5, -0.4, 2), scale=(0.5, 0.02, 0.3)),
    ],
    ids=["needle", "dot", "huge", "invisible", "opacity 0", "opaque", "opacity 1", "point", "off-axis"],
)
@pytest.mark.parametrize("cx", [8.0, -3.0, 40.0])
def test_extreme_shapes_agree_with_the_reference(gaussians, cx):
    for tensor in gaussians.tensors():
        tensor.grad = None
    compare(gaussians, replace(CAMERA, cx=cx), tolerance=2e-3)


def far(distance: float, turn: float, scales: tuple[float, float, float]) -> GaussianTensors:
    """A Gaussian that far from the picture, in pixels, and long enough to cross its middle; scales in its own length:
    along it, across it, and in depth."""
    z = 0.5
    length = distance * z / CAMERA.fx
    mean = (length * np.cos(turn), length * np.sin(turn), z)
    thin = one(mean, np.maximum(np.multiply(scales, length), 1e-5), logit=1.0)
    thin.quaternions.data[:] = torch.tensor([[np.cos(turn / 2), 0, 0, np.sin(turn / 2)]])
    return thin


@pytest.mark.parametrize("name", BUILDS)
@pytest.mark.parametrize(("scales", "nearest"), [((1, 0, 0), 600), ((0.7, 0, 0.5), 60)], ids=["needle", "disc on edge"])
@pytest.mark.parametrize("turn", [0.1, 0.6, 1.5, 2.2])
def test_long_thin_gaussians_far_from_the_picture_agree_with_the_reference(name, scales, nearest, turn, on_build):
    """There q is about 1, but with dx^2, dx dy and dy^2 the covariance's inverse would give terms up to 1e10.

    How a disc on edge turns as it moves is known from T alone, which is float32: its gradient is compared nearer.
    """
    on_build(name)
    camera = replace(CAMERA, cx=8.3, photo_borders=(-100.0, -100.0, 100.0, 100.0))
    compare(far(nearest, turn, scales), camera, tolerance=5e-3)
    for distance in (600, 6e3, 6e4):
        seen = far(distance, turn, scales)
        exact = reference.render(doubles(seen), camera, torch.zeros(3, dtype=torch.float64))
        ours = rasterize(seen, camera, background=(0, 0, 0))
        assert float(exact["alpha"].detach().max()) > 0.2
        assert float((ours.alpha - exact["alpha"]).detach().abs().max()) < 1e-2


def test_one_pixel_shows_the_hand_computed_blend():
    camera = Camera(1, 1, 20.0, 20.0, 0.5, 0.5, np.eye(4))
    out = rasterize(one(logit=0.0), camera, background=(1.0, 1.0, 1.0))
    red = 0.5 + 0.5 * 0.28209479
    assert float(out.alpha) == pytest.approx(0.5, abs=1e-6)
    assert float(out.depth) == pytest.approx(1.0, abs=1e-5)
    assert out.rgb[0, 0].tolist() == pytest.approx([0.5 * red + 0.5, 0.75, 0.5 * (1 - red) + 0.5], abs=1e-5)


@pytest.mark.parametrize("device", DEVICES)
def test_what_lies_behind_the_camera_is_not_drawn(device):
    hidden = GaussianTensors(*(t.detach().to(device).requires_grad_() for t in one(mean=(0, 0, -2)).tensors()))
    out = rasterize(hidden, CAMERA, background=(0, 0, 0))
    out.rgb.sum().backward()
    assert float(out.alpha.max()) == 0 and float(out.radii[0]) == 0 and not hidden.means.grad.any()


def test_an_image_8192_pixels_wide_shows_what_lies_at_its_end():
    camera = Camera(8192, 4, 4000.0, 4000.0, 4096.0, 2.0, np.eye(4))
    end = one(mean=(2.047, 0, 2.0), scale=(1e-3, 1e-3, 1e-3), logit=4.0)
    out = rasterize(end, camera, background=(0, 0, 0))
    out.alpha.sum().backward()
    assert float(out.alpha.detach()[2, 8190]) > 0.9 and float(out.alpha.detach()[:, :8100].max()) == 0
    assert float(end.opacity_logits.grad[0]) > 0


def test_threads_and_a_used_workspace_change_no_byte():
    """Bands and chunks of both sizes: more than one each, and fewer than before."""
    rng = np.random.default_rng(13)
    workspace = Workspace()
    for n, width, height in ((2500, 150, 130), (40, 20, 9), (2500, 70, 200)):
        arrays = tuple(t.detach().numpy() for t in scene(rng, n, 4).tensors())
        labels = rng.integers(-1, 3, n).astype(np.int32)
        camera = camera_at(rng, width, height)
        towards = rng.random((height, width)).astype(np.float32)
        color, masks = np.repeat(towards[..., None], 3, axis=2), np.stack([towards] * 3)
        found = set()
        for threads in (1, 2, 7):
            done = NativePass(
                arrays, labels, camera, Settings((0.1, 0.2, 0.3), 3, 1, winners=True),
                workspace=workspace, threads=threads,
            )  # fmt: skip
            gradients = done.backward(color, towards, towards, masks)
            images = (done.rgb, done.alpha, done.depth, done.masks, done.top, done.radii, done.strongest)
            found.add(b"".join(a.tobytes() for a in (*images, *gradients.values())))
        assert len(found) == 1


@pytest.mark.parametrize("name", BUILDS)
def test_how_much_each_gaussian_shows_is_the_sum_of_its_weights(name, on_build):
    on_build(name)
    rng = np.random.default_rng(14)
    n, width, height = 120, 61, 77
    arrays = tuple(t.detach().numpy() for t in scene(rng, n).tensors())
    camera = camera_at(rng, width, height)
    each = NativePass(
        arrays, np.arange(n, dtype=np.int32), camera, Settings((0.0, 0.0, 0.0), n, 0, winners=False)
    ).masks
    ids = rng.integers(-1, 3, (height, width)).astype(np.int32)
    ids[:20] = 2  # blocks with one id, with several, and with none
    ids[40:50, :30] = -1
    found = set()
    for threads in (1, 3):
        rows, known, weights = NativePass(
            arrays, None, camera, Settings((0.0, 0.0, 0.0), 0, 0, winners=False), threads=threads
        ).shares(ids)
        found.add(rows.tobytes() + known.tobytes() + weights.tobytes())
    assert len(found) == 1
    sums = np.zeros((3, n))
    np.add.at(sums, (known, rows), weights)
    for one in range(3):
        np.testing.assert_allclose(sums[one], (each * (ids == one)).sum(axis=(1, 2)), rtol=1e-4, atol=1e-5)
    assert (sums > 0.1).sum() > 100 and (weights > 0).all()


def test_a_pass_whose_workspace_was_used_again_does_not_go_back():
    arrays = tuple(t.detach().numpy() for t in one().tensors())
    workspace, setting = Workspace(), Settings((0.0, 0.0, 0.0), 0, 0, winners=False)
    first = NativePass(arrays, None, CAMERA, setting, workspace=workspace)
    NativePass(arrays, None, CAMERA, setting, workspace=workspace)
    with pytest.raises(RuntimeError, match="another one by now"):
        first.backward(None, None, None, None)
    with pytest.raises(RuntimeError, match="another one by now"):
        first.shares(np.zeros((CAMERA.height, CAMERA.width), np.int32))


@pytest.mark.parametrize("device", DEVICES)
def test_a_batch_is_its_views_one_by_one(device):
    rng = np.random.default_rng(4)
    there = GaussianTensors(*(t.detach().to(device).requires_grad_() for t in scene(rng, 50).tensors()))
    cameras = [camera_at(rng, 20, 15) for _ in range(3)]
    batch = rasterize(there, cameras, background=(0, 0, 0))
    batch.rgb.sum().backward()
    together = there.means.grad.clone()
    there.means.grad = None
    singles = [rasterize(there, camera, background=(0, 0, 0)) for camera in cameras]
    sum(single.rgb.sum() for single in singles).backward()
    assert torch.equal(batch.rgb, torch.stack([single.rgb for single in singles]))
    assert torch.allclose(together, there.means.grad, rtol=1e-5, atol=1e-6)
    assert batch.center_gradient.shape == (3, 50, 2) and bool(batch.center_gradient.any(dim=(1, 2)).all())
    with pytest.raises(ValueError, match="one image size"):
        rasterize(there, [camera_at(rng, 20, 15), camera_at(rng, 21, 15)], background=(0, 0, 0))


def test_equal_depths_are_blended_in_order_of_rows():
    both = GaussianTensors(*(torch.cat([a, b]) for a, b in zip(one().tensors(), one().tensors(), strict=True)))
    out = rasterize(both, CAMERA, background=(0, 0, 0), winners=True)
    assert int(out.top_contributor[6, 8]) == 0


def around(rng: np.random.Generator, n: int) -> GaussianTensors:
    """Long Gaussians, most of them outside the picture, which reach into it."""
    z = rng.uniform(0.6, 1.5, n)
    arrays = (
        np.column_stack([rng.uniform(-2.5, 2.5, n) * z, rng.uniform(-2.5, 2.5, n) * z, z]),
        rng.normal(size=(n, 4)),
        np.log(0.4) + rng.normal(size=(n, 3)) * 0.6,
        rng.normal(size=n) - 2,
        rng.normal(size=(n, 1, 3)) * 0.4,
    )
    return GaussianTensors(*(torch.tensor(a, dtype=torch.float32, requires_grad=True) for a in arrays))


@pytest.mark.parametrize("cx", [20.3, 12.0, -5.0])
def test_a_crop_renders_as_the_crop_of_the_whole(cx):
    """To rounding: a crop's pixels are counted from another one."""
    rng = np.random.default_rng(3)
    gaussians, camera = around(rng, 120), camera_at(rng, 40, 30, cx)
    whole = rasterize(gaussians, camera, background=(0, 0, 0))
    crop = camera.cropped(7, 5, 30, 22)
    part = rasterize(gaussians, crop, background=(0, 0, 0))
    off = (part.rgb - whole.rgb[5:22, 7:30]).abs()
    assert float(off.median()) < 1e-6 and float((off > 1e-3).float().mean()) < 0.002
    as_a_photo = rasterize(gaussians, replace(crop, photo_borders=None), background=(0, 0, 0))
    assert float((as_a_photo.rgb - whole.rgb[5:22, 7:30]).abs().mean()) > 5e-3  # else nothing would have been tested


def test_slopes_end_where_those_of_3dgs_do():
    """1.3 times the tangent of half the field of view (Kerbl et al. 2023, their code), of the photo and its crop."""
    rng = np.random.default_rng(6)
    gaussians = around(rng, 80)
    camera = replace(camera_at(rng, 40, 30), cx=20.0, cy=15.0)
    fields = 2 * np.arctan(camera.width / (2 * camera.fx)), 2 * np.arctan(camera.height / (2 * camera.fy))
    limits = [(-1.3 * np.tan(field / 2), 1.3 * np.tan(field / 2)) for field in fields]
    background = torch.zeros(3, dtype=torch.float64)
    for seen in (camera, camera.cropped(0, 8, 16, 30).scaled(8, 11)):
        theirs = reference.render(doubles(gaussians), seen, background, limits=limits)
        assert relative(rasterize(gaussians, seen, background=(0, 0, 0)).rgb, theirs["rgb"]) < 1e-4
        wider = reference.render(doubles(gaussians), seen, background, limits=[(-2, 2), (-2, 2)])
        assert relative(wider["rgb"], theirs["rgb"]) > 1e-2


def test_images_and_gradients_of_what_lies_outside_agree_with_the_reference():
    rng = np.random.default_rng(7)
    for cx in (20.3, 4.0, 44.0):
        compare(around(rng, 60), camera_at(rng, 40, 30, cx), tolerance=1e-3)
        compare(around(rng, 60), camera_at(rng, 40, 30, cx).cropped(20, 3, 40, 21), tolerance=1e-3)


def test_the_same_call_gives_the_same_bytes():
    rng = np.random.default_rng(8)
    gaussians, camera = scene(rng, 200, 4), camera_at(rng, 40, 30)
    seen = []
    for _ in range(2):
        for tensor in gaussians.tensors():
            tensor.grad = None
        out = rasterize(gaussians, camera, background=(0, 0, 0))
        (out.rgb.square().sum() + out.depth.sum()).backward()
        seen.append([out.rgb.detach().numpy().tobytes(), *(t.grad.numpy().tobytes() for t in gaussians.tensors())])
    assert seen[0] == seen[1]


@pytest.mark.parametrize("name", PARAMETERS)
def test_a_parameter_that_is_not_finite_is_refused(name):
    gaussians = one()
    getattr(gaussians, name).data.view(-1)[0] = float("nan")
    with pytest.raises(ValueError, match=name):
        rasterize(gaussians, CAMERA, background=(0, 0, 0))


def test_shapes_that_do_not_fit_are_refused():
    wrong = replace(one(), quaternions=torch.zeros(2, 4))
    with pytest.raises(ValueError, match="quaternions must be"):
        rasterize(wrong, CAMERA, background=(0, 0, 0))
    with pytest.raises(ValueError, match="labels"):
        rasterize(one(), CAMERA, background=(0, 0, 0), labels=torch.tensor([3], dtype=torch.int32), num_labels=2)


def test_the_backend_names_the_instruction_set():
    architecture, chosen = backend_identity()["rasterizer"].split()
    assert architecture == platform.machine() and chosen in BUILDS
