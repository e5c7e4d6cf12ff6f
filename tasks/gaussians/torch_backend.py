"""Training on a device of torch: on CUDA, where nothing leaves the device from step to step; on the CPU, to test that.

Imports torch: import it inside functions. The losses are those of `losses.py`, written with torch's own operations.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.optim.adam import adam

from ss_flow.tasks.gaussians.backends import EPSILON, AdamStep, Descent, Values
from ss_flow.tasks.gaussians.native_pass import Settings
from ss_flow.tasks.gaussians.objective import Target, Targets, Weights
from ss_flow.tasks.gaussians.rasterize import GaussianTensors, Rendered, renderer_on

_RADIUS, _SIGMA = 5, 1.5
_C1, _C2 = 0.01**2, 0.03**2


@dataclass(frozen=True)
class _Target:
    """A target on the device, its mask loss by channels: one for each label that the view shows, one for all others,
    which should stay empty."""

    camera: Any
    """As the device's renderer takes it."""
    photo: _Photo | None
    """None where no colour counts."""
    inside: Tensor
    judged: Tensor
    depth: Tensor
    known: Tensor
    labelled: Tensor | None
    one_hot: Tensor
    """[P + 1, h, w]."""
    channel_of_label: Tensor
    """[labels] int32."""


@dataclass(frozen=True)
class _Photo:
    """The pixels whose colour counts, and what SSIM takes of them, found once."""

    counts: Tensor
    """[1, 1, h, w] bool."""
    share: Tensor
    """[1, 1, h, w] of each pixel in the mean over pixels and channels."""
    image: Tensor
    """[3, 1, h, w] 0 where the colour does not count."""
    mean: Tensor
    """[3, 1, h, w] within SSIM's window."""
    variance: Tensor
    """[3, 1, h, w] likewise."""

    @classmethod
    def of(cls, image: Tensor, counted: Tensor) -> _Photo:
        """image: [h, w, 3]; counted: [h, w] 1 where the colour counts."""
        counts = (counted > 0)[None, None]
        share = (counted / (3 * counted.sum()))[None, None]
        image = torch.where(counts, _planes(image), 0)
        mean, squares = _blur(torch.stack([image, image * image]))
        return cls(counts, share, image, mean, squares - mean * mean)


