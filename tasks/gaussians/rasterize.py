"""The differentiable rasterizer: 3D Gaussians to images (Kerbl et al. 2023), on the CPU or on CUDA.

Per pixel, front to back: alpha = min(0.99, opacity * exp(-q / 2)), nothing below 1/255 counts, and a pixel is done
before its transmittance T would fall below 1e-4; weight = T * alpha. A Gaussian's screen covariance is widened by
0.3 pixels^2.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from ss_flow.control_groups import usable_cores
from ss_flow.distributions import ABSENT, version
from ss_flow.errors import InputError
from ss_flow.tasks.artifacts import Gaussians
from ss_flow.tasks.device import VARIABLE, has_device, wanted
from ss_flow.tasks.gaussians.library import instruction_set
from ss_flow.tasks.gaussians.native_pass import PARAMETERS, Settings
from ss_flow.tasks.geometry.cameras import Camera
from ss_flow.tasks.processor import on_this_processor

if TYPE_CHECKING:
    import torch
    from torch import Tensor

SMALL, SMALL_PER_CORE = 200 * 200, 13_000
"""Pixels of a picture. A device takes three milliseconds a step whatever the size, to start its kernels, no more steps
a second for several trainings than for one, and some seconds in each process that starts it (docs/device.md). Where
pictures have fewer pixels than the first, or the second for each core of the machine, its cores are faster together."""


@dataclass
class GaussianTensors:
    """The parameters of 3D Gaussians as float32 tensors of one device, in the conventions of `Gaussians`."""

    means: Tensor
    """[N, 3] world."""
    quaternions: Tensor
    """[N, 4] w x y z, of any length but 0."""
    log_scales: Tensor
    """[N, 3]."""
    opacity_logits: Tensor
    """[N]."""
    sh: Tensor
    """[N, K, 3], K = 1, 4, 9 or 16."""

    def __len__(self) -> int:
        return len(self.means)

    def tensors(self) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """The five parameters in the order of `PARAMETERS`."""
        return self.means, self.quaternions, self.log_scales, self.opacity_logits, self.sh

    @classmethod
    def of(cls, gaussians: Gaussians, *, device: str = "cpu", requires_grad: bool = False) -> GaussianTensors:
        """Copies of an artifact's arrays."""
        import torch

        return cls(
            *(
                torch.tensor(np.asarray(getattr(gaussians, name), np.float32), device=device).requires_grad_(
                    requires_grad
                )
                for name in PARAMETERS
            )
        )


@dataclass(frozen=True)
class Rendered:
    """One rendering; the first four are differentiable."""

    rgb: Tensor
    """[H, W, 3] composited over the background."""
    alpha: Tensor
    """[H, W] sum of the weights."""
    depth: Tensor
    """[H, W] sum of weight * z; divide by alpha for the expected depth."""
    label_masks: Tensor
    """[L, H, W] sum of the weights of the Gaussians of each label."""
    top_contributor: Tensor
    """[H, W] int32 row of the Gaussian with the largest weight, -1 = none; all -1 without `winners`."""
    radii: Tensor
    """[N] reach on the screen in pixels, 0 = not in view."""
    max_contribution: Tensor
    """[N] largest weight over the image; zeros without `winners`."""
    center_gradient: Tensor
    """[N, 2] after `backward`: gradient towards the projected means, per pixel; zeros before."""


class Renderer(NamedTuple):
    """Draws one view on a device of torch; nothing is checked, and no parameter goes to the host."""

    camera_on: Callable[[torch.device, Camera], Any]
    """A camera as `draw` takes it."""
    draw: Callable[[GaussianTensors, Any, Tensor, Tensor | None, Settings, Tensor], Rendered]
    """`rasterize` of one view. Takes Gaussians, camera, background (that of the settings, for its gradient), labels,
    settings, and [N, 2] zeros that become `center_gradient`."""
    alphas: Callable[[Sequence[tuple[GaussianTensors, Any]]], list[Tensor]]
    """[H, W] the alpha of each group of Gaussians before its camera."""


@functools.cache
def device_here() -> str:
    """Where Gaussians are trained and drawn: "cuda" where gsplat, a torch with CUDA, a device and its driver are there,
    else "cpu".

    Found without importing torch, since every key that depends on it asks. Raises InputError when CUDA was asked for
    and something of it is missing (`SS_FLOW_DEVICE`).
    """
    if wanted() == "cpu":
        return "cpu"
    missing = ""
    if version("gsplat") == ABSENT:  # keys name its version
        missing = "gsplat is not installed (pip install 'ss-flow[cuda]')"
    elif "+cpu" in version("torch"):
        missing = f"torch {version('torch')} was built without it"
    elif not has_device():
        missing = "there is no device with a driver"
    if missing and wanted() == "cuda":
        raise InputError(f"{VARIABLE} asks for CUDA, but {missing}.")
    return "cpu" if missing else "cuda"


