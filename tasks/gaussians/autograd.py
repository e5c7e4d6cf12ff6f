"""The native rasterizer as a torch function (imports torch: import it inside functions)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ss_flow.tasks.gaussians.native_pass import PARAMETERS, NativePass, Settings
from ss_flow.tasks.gaussians.rasterize import GaussianTensors, Rendered
from ss_flow.tasks.geometry.cameras import Camera


def camera_on(device: torch.device, camera: Camera) -> Camera:
    """As `draw` takes it: as it is."""
    return camera


def draw(
    gaussians: GaussianTensors,
    camera: Camera,
    background: Tensor,
    labels: Tensor | None,
    settings: Settings,
    center_gradient: Tensor,
) -> Rendered:
    """See `Renderer`."""
    channels = None if labels is None else np.ascontiguousarray(labels.numpy())
    rgb, alpha, depth, masks, top, radii, strongest = _Rasterize.apply(
        *gaussians.tensors(), background, channels, camera, settings, center_gradient
    )
    return Rendered(rgb, alpha, depth, masks, top, radii, strongest, center_gradient)


def alphas(parts: Sequence[tuple[GaussianTensors, Camera]]) -> list[Tensor]:
    """See `Renderer`."""
    settings = Settings((0.0, 0.0, 0.0), 0, 0, winners=False)
    background = torch.zeros(3)
    return [draw(g, camera, background, None, settings, torch.zeros(len(g), 2)).alpha for g, camera in parts]


class _Rasterize(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *arguments: Any) -> tuple[Tensor, ...]:
        channels, camera, settings, centers = arguments[6:]
        parameters = tuple(np.ascontiguousarray(t.detach().numpy()) for t in arguments[:5])
        done = NativePass(parameters, channels, camera, settings)  # type: ignore[arg-type]
        ctx.done, ctx.centers = done, centers
        ctx.set_materialize_grads(False)
        none = np.full(done.alpha.shape, -1, np.int32), np.zeros(len(parameters[0]), np.float32)
        top, strongest = none if done.top is None else (done.top, done.strongest)
        images = (done.rgb, done.alpha, done.depth, done.masks, top, done.radii, strongest)
        outputs = tuple(torch.from_numpy(a) for a in images)
        ctx.mark_non_differentiable(*outputs[4:])
        return outputs

    @staticmethod
    def backward(ctx: Any, *towards: Tensor | None) -> tuple[Any, ...]:
        given = [None if t is None else np.ascontiguousarray(t.numpy()) for t in towards[:4]]
        out = ctx.done.backward(*given)
        ctx.centers += torch.from_numpy(out["centers"])
        gradients = [torch.from_numpy(out[name]) for name in (*PARAMETERS, "background")]
        return (*gradients, None, None, None, None)