class TorchBackend:
    """On any device that torch and a renderer know."""

    xp = torch

    def __init__(self, device: str) -> None:
        self._device = torch.device(device)
        self._renderer = renderer_on(self._device)
        # SSIM takes differences of nearly equal sums, which the ten bits of TF32 do not hold.
        torch.backends.cudnn.allow_tf32 = False

    @contextmanager
    def stream(self) -> Iterator[None]:
        own = torch.cuda.stream(torch.cuda.Stream(self._device)) if self._device.type == "cuda" else nullcontext()
        try:
            with own:
                yield
        except torch.OutOfMemoryError as error:  # is no MemoryError, upon which a task is tried once more alone
            raise MemoryError(f"not enough memory on {self._device} for a training") from error

    def put(self, array: NDArray[Any]) -> Tensor:
        return torch.tensor(array, device=self._device)

    def host(self, array: Tensor) -> NDArray[Any]:
        return array.cpu().numpy()

    def target(self, target: Target, num_labels: int) -> _Target:
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
            self._renderer.camera_on(self._device, target.camera),
            _Photo.of(self.put(target.image), self.put(target.counted)) if target.counted.any() else None,
            self.put(target.inside),
            self.put(target.judged),
            self.put(target.depth),
            self.put(target.known),
            None if target.labelled is None else self.put(target.labelled),
            self.put(one_hot),
            self.put(channel_of_label),
        )

    def targets(self, targets: Targets) -> list[_Target]:
        return [self.target(target, targets.num_labels) for target in targets]

    def descent(
        self, values: Values, labels: Tensor | None, target: _Target, settings: Settings, weights: Weights
    ) -> Descent:
        leaves = {name: value.detach().requires_grad_() for name, value in values.items()}
        channels = None
        if labels is not None and target.labelled is not None:
            channels = torch.where(labels >= 0, target.channel_of_label[labels.clamp(min=0)], -1)
        settings = replace(settings, num_labels=0 if channels is None else len(target.one_hot))
        out = self._draw(leaves, target, channels, settings)
        loss = _color_loss(out.rgb, target.photo, weights.ssim)
        loss = loss + weights.alpha * (target.judged * (out.alpha - target.inside).abs()).sum()
        loss = loss + weights.depth * (target.known * _depth_error(out.alpha, out.depth, target, weights)).sum()
        if target.labelled is not None and channels is not None:
            loss = loss + weights.mask * (target.labelled * (out.label_masks - target.one_hot).abs()).sum()
        towards = torch.autograd.grad(loss, tuple(leaves.values()), materialize_grads=True)
        gradients = dict(zip(leaves, towards, strict=True)) | {"centers": out.center_gradient}
        return Descent(loss.detach(), gradients, out.radii)

    def adam(self, values: Values, gradients: Values, first: Values, second: Values, step: AdamStep) -> None:
        rates = dict(step.rates)
        rates["means"] = rates["means"][:, None]
        # Colours above `step.sh_degree` have neither gradient nor momentum, and so stay.
        rates["sh"] = torch.full_like(values["sh"][:1, :, :1], rates["sh_rest"])
        rates["sh"][:, 0] = step.rates["sh"]
        for name, value in values.items():
            rate = rates[name]
            single = not isinstance(rate, Tensor)
            before = value if single else value.clone()
            adam(
                [value], [gradients[name]], [first[name]], [second[name]], [],
                [value.new_full((), step.number - 1)],
                fused=True, amsgrad=False, maximize=False, beta1=0.9, beta2=0.999, weight_decay=0.0, eps=EPSILON,
                lr=rate if single else 1.0,
            )  # fmt: skip
            # A step of Adam is as long as its rate: where rows have rates of their own, it is cut to size here.
            if not single:
                torch.lerp(before, value, rate, out=value)

    def strongest(self, values: Values, target: _Target) -> Tensor:
        with torch.no_grad():
            return self._draw(values, target, None, Settings((0.0, 0.0, 0.0), 0, 0, winners=True)).max_contribution

    def _draw(self, values: Values, target: _Target, channels: Tensor | None, settings: Settings) -> Rendered:
        gaussians, means = GaussianTensors(**values), values["means"]
        background = torch.stack([means.new_full((), value) for value in settings.background])
        return self._renderer.draw(
            gaussians, target.camera, background, channels, settings, means.new_zeros(len(means), 2)
        )


def _depth_error(alpha: Tensor, depth: Tensor, target: _Target, weights: Weights) -> Tensor:
    if not weights.inverse_depth:
        return (depth / target.depth - alpha).abs()
    shown = depth > 0  # where nothing is, a division would put NaN into the gradient
    return (torch.where(shown, alpha * alpha / torch.where(shown, depth, 1), 0) - 1 / target.depth).abs()


def _color_loss(image: Tensor, photo: _Photo | None, ssim_weight: float) -> Tensor:
    if photo is None:
        return image.sum() * 0
    x, y = torch.where(photo.counts, _planes(image), 0), photo.image
    loss = (1 - ssim_weight) * (photo.share * (x - y).abs()).sum()
    if ssim_weight == 0:
        return loss
    mean, squares, products = _blur(torch.stack([x, x * x, x * y]))
    both, covariance = mean * photo.mean, products - mean * photo.mean
    top = (2 * both + _C1) * (2 * covariance + _C2)
    bottom = (mean * mean + photo.mean * photo.mean + _C1) * (squares - mean * mean + photo.variance + _C2)
    return loss + ssim_weight * (1 - (photo.share * top / bottom).sum())


def _planes(image: Tensor) -> Tensor:
    """[h, w, 3] -> [3, 1, h, w]."""
    return image.permute(2, 0, 1)[:, None]


def _blur(images: Tensor) -> Tensor:
    """[I, 3, 1, h, w] through the Gaussian window of SSIM, zeros beyond the border."""
    x = torch.arange(-_RADIUS, _RADIUS + 1, dtype=images.dtype, device=images.device)
    tap = torch.exp(-(x**2) / (2 * _SIGMA**2))
    tap = tap / tap.sum()
    planes = images.flatten(0, 1)
    across = torch.nn.functional.conv2d(planes, tap.view(1, 1, 1, -1), padding=(0, _RADIUS))
    return torch.nn.functional.conv2d(across, tap.view(1, 1, -1, 1), padding=(_RADIUS, 0)).reshape(images.shape)
