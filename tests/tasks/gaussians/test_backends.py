"""Both ways to the gradients of a view."""

from __future__ import annotations

import numpy as np
import pytest

from ss_flow.tasks.gaussians.backends import NativeBackend
from ss_flow.tasks.gaussians.native_pass import PARAMETERS, Settings
from ss_flow.tasks.gaussians.objective import Objective, Target
from ss_flow.tasks.gaussians.torch_backend import TorchBackend
from ss_flow.tasks.gaussians.views import TrainView
from ss_flow.tasks.geometry.cameras import Camera


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
    return tuple(np.ascontiguousarray(p, np.float32) for p in parameters), labels, Target.of(view, objective, 7)


@pytest.mark.parametrize("with_labels", [False, True])
@pytest.mark.parametrize("ssim_weight", [0.0, 0.2])
@pytest.mark.parametrize("background", ["random", "black"])
@pytest.mark.parametrize("depth_error", ["relative", "inverse"])
def test_torch_and_the_native_library_find_the_same_descent(with_labels, ssim_weight, background, depth_error):
    objective = Objective(ssim_weight, background, 0.5, depth_error, 0.3, 0.3)
    parameters, labels, target = example(3, objective, with_labels=with_labels)
    settings = Settings((0.2, 0.4, 0.6), 7, 1, winners=False)
    weights = objective.at(0.5, 0.7)
    native = NativeBackend(1).descent(parameters, labels, target, settings, weights)
    torch_ = TorchBackend("cpu").descent(parameters, labels, target, settings, weights)
    assert native.loss == pytest.approx(torch_.loss, rel=1e-5)
    assert np.array_equal(native.radii, torch_.radii)
    for name in (*PARAMETERS, "centers"):
        a, b = native.gradients[name], torch_.gradients[name]
        assert np.linalg.norm(a - b) <= 2e-4 * np.linalg.norm(b), name
