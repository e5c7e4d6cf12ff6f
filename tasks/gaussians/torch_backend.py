"""Loss and gradients of one view by torch, for CUDA (imports torch: import it inside functions).

The parameters and Adam stay on the host, so that training is the same code on every device; what crosses is the
parameters and their gradients, once a step. The losses are those of `losses.py`, written with torch's own operations.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ss_flow.tasks.artifacts import Int32
from ss_flow.tasks.gaussians.backends import Arrays, Descent
from ss_flow.tasks.gaussians.native_pass import PARAMETERS, Settings
from ss_flow.tasks.gaussians.objective import Target, Weights
from ss_flow.tasks.gaussians.rasterize import GaussianTensors, rasterize

_RADIUS, _SIGMA = 5, 1.5
_C1, _C2 = 0.01**2, 0.03**2


@dataclass(frozen=True)
class _Target:
    """A target on the device, its mask loss by channels: one for each label that the view shows, one for all others,
    which should stay empty."""

    image: Tensor
    counted: Tensor
    inside: Tensor
    judged: Tensor
    depth: Tensor
    known: Tensor
    labelled: Tensor | None
    one_hot: Tensor
    """[P + 1, h, w]."""
    channel_of_label: Int32
    """[labels]."""


class TorchBackend:
    """On any device that torch and `rasterize` know."""

    def __init__(self, device: str) -> None:
        self._device = device
        self._targets: dict[int, tuple[Target, _Target]] = {}

    def descent(
        self, parameters: Arrays, labels: Int32 | None, target: Target, settings: Settings, weights: Weights
    ) -> Descent:
        here = self._here(target, settings.num_labels)
        tensors = GaussianTensors(*(torch.tensor(a, device=self._device, requires_grad=True) for a in parameters))
        channels = None
        if labels is not None and here.labelled is not None:
            chosen = np.where(labels >= 0, here.channel_of_label[np.maximum(labels, 0)], -1).astype(np.int32)
            channels = torch.tensor(chosen, device=self._device)
        out = rasterize(
            tensors,
            target.camera,
            background=settings.background,
            labels=channels,
            num_labels=0 if channels is None else len(here.one_hot),
            sh_degree=settings.sh_degree,
        )
        loss = _color_loss(out.rgb, here, weights.ssim)
        loss = loss + weights.alpha * (here.judged * (out.alpha - here.inside).abs()).sum()
        loss = loss + weights.depth * (here.known * _depth_error(out.alpha, out.depth, here, weights)).sum()
        if here.labelled is not None:
            loss = loss + weights.mask * (here.labelled * (out.label_masks - here.one_hot).abs()).sum()
        loss.backward()
        gradients = {
            name: (torch.zeros_like(t) if t.grad is None else t.grad).cpu().numpy()
            for name, t in zip(PARAMETERS, tensors.tensors(), strict=True)
        }
        gradients["centers"] = out.center_gradient.cpu().numpy()
        return Descent(float(loss.detach()), gradients, out.radii.cpu().numpy())

    def _here(self, target: Target, num_labels: int) -> _Target:
        if id(target) not in self._targets:
            self._targets[id(target)] = (target, _moved(target, num_labels, self._device))
        return self._targets[id(target)][1]


def _moved(target: Target, num_labels: int, device: str) -> _Target:
    def put(array: np.ndarray) -> Tensor:
        return torch.tensor(array, device=device)

    height, width = target.inside.shape
    channel_of_label = np.zeros(num_labels, np.int32)
    one_hot = np.zeros((0, height, width), np.float32)
    if target.ids is not None:
        present = np.unique(target.ids[target.ids >= 0])
        channel_of_label[:] = len(present)
        channel_of_label[present] = np.arange(len(present))
        one_hot = np.zeros((len(present) + 1, height, width), np.float32)
        one_hot[: len(present)] = target.ids == present[:, None, None]
    return _Target(
        put(target.image),
        put(target.counted),
        put(target.inside),
        put(target.judged),
        put(target.depth),
        put(target.known),
        None if target.labelled is None else put(target.labelled),
        put(one_hot),
        channel_of_label,
    )


def _depth_error(alpha: Tensor, depth: Tensor, target: _Target, weights: Weights) -> Tensor:
    if not weights.inverse_depth:
        return (depth / target.depth - alpha).abs()
    shown = depth > 0  # where nothing is, a division would put NaN into the gradient
    return (torch.where(shown, alpha * alpha / torch.where(shown, depth, 1), 0) - 1 / target.depth).abs()


def _color_loss(image: Tensor, target: _Target, ssim_weight: float) -> Tensor:
    counts = (target.counted > 0)[..., None]
    share = target.counted[..., None] / (3 * target.counted.sum()).clamp(min=1e-12)
    if not bool(counts.any()):
        return image.sum() * 0
    x, y = (torch.where(counts, i, torch.zeros_like(i)).permute(2, 0, 1)[:, None] for i in (image, target.image))
    share = share.permute(2, 0, 1)[:, None]
    loss = (1 - ssim_weight) * (share * (x - y).abs()).sum()
    if ssim_weight == 0:
        return loss
    mx, my, mxx, myy, mxy = (_blur(i) for i in (x, y, x * x, y * y, x * y))
    top = (2 * mx * my + _C1) * (2 * (mxy - mx * my) + _C2)
    bottom = (mx * mx + my * my + _C1) * ((mxx - mx * mx) + (myy - my * my) + _C2)
    return loss + ssim_weight * (1 - (share * top / bottom).sum())


def _blur(image: Tensor) -> Tensor:
    """[C, 1, H, W] through the Gaussian window of SSIM, zeros beyond the border."""
    x = torch.arange(-_RADIUS, _RADIUS + 1, dtype=image.dtype, device=image.device)
    tap = torch.exp(-(x**2) / (2 * _SIGMA**2))
    tap = tap / tap.sum()
    across = torch.nn.functional.conv2d(image, tap.view(1, 1, 1, -1), padding=(0, _RADIUS))
    return torch.nn.functional.conv2d(across, tap.view(1, 1, -1, 1), padding=(_RADIUS, 0))
