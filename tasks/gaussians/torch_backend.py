"""Training on a device of torch: on CUDA, where nothing leaves the device from step to step; on the CPU, to test that.

Imports torch: import it inside functions. The losses are those of `losses.py`, written with torch's own operations, and
so are their gradients: on a device a step takes as long as the host needs to start its kernels, and autograd would
start twice as many. No operation here is one of cuBLAS, which keeps some 30 MB for each stream that it was used on.
"""

from __future__ import annotations

import sys
import threading
from collections.abc import Iterator, Sequence
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
from ss_flow.tasks.gaussians.torch_render import memory_of

_RADIUS, _SIGMA = 5, 1.5
_C1, _C2 = 0.01**2, 0.03**2
_PIXEL_BYTES = 90
"""Of a pixel of a target, a few labels included."""


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
    inverse_depth: Tensor
    """[h, w] 1 / the known depth."""
    known: Tensor
    labelled: Tensor | None
    one_hot: Tensor
    """[P + 1, h, w]."""
    channel_of_label: Tensor
    """[labels] int32."""


@dataclass(frozen=True)
class _Photo:
    """The pixels whose colour counts, and what L1 and SSIM take of them, found once. Planes are [3, 1, h, w], and 0
    where the colour does not count."""

    counts: Tensor
    """[1, 1, h, w] bool."""
    share: Tensor
    """[1, 1, h, w] of each pixel in the mean over pixels and channels."""
    image: Tensor
    mean: Tensor
    """mu_y within SSIM's window."""
    brightness: Tensor
    """mu_y^2 + c1."""
    rest: Tensor
    """The mean of y^2 within the window + c1 + c2; with that of x^2 it is the sum of both of SSIM's denominators."""
    tap: Tensor
    """[2 _RADIUS + 1] of the window."""
    constants: tuple[Tensor, Tensor]
    """c1, and c1 + c2."""

    @classmethod
    def of(cls, image: Tensor, counted: Tensor) -> _Photo:
        """image: [h, w, 3]; counted: [h, w] 1 where the colour counts."""
        counts = (counted > 0)[None, None]
        share = (counted / (3 * counted.sum()))[None, None]
        image = torch.where(counts, _planes(image), 0)
        x = torch.arange(-_RADIUS, _RADIUS + 1, dtype=image.dtype, device=image.device)
        tap = torch.exp(-(x**2) / (2 * _SIGMA**2))
        tap = tap / tap.sum()
        mean, squares = _blur(torch.stack([image, image * image]), tap)
        constants = image.new_full((), _C1), image.new_full((), _C1 + _C2)
        return cls(counts, share, image, mean, mean * mean + _C1, squares + _C1 + _C2, tap, constants)

    def compare(self, image: Tensor, ssim_weight: float) -> tuple[Tensor, Tensor]:
        """The colour loss (1 - w) L1 + w (1 - SSIM) of [h, w, 3] (Kerbl et al. 2023, Eq. 7), and its gradient."""
        x = torch.where(self.counts, _planes(image), 0)
        off = x - self.image
        towards = off.sign() * ((1 - ssim_weight) * self.share)
        loss = (towards * off).sum()
        if ssim_weight:
            similarity, slope = self._ssim(x)
            loss = (loss + ssim_weight).sub_(similarity, alpha=ssim_weight)
            towards = torch.where(self.counts, towards.sub_(slope, alpha=ssim_weight), 0)
        return loss, towards[:, 0].permute(1, 2, 0)

    def _ssim(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Mean SSIM (Wang et al. 2004, Eq. 13) over the pixels that count, and its gradient.

        SSIM = (A1 A2) / (B1 B2) is a function of three means within the window, m of x, q of x^2 and p of x y; the
        gradient towards x is that towards each of them, through the window again, times what x is to it.
        """
        m, q, p = _blur(torch.stack([x, x * x, x * self.image]), self.tap)
        c1, c1_c2 = self.constants
        a1 = torch.addcmul(c1, m, self.mean, value=2)
        a2 = torch.add(c1_c2, p, alpha=2) - a1
        b1 = torch.addcmul(self.brightness, m, m)
        b2 = q + self.rest - b1
        part = self.share / (b1 * b2)
        ssim = a1 * a2 * part
        by_q, by_p = ssim / b2, a1 * part  # the slope towards q is -by_q, those towards m and p twice by_m and by_p
        by_m = torch.addcmul((a2 - a1) * self.mean * part, m, by_q - ssim / b1)
        by_m, by_q, by_p = _blur(torch.stack([by_m, by_q, by_p]), self.tap)
        slope = torch.addcmul(torch.addcmul(by_m, by_p, self.image), x, by_q, value=-1)
        return ssim.sum(), slope.mul_(2)


@dataclass(frozen=True)
class _OnDemand:
    """Targets that are carried to the device again whenever one is asked for."""

    targets: Targets
    backend: TorchBackend

    def __getitem__(self, view: int) -> _Target:
        return self.backend.target(self.targets[view], self.targets.num_labels)

    def __iter__(self) -> Iterator[_Target]:
        return (self[view] for view in range(len(self.targets.views)))


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
        with memory_of(self._device), _stream() if self._device.type == "cuda" else nullcontext():
            yield

    def put(self, array: NDArray[Any]) -> Tensor:
        return torch.tensor(array, device=self._device)

    def host(self, array: Tensor) -> NDArray[Any]:
        return array.cpu().numpy()

    def target(self, target: Target, num_labels: int) -> _Target:
        height, width = target.inside.shape
        channel_of_label = np.zeros(num_labels, np.int32)
        one_hot = torch.zeros((0, height, width), device=self._device)
        if target.ids is not None:
            present = np.unique(target.ids[target.ids >= 0])
            channel_of_label[:] = len(present)
            channel_of_label[present] = np.arange(len(present))
            one_hot = torch.zeros((len(present) + 1, height, width), device=self._device)
            one_hot[: len(present)] = self.put(target.ids) == self.put(present)[:, None, None]
        return _Target(
            self._renderer.camera_on(self._device, target.camera),
            _Photo.of(self.put(target.image), self.put(target.counted)) if target.counted.any() else None,
            self.put(target.inside),
            self.put(target.judged),
            self.put(1 / target.depth),
            self.put(target.known),
            None if target.labelled is None else self.put(target.labelled),
            one_hot,
            self.put(channel_of_label),
        )

    def targets(self, targets: Targets) -> list[_Target] | _OnDemand:
        """All of them on the device, or, where they would fill it, each when it is asked for."""
        there = _OnDemand(targets, self)
        pixels = sum(view.camera.width * view.camera.height for view in targets.views)
        return there if pixels * _PIXEL_BYTES > self._room() else list(there)

    def _room(self) -> int:
        """Bytes that targets may take: a training shares the device with others."""
        if self._device.type != "cuda":
            return sys.maxsize
        kept = torch.cuda.memory_reserved(self._device) - torch.cuda.memory_allocated(self._device)  # of trainings past
        return (torch.cuda.mem_get_info(self._device)[0] + kept) // 4

    def descent(
        self, values: Values, labels: Tensor | None, target: _Target, settings: Settings, weights: Weights
    ) -> Descent:
        leaves = {name: value.detach().requires_grad_() for name, value in values.items()}
        channels = None
        if labels is not None and target.labelled is not None:
            channels = torch.where(labels >= 0, target.channel_of_label[labels.clamp(min=0)], -1)
        settings = replace(settings, num_labels=0 if channels is None else len(target.one_hot))
        out = self._draw(leaves, target, channels, settings)
        with torch.no_grad():
            loss, images, towards = _loss(out, target, weights)
        found = torch.autograd.grad(images, tuple(leaves.values()), towards, materialize_grads=True)
        gradients = dict(zip(leaves, found, strict=True)) | {"centers": out.center_gradient}
        return Descent(loss, gradients, out.radii)

    def towards_parts(
        self, values: Values, parts: Sequence[tuple[slice, _Target]], weight: float
    ) -> list[tuple[slice, Values]]:
        if not parts:
            return []
        leaves = [{name: value[rows].detach().requires_grad_() for name, value in values.items()} for rows, _ in parts]
        groups = [(GaussianTensors(**own), target.camera) for own, (_, target) in zip(leaves, parts, strict=True)]
        drawn = self._renderer.alphas(groups)
        with torch.no_grad():
            towards = [
                (alpha - target.inside).sign_().mul_(weight * target.judged)
                for alpha, (_, target) in zip(drawn, parts, strict=True)
            ]
        shaped = [name for name in values if name != "sh"]  # no colour is seen
        found = iter(torch.autograd.grad(drawn, [own[name] for own in leaves for name in shaped], towards))
        return [(rows, {name: next(found) for name in shaped}) for rows, _ in parts]

    def adam(self, values: Values, gradients: Values, first: Values, second: Values, step: AdamStep) -> None:
        # A step of Adam is as long as its rate, and rates differ by parameter and by row: what one call, all rates 1,
        # does to zeros is cut to size here.
        sizes = [value.numel() for value in values.values()]
        flat = values["means"].new_zeros(sum(sizes)).split(sizes)
        moves = {name: part.view_as(values[name]) for name, part in zip(values, flat, strict=True)}
        towards, means, squares = ([group[name] for name in values] for group in (gradients, first, second))
        numbers = list(values["means"].new_full((len(values),), step.number - 1).unbind())
        adam(
            list(moves.values()), towards, means, squares, [], numbers, fused=True, amsgrad=False, maximize=False,
            beta1=0.9, beta2=0.999, weight_decay=0.0, eps=EPSILON, lr=1.0,
        )  # fmt: skip
        rates = step.rates
        for name in ("quaternions", "log_scales", "opacity_logits"):
            values[name].add_(moves[name], alpha=rates[name])
        values["means"].addcmul_(moves["means"], rates["means"][:, None])
        # Colours above `step.sh_degree` have neither gradient nor momentum, and so stay.
        values["sh"][:, :1].add_(moves["sh"][:, :1], alpha=rates["sh"])
        if values["sh"].shape[1] > 1:
            values["sh"][:, 1:].add_(moves["sh"][:, 1:], alpha=rates["sh_rest"])

    def strongest(self, values: Values, target: _Target) -> Tensor:
        with torch.no_grad():
            return self._draw(values, target, None, Settings((0.0, 0.0, 0.0), 0, 0, winners=True)).max_contribution

    def _draw(self, values: Values, target: _Target, channels: Tensor | None, settings: Settings) -> Rendered:
        gaussians, means = GaussianTensors(**values), values["means"]
        background = torch.stack([means.new_full((), value) for value in settings.background])
        return self._renderer.draw(
            gaussians, target.camera, background, channels, settings, means.new_zeros(len(means), 2)
        )


_AT_ONCE = threading.BoundedSemaphore(4)
"""Trainings on a device: more would take memory and make nothing faster."""
_idle: list[torch.cuda.Stream] = []
"""Streams of trainings that ended: the memory that torch keeps belongs to a stream."""


@contextmanager
def _stream() -> Iterator[None]:
    with _AT_ONCE:
        own = _idle.pop() if _idle else torch.cuda.Stream()
        try:
            with torch.cuda.stream(own):
                yield
        finally:
            _idle.append(own)


def _loss(out: Rendered, target: _Target, weights: Weights) -> tuple[Tensor, list[Tensor], list[Tensor]]:
    """The loss of a view, the images that it depends on, and the gradient towards each of them.

    l = l_RGB + w_mask l_mask (Split&Splat, Eq. 5), with the losses of alpha and depth: see `losses.surface`.
    """
    off = out.alpha - target.inside
    towards_alpha = off.sign().mul_(weights.alpha * target.judged)
    loss = (towards_alpha * off).sum()
    by_alpha: Tensor | int = -1
    by_depth = target.inverse_depth
    if weights.inverse_depth:
        shown = out.depth > 0  # where nothing is, a division would put NaN into the gradient
        share = torch.where(shown, out.alpha / torch.where(shown, out.depth, 1), 0)
        off, by_alpha, by_depth = share * out.alpha - target.inverse_depth, 2 * share, -share * share
    else:
        off = out.depth * target.inverse_depth - out.alpha
    slope = off.sign().mul_(weights.depth * target.known)
    loss += (slope * off).sum()
    towards_alpha += slope * by_alpha
    images, towards = [out.alpha, out.depth], [towards_alpha, slope * by_depth]
    if target.photo is not None:
        color, towards_rgb = target.photo.compare(out.rgb, weights.ssim)
        loss += color
        images, towards = [*images, out.rgb], [*towards, towards_rgb]
    if target.labelled is not None and len(out.label_masks):
        off = out.label_masks - target.one_hot
        towards_labels = off.sign().mul_(weights.mask * target.labelled)
        loss += (towards_labels * off).sum()
        images, towards = [*images, out.label_masks], [*towards, towards_labels]
    return loss, images, towards


def _planes(image: Tensor) -> Tensor:
    """[h, w, 3] -> [3, 1, h, w]."""
    return image.permute(2, 0, 1)[:, None]


def _blur(images: Tensor, tap: Tensor) -> Tensor:
    """[I, 3, 1, h, w] through the Gaussian window of SSIM, zeros beyond the border."""
    planes = images.flatten(0, 2)[None]  # as channels that do not mix, for which CUDA has a fast kernel
    count = planes.shape[1]
    across, down = tap.expand(count, 1, 1, -1), tap.view(-1, 1).expand(count, 1, -1, 1)
    blurred = torch.nn.functional.conv2d(planes, across, padding=(0, _RADIUS), groups=count)
    return torch.nn.functional.conv2d(blurred, down, padding=(_RADIUS, 0), groups=count).view(images.shape)