def device_for(pixels: float) -> str:
    """Where pictures of so many pixels are trained or drawn fastest: "cuda" or "cpu". Raises as `device_here`."""
    here = device_here()
    return "cpu" if pixels < max(SMALL, SMALL_PER_CORE * usable_cores()) else here


def backend_identity() -> dict[str, str]:
    """What renderings and trainings depend on besides their inputs: the instruction set, and CUDA's rasterizer."""
    rendering = {"rasterizer": on_this_processor(instruction_set())}
    return rendering if device_here() == "cpu" else {**rendering, "device": f"CUDA, gsplat {version('gsplat')}"}


def rasterize(
    gaussians: GaussianTensors,
    camera: Camera | Sequence[Camera],
    *,
    background: Tensor | tuple[float, float, float],
    labels: Tensor | None = None,
    num_labels: int = 0,
    sh_degree: int | None = None,
    winners: bool = False,
) -> Rendered:
    """Render 3D Gaussians, on the device where they are.

    camera: its principal point may lie anywhere. Several cameras of one image size render a batch: everything in the
    result then has one axis more in front. background: [3] RGB, differentiable when a tensor. labels: [N] int32, the
    mask channel (0 <= label < num_labels) of each Gaussian, negative = none. sh_degree: the degree in use, by default
    all that is stored. winners: also find `top_contributor` and `max_contribution`.

    Raises ValueError when shapes or types do not fit, a parameter is not finite, or the image is empty.
    """
    import torch

    cameras = (camera,) if isinstance(camera, Camera) else tuple(camera)
    if len({(c.width, c.height) for c in cameras}) != 1:
        raise ValueError("the cameras of a batch must be at least one and have one image size")
    stored = _check(gaussians, labels, num_labels, cameras)
    degree = stored if sh_degree is None else min(sh_degree, stored)
    if not isinstance(background, torch.Tensor):
        background = torch.tensor(background, dtype=torch.float32, device=gaussians.means.device)
    if background.shape != (3,):
        raise ValueError(f"background must be [3], not {list(background.shape)}")
    device = gaussians.means.device
    renderer = renderer_on(device)
    center_gradient = torch.zeros(len(cameras), len(gaussians), 2, device=device)
    red, green, blue = background.detach().tolist()
    settings = Settings((red, green, blue), num_labels, degree, winners)
    views = [
        renderer.draw(gaussians, renderer.camera_on(device, c), background, labels, settings, g)
        for c, g in zip(cameras, center_gradient, strict=True)
    ]
    if isinstance(camera, Camera):
        return views[0]
    images = {f.name: torch.stack([getattr(v, f.name) for v in views]) for f in fields(Rendered)}
    return Rendered(**{**images, "center_gradient": center_gradient})


def renderer_on(device: torch.device) -> Renderer:
    """What draws on a device of torch."""
    if device.type == "cpu":
        from ss_flow.tasks.gaussians import autograd

        return Renderer(autograd.camera_on, autograd.draw, autograd.alphas)
    from ss_flow.tasks.gaussians import cuda

    return Renderer(cuda.camera_on, cuda.draw, cuda.alphas)


def _check(gaussians: GaussianTensors, labels: Tensor | None, num_labels: int, cameras: Sequence[Camera]) -> int:
    import torch

    n = len(gaussians.means)
    for name, tensor, shape in zip(PARAMETERS, gaussians.tensors(), ((3,), (4,), (3,), (), (None, 3)), strict=True):
        fits = tensor.dim() == len(shape) + 1 and len(tensor) == n
        if not fits or any(s is not None and s != t for s, t in zip(shape, tensor.shape[1:], strict=True)):
            expected = ", ".join(["N", *("K" if s is None else str(s) for s in shape)])
            raise ValueError(f"{name} must be [{expected}] with N = {n}, not {list(tensor.shape)}")
        if tensor.dtype != torch.float32:
            raise ValueError(f"{name} must be float32, not {tensor.dtype}")
        # A sum is finite only where all terms are; one that overflows is looked at term by term.
        if not bool(torch.isfinite(tensor.detach().sum())) and not bool(torch.isfinite(tensor.detach()).all()):
            raise ValueError(f"{name} holds values that are not finite")
    degrees = {1: 0, 4: 1, 9: 2, 16: 3}
    if gaussians.sh.shape[1] not in degrees:
        raise ValueError(f"sh must hold 1, 4, 9 or 16 coefficients, not {gaussians.sh.shape[1]}")
    if (labels is None) != (num_labels == 0):
        raise ValueError("labels and num_labels go together")
    if labels is not None:
        if labels.shape != (n,) or labels.dtype != torch.int32:
            raise ValueError(f"labels must be [{n}] int32, not {list(labels.shape)} {labels.dtype}")
        if n and int(labels.max()) >= num_labels:
            raise ValueError(f"labels must be below num_labels = {num_labels}, but one is {int(labels.max())}")
    for camera in cameras:
        if camera.width < 1 or camera.height < 1 or not (camera.fx > 0 and camera.fy > 0):
            raise ValueError(f"a camera needs pixels and positive focal lengths, not {camera}")
    return degrees[gaussians.sh.shape[1]]
