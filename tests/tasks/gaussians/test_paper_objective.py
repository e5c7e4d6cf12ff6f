"""What `paper` trains, worked out in float64 from photos and masks: the loss of a view and its gradient.

Split&Splat, Sec. 3.2.1: 3DGS on photos that are black outside the masks. Sec. 3.2.3: l = l_RGB + w_mask * l_mask.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import gaussian_reference as reference
import numpy as np
import pytest
import torch
from ball_and_box import SmallScene

from ss_flow.flows import settings
from ss_flow.flows.params import Params
from ss_flow.tasks.artifacts import Gaussians
from ss_flow.tasks.gaussians.backends import NativeBackend
from ss_flow.tasks.gaussians.initialise import concatenate, initialise
from ss_flow.tasks.gaussians.native_pass import PARAMETERS, Settings
from ss_flow.tasks.gaussians.objective import Target
from ss_flow.tasks.gaussians.render import channels_of
from ss_flow.tasks.gaussians.torch_backend import TorchBackend
from ss_flow.tasks.gaussians.trainer import TrainParams, TrainResult, train
from ss_flow.tasks.gaussians.views import TrainView
from ss_flow.tasks.geometry.cameras import camera_extent, camera_of
from ss_flow.tasks.splat import global_pass, merge, reconstruct

PAPER = settings.preset(Params(), "paper").splat
W_MASK = 0.15
EVERY = {0: 400, 1: 40, 2: 20}
"""Of the points of each instance, one of so many is taken."""


@dataclass
class Asked:
    """What a task hands to the trainer."""

    initial: Gaussians
    views: list[TrainView]
    params: TrainParams
    extent: float | np.ndarray
    ids: tuple[int, ...]
    """The instances whose masks are shown, in the order of their channels; of one alone, without mask loss."""


@pytest.fixture(scope="module")
def small() -> SmallScene:
    return SmallScene()


def some(small: SmallScene, instance_id: int, every: int) -> Gaussians:
    """An instance's points as Gaussians of many shapes and opacities."""
    instance = small.instance(instance_id, every=every)
    made = initialise(instance.points, instance.colors, instance_id, 0.9)
    random = np.random.default_rng(instance_id)
    turned = random.normal(size=made.quaternions.shape).astype(np.float32)
    return replace(
        made,
        quaternions=turned / np.linalg.norm(turned, axis=1, keepdims=True),
        log_scales=made.log_scales + random.uniform(-0.5, 0.3, made.log_scales.shape).astype(np.float32),
        opacity_logits=random.uniform(-2, 3, len(made)).astype(np.float32),
    )


def asked_by(task: str, small: SmallScene, monkeypatch: pytest.MonkeyPatch) -> Asked:
    """Run a task with the paper's parameters up to its training."""
    heard: list[Asked] = []

    def listening(initial, views, *, params, extent, seed, label_ids=(), parts=()):
        assert not parts
        heard.append(Asked(initial, list(views), params, extent, tuple(label_ids)))
        return TrainResult(initial, 0, np.zeros(0, np.float32))

    for module in (reconstruct, merge, global_pass):
        monkeypatch.setattr(module, "train", listening)
    box, ball = some(small, 1, EVERY[1]), some(small, 2, EVERY[2])
    if task == "reconstruct":
        reconstruct.reconstruct(small.views, small.instance(1, every=EVERY[1]), params=PAPER.reconstruct)
        heard[0].ids = (1,)
    elif task == "merge_pair":
        merge.merge_pair(small.views, box, ball, small.maps, params=PAPER.merge, w_mask=W_MASK)
    else:
        whole = global_pass.assemble((some(small, 0, EVERY[0]), box, ball))
        global_pass.global_pass(small.views, whole, small.maps, params=PAPER.merge)
    (only,) = heard
    return only


def crop_of(image: np.ndarray, view: TrainView, small: SmallScene) -> torch.Tensor:
    """What a view shows of an image of full size; its crops are not scaled."""
    full = camera_of(small.cameras, 0)
    x0, y0 = round(full.cx - view.camera.cx), round(full.cy - view.camera.cy)
    return torch.tensor(image[y0 : y0 + view.camera.height, x0 : x0 + view.camera.width], dtype=torch.float64)


