"""The contract of a trainer's backend: what each gives for a view, held against the native one and torch's own Adam."""

from __future__ import annotations

import sys
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch.overrides import TorchFunctionMode
from trainer_backends import NATIVE, example, put, tolerance

from ss_flow.tasks.gaussians.backends import AdamStep, NativeBackend, backend_for
from ss_flow.tasks.gaussians.densification import GradientRecord, densify
from ss_flow.tasks.gaussians.initialise import initialise
from ss_flow.tasks.gaussians.native_pass import PARAMETERS, Settings
from ss_flow.tasks.gaussians.objective import Objective, Target
from ss_flow.tasks.gaussians.optimizer import Parameters
from ss_flow.tasks.gaussians.render import render
from ss_flow.tasks.gaussians.torch_backend import TorchBackend
from ss_flow.tasks.geometry.cameras import Camera


@pytest.mark.parametrize("with_labels", [False, True])
@pytest.mark.parametrize("ssim_weight", [0.0, 0.2])
@pytest.mark.parametrize("background", ["random", "black"])
@pytest.mark.parametrize("depth_error", ["relative", "inverse"])
def test_every_backend_finds_the_same_descent(backend, with_labels, ssim_weight, background, depth_error):
    objective = Objective(ssim_weight, background, 0.5, depth_error, 0.3, 0.3)
    values, labels, target = example(3, objective, with_labels=with_labels)
    settings = Settings((0.2, 0.4, 0.6), 7, 1, winners=False)
    weights = objective.at(0.5, 0.7)
    expected = NATIVE.descent(values, labels, target, settings, weights)
    there = None if labels is None else backend.put(labels)
    found = backend.descent(put(backend, values), there, backend.target(target, 7), settings, weights)
    limit = tolerance(backend)
    assert backend.host(found.loss) == pytest.approx(expected.loss, rel=0.1 * limit)
    assert np.array_equal(backend.host(found.radii) > 0, expected.radii > 0)
    for name in (*PARAMETERS, "centers"):
        a, b = expected.gradients[name], backend.host(found.gradients[name])
        assert np.linalg.norm(a - b) <= limit * np.linalg.norm(a), name


def test_a_view_without_a_pixel_that_counts_pulls_nowhere(backend):
    values, _, target = example(4, Objective(), with_labels=False)
    nothing = np.zeros_like(target.inside)
    blind = Target(target.camera, target.image, nothing, nothing, nothing, np.ones_like(nothing), nothing, None, None)
    settings, weights = Settings((0.2, 0.4, 0.6), 0, 1, winners=False), Objective().at(0.5, 0.0)
    for one in (NATIVE, backend):
        found = one.descent(put(one, values), None, one.target(blind, 0), settings, weights)
        assert one.host(found.loss) == 0
        assert all(not one.host(found.gradients[name]).any() for name in PARAMETERS)


def outline(camera: Camera) -> Target:
    """A target whose alpha alone counts."""
    rng = np.random.default_rng(camera.width)
    blank = np.zeros((camera.height, camera.width), np.float32)
    inside, judged = (rng.random(blank.shape).astype(np.float32).round() for _ in range(2))
    image = np.zeros((*blank.shape, 3), np.float32)
    return Target(camera, image, blank, inside, judged / judged.sum(), np.ones_like(blank), blank, None, None)


def moved(*offset: float) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, 3] = offset
    return pose


def test_every_backend_finds_the_same_way_towards_parts_seen_alone(backend):
    values, _, _ = example(3, Objective(), with_labels=False)
    parts = [
        (slice(0, 70), outline(Camera(46, 33, 40.0, 40.0, 23.0, 16.5, np.eye(4)))),
        (slice(50, 120), outline(Camera(30, 41, 35.0, 38.0, 15.0, 20.0, moved(0.1, -0.2, 0.3)))),
    ]
    expected = list(NATIVE.towards_parts(values, parts, 0.3))
    there = [(rows, backend.target(target, 0)) for rows, target in parts]
    found = list(backend.towards_parts(put(backend, values), there, 0.3))
    for (rows, a), (same, b) in zip(expected, found, strict=True):
        assert rows == same
        for name in ("means", "quaternions", "log_scales", "opacity_logits"):
            limit = tolerance(backend) * np.linalg.norm(a[name])
            assert np.linalg.norm(a[name]) > 0 and np.linalg.norm(a[name] - backend.host(b[name])) <= limit, name
        assert not a["sh"].any()
    assert list(backend.towards_parts(put(backend, values), [], 0.3)) == []


def test_every_backend_tells_what_weighs_most_in_a_view(backend):
    values, _, target = example(5, Objective(), with_labels=False)
    ours = NATIVE.strongest(values, target)
    theirs = backend.host(backend.strongest(put(backend, values), backend.target(target, 0)))
    off = np.abs(theirs - ours)
    # What is next to nothing counts or does not, by rounding.
    assert off.max() < 1 / 255 and np.quantile(off, 0.98) <= tolerance(backend)
    assert (ours > 0.05).sum() > 30