def ssim(x: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
    """Mean over all pixels and channels, as 3DGS takes it: an 11 x 11 window, sigma 1.5, zeros beyond the border."""
    taps = torch.exp(-(torch.arange(-5, 6, dtype=torch.float64) ** 2) / (2 * 1.5**2))
    window = torch.outer(taps, taps)[None, None] / taps.sum() ** 2

    def blur(t):
        return torch.nn.functional.conv2d(t.permute(2, 0, 1)[:, None], window, padding=5)

    mx, my = blur(x), blur(y)
    xx, yy, xy = blur(x * x) - mx**2, blur(y * y) - my**2, blur(x * y) - mx * my
    return ((2 * mx * my + 1e-4) * (2 * xy + 9e-4) / ((mx**2 + my**2 + 1e-4) * (xx + yy + 9e-4))).mean()


def paper_loss(asked: Asked, parameters, view: TrainView, number: int, w_mask: float, small: SmallScene):
    """0.8 L1 + 0.2 (1 - SSIM) against the photo times the masks, and w_mask times the mean over pixels and instances of
    |rendered mask - mask|; all of it over the whole crop."""
    channels = channels_of(asked.initial.instance_id, asked.ids)
    out = reference.render(parameters, view.camera, torch.zeros(3, dtype=torch.float64), channels, len(asked.ids))
    masks = torch.stack([crop_of(small.ids[number] == i, view, small) for i in asked.ids])
    photo = crop_of(small.images[number] / np.float32(255), view, small) * masks.sum(dim=0)[..., None]
    color = 0.8 * (out["rgb"] - photo).abs().mean() + 0.2 * (1 - ssim(out["rgb"], photo))
    return color + w_mask * (out["label_masks"] - masks).abs().mean()


@pytest.mark.parametrize(
    ("task", "w_mask"), [("reconstruct", 0.0), ("merge_pair", W_MASK), ("global_pass", PAPER.merge.global_mask_weight)]
)
def test_the_objective_of_paper_is_the_papers(task, w_mask, small, monkeypatch):
    asked = asked_by(task, small, monkeypatch)
    assert asked.params.mask_weight == w_mask and len(asked.views) == len(small.frames)
    # Round or faint ones, as trainings start from, have hardly a gradient to compare.
    asked.initial = concatenate([some(small, i, EVERY[i]) for i in sorted(asked.ids)])
    arrays = {name: getattr(asked.initial, name) for name in PARAMETERS}
    labels = channels_of(asked.initial.instance_id, asked.ids) if w_mask else None
    num_labels = len(asked.ids) if w_mask else 0
    for number in (0, 3):
        view = asked.views[number]
        parameters = [torch.tensor(a, dtype=torch.float64, requires_grad=True) for a in arrays.values()]
        expected = paper_loss(asked, parameters, view, number, w_mask, small)
        expected.backward()
        target = Target.of(view, asked.params.objective, num_labels)
        behind = asked.params.objective.behind(np.random.default_rng(0))
        options = Settings(behind, num_labels, 0, winners=False)
        for share in (0.0, 1.0):
            weights = asked.params.objective.at(share, asked.params.mask_weight)
            for backend in (NativeBackend(1), TorchBackend("cpu")):
                values = {name: backend.put(a) for name, a in arrays.items()}
                channels = None if labels is None else backend.put(labels)
                found = backend.descent(values, channels, backend.target(target, num_labels), options, weights)
                assert backend.host(found.loss) == pytest.approx(expected.item(), rel=1e-5)
                for name, exact in zip(PARAMETERS, parameters, strict=True):
                    off = np.linalg.norm(backend.host(found.gradients[name]) - exact.grad.numpy())
                    assert off <= 1e-3 * np.linalg.norm(exact.grad.numpy()), name
        one = train(
            asked.initial,
            [view],
            params=replace(asked.params, iterations=1),
            extent=asked.extent,
            seed=0,
            label_ids=asked.ids if w_mask else (),
        )
        assert one.loss[0] == pytest.approx(expected.item(), rel=1e-5)


@pytest.mark.parametrize("task", ["reconstruct", "merge_pair", "global_pass"])
def test_paper_measures_the_pace_of_the_means_by_the_cameras(task, small, monkeypatch):
    # All cameras stand on a ring of radius 2.2.
    assert camera_extent(small.views.cameras) == pytest.approx(1.1 * 2.2)
    assert asked_by(task, small, monkeypatch).extent == pytest.approx(1.1 * 2.2)


def test_paper_merges_from_opacities_of_at_most_one_percent(small, monkeypatch):
    assert asked_by("merge_pair", small, monkeypatch).initial.opacities.max() <= 0.01 + 1e-6


def test_paper_starts_from_all_points_and_prunes_nothing_at_the_end(small, monkeypatch):
    asked = asked_by("reconstruct", small, monkeypatch)
    assert len(asked.initial) == len(small.instance(1, every=EVERY[1]).points)
    assert (asked.params.max_gaussians, asked.params.prune_contribution) == (0, 0.0)