@pytest.mark.parametrize("which", ["native", "torch"])
def test_adam_is_torchs_own_and_each_mean_has_its_rate(which):
    backend = NATIVE if which == "native" else TorchBackend("cpu")
    rng = np.random.default_rng(0)
    values, _, _ = example(6, Objective(), with_labels=False)
    paces = rng.uniform(1e-4, 1e-2, len(values["means"])).astype(np.float32)
    rates = {"quaternions": 3e-3, "log_scales": 2e-2, "opacity_logits": 0.05, "sh": 1e-2, "sh_rest": 5e-4}
    exact = {n: torch.tensor(v, dtype=torch.float64) for n, v in values.items() if n not in ("means", "sh")}
    exact |= {"sh": torch.tensor(values["sh"][:, :1], dtype=torch.float64)}
    exact |= {"sh_rest": torch.tensor(values["sh"][:, 1:], dtype=torch.float64)}
    rows = [torch.tensor(row, dtype=torch.float64) for row in values["means"]]
    groups = [{"params": [value], "lr": rates[name]} for name, value in exact.items()]
    groups += [{"params": [row], "lr": float(pace)} for row, pace in zip(rows, paces, strict=True)]
    oracle = torch.optim.Adam(groups, eps=1e-15)
    moved = put(backend, values)
    first, second = ({n: backend.xp.zeros_like(v) for n, v in moved.items()} for _ in range(2))
    for number in range(1, 8):
        gradients = {
            n: np.float32(10.0 ** rng.integers(-6, 2)) * rng.normal(size=v.shape).astype(np.float32)
            for n, v in values.items()
        }
        for name, value in exact.items():
            whole = gradients["sh"] if name.startswith("sh") else gradients[name]
            part = whole[:, :1] if name == "sh" else whole[:, 1:] if name == "sh_rest" else whole
            value.grad = torch.tensor(part, dtype=torch.float64)
        for row, gradient in zip(rows, gradients["means"], strict=True):
            row.grad = torch.tensor(gradient, dtype=torch.float64)
        oracle.step()
        step = AdamStep(number, {**rates, "means": backend.put(paces)}, 1)
        backend.adam(moved, put(backend, gradients), first, second, step)
    exact["sh"] = torch.cat([exact["sh"], exact.pop("sh_rest")], dim=1)
    exact["means"] = torch.stack(rows)
    for name, value in exact.items():
        np.testing.assert_allclose(backend.host(moved[name]), value.numpy(), rtol=1e-5, atol=2e-6, err_msg=name)


def test_colours_above_the_degree_in_use_stay(backend):
    values, _, _ = example(7, Objective(), with_labels=False)
    rates = dict.fromkeys(("quaternions", "log_scales", "opacity_logits", "sh", "sh_rest"), 0.1)
    for one in (NATIVE, backend):
        moved = put(one, values)
        gradients = {n: one.xp.ones_like(v) for n, v in moved.items()}
        gradients["sh"][:, 1:] = 0
        first, second = ({n: one.xp.zeros_like(v) for n, v in moved.items()} for _ in range(2))
        paces = one.put(np.full(len(values["means"]), 0.1, np.float32))
        one.adam(moved, gradients, first, second, AdamStep(1, {**rates, "means": paces}, 0))
        assert np.array_equal(one.host(moved["sh"])[:, 1:], values["sh"][:, 1:])
        assert np.allclose(one.host(moved["sh"])[:, :1], values["sh"][:, :1] - 0.1)


@pytest.mark.parametrize("most", [200, 10_000])
def test_every_backend_clones_and_splits_the_same_ones(backend, most):
    values, _, _ = example(8, Objective(), with_labels=False)
    gradient = np.random.default_rng(1).random(len(values["means"]))
    gradient[:60] = gradient[60:]  # of equal ones the first goes first
    made = [
        densify(
            put(one, values), one.put(gradient), threshold=0.2, extent=8.0, most=most,
            generator=np.random.default_rng(2), backend=one,
        )
        for one in (NATIVE, backend)
    ]  # fmt: skip
    (expected, rows, fresh), (found, their_rows, theirs_fresh) = made
    assert np.array_equal(backend.host(their_rows), rows) and np.array_equal(backend.host(theirs_fresh), fresh)
    assert len(set(rows[fresh])) < fresh.sum() and len(rows) <= most  # some are split, some cloned
    for name in PARAMETERS:
        np.testing.assert_allclose(backend.host(found[name]), expected[name], rtol=1e-6, atol=1e-6)


def test_every_backend_remembers_the_same_gradients_and_limits_the_same_values(backend):
    values, _, _ = example(9, Objective(), with_labels=False)
    made = initialise(values["means"], np.zeros(values["means"].shape, np.uint8), 1, 1.0)
    rng = np.random.default_rng(0)
    seen = [
        (rng.normal(size=(120, 2)).astype(np.float32), (rng.random(120) > 0.4).astype(np.float32)) for _ in range(3)
    ]
    found = []
    for one in (NATIVE, backend):
        record, parameters = GradientRecord(120, one), Parameters(made, 1, one)
        for centers, radii in seen:
            record.add(one.put(centers), one.put(radii), 500)
        parameters.limit_opacity(0.05)
        parameters.limit_scale(one.put(np.log(np.linspace(0.01, 1, 360, dtype=np.float32)).reshape(120, 3)))
        parameters.keep(parameters.longest() > 0.05)
        found.append((one.host(record.mean()), parameters.to_gaussians(made), one.host(parameters.opacities())))
    (mean, gaussians, opacities), (their_mean, theirs, their_opacities) = found
    np.testing.assert_allclose(their_mean, mean, rtol=1e-6)
    np.testing.assert_allclose(their_opacities, opacities, rtol=1e-6)
    assert 0 < len(gaussians) < 120 and len(theirs) == len(gaussians)
    for name in PARAMETERS:
        np.testing.assert_allclose(getattr(theirs, name), getattr(gaussians, name), rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize("label_ids", [(), (4, 9, 11)])
def test_renderings_by_torch_are_the_native_ones(monkeypatch, label_ids):
    values, labels, target = example(11, Objective(), with_labels=True)
    made = initialise(
        values["means"], np.zeros((120, 3), np.uint8), np.take([4, 9, 2, 11], labels % 4), 1.0, opacity=0.6
    )
    made = replace(made, sh=values["sh"], quaternions=values["quaternions"])
    drawing = sys.modules[render.__module__]
    monkeypatch.setattr(drawing, "device_for", lambda pixels: "cpu")
    expected = render(made, target.camera, background=(0.1, 0.2, 0.3), label_ids=label_ids)
    monkeypatch.setattr(drawing, "device_for", lambda pixels: torch.device("cpu"))  # torch's, not "cpu", the native one
    found = render(made, target.camera, background=(0.1, 0.2, 0.3), label_ids=label_ids)
    for name, image in expected._asdict().items():
        assert getattr(found, name).dtype == image.dtype and np.array_equal(getattr(found, name), image), name


class FromTheHost(TorchFunctionMode):
    """Notes every tensor that is made of values of the host, or carried between devices."""

    MOVES = (torch.tensor, torch.as_tensor, torch.from_numpy, torch.Tensor.to, torch.Tensor.cpu, torch.Tensor.cuda,
             torch.Tensor.new_tensor)  # fmt: skip

    def __init__(self) -> None:
        super().__init__()
        self.moves: list[str] = []

    def __torch_function__(self, func, types, args=(), kwargs=None):
        if func in self.MOVES:
            self.moves.append(func.__name__)
        return func(*args, **(kwargs or {}))


@pytest.mark.parametrize("with_labels", [False, True])
def test_a_step_carries_nothing_to_the_host_or_from_it(stand_in, with_labels):
    # Tensors on "meta" have shapes and no values: whatever asks for one of them fails.
    backend = TorchBackend("meta")
    values, labels, target = example(3, Objective(), with_labels=with_labels)
    there, moved = backend.target(target, 7), put(backend, values)
    channels = None if labels is None else backend.put(labels)
    first, second = ({n: torch.zeros_like(v) for n, v in moved.items()} for _ in range(2))
    record, made = GradientRecord(120, backend), initialise(values["means"], np.zeros((120, 3), np.uint8), 1, 1.0)
    parameters, longest = Parameters(made, 1, backend), backend.put(np.ones(120, np.float32))
    limits = backend.put(np.ones((120, 3), np.float32))
    rates = dict.fromkeys(("quaternions", "log_scales", "opacity_logits", "sh", "sh_rest"), 0.1)
    with FromTheHost() as heard:
        settings, weights = Settings((0.2, 0.4, 0.6), 7, 1, winners=False), Objective().at(0.5, 0.7)
        found = backend.descent(moved, channels, there, settings, weights)
        parts = list(backend.towards_parts(moved, [(slice(0, 60), there), (slice(30, 120), there)], 0.5))
        backend.adam(moved, found.gradients, first, second, AdamStep(1, {**rates, "means": 0.1 * longest}, 1))
        record.add(found.gradients["centers"], found.radii, int(target.counted.sum()))
        parameters.limit_scale(limits)
    assert heard.moves == []
    for name in PARAMETERS:
        assert found.gradients[name].shape == values[name].shape == moved[name].shape
    assert [gradients["means"].shape for _, gradients in parts] == [(60, 3), (90, 3)]
    assert (found.loss.shape, found.radii.shape, found.gradients["centers"].shape) == ((), (120,), (120, 2))
    with pytest.raises((NotImplementedError, RuntimeError)):
        backend.host(found.loss)


def test_a_backend_for_cuda_is_of_torch():
    assert isinstance(backend_for("cpu", 2), NativeBackend)
    assert isinstance(backend_for("meta", 2), TorchBackend)
