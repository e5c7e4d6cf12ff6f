"""The same rendering by gsplat on CUDA (imports torch and gsplat: import it inside functions)."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from ss_flow.tasks.gaussians.native_pass import NEAR_PLANE, Settings
from ss_flow.tasks.gaussians.rasterize import GaussianTensors, Rendered
from ss_flow.tasks.geometry.cameras import Camera


def rasterize_cuda(
    gaussians: GaussianTensors,
    camera: Camera,
    background: Tensor,
    labels: Tensor | None,
    settings: Settings,
    center_gradient: Tensor,
) -> Rendered:
    """`rasterize` of one view on CUDA, its arguments checked. center_gradient: [N, 2] zeros, to be filled.

    gsplat ends a pixel and cuts small contributions by its own thresholds, so results agree with the CPU's to about a
    grey level. It gives no winners: with `winners` this raises NotImplementedError.
    """
    if settings.winners:
        raise NotImplementedError("top contributors are found on the CPU only: render with CPU tensors")
    from gsplat import rasterization, spherical_harmonics

    device = gaussians.means.device
    pose = torch.as_tensor(camera.world_to_camera, dtype=torch.float32, device=device)
    intrinsics = torch.tensor(
        [[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]], dtype=torch.float32, device=device
    )
    center = -pose[:3, :3].T @ pose[:3, 3]
    used = (settings.sh_degree + 1) ** 2
    colors = spherical_harmonics(settings.sh_degree, gaussians.means - center, gaussians.sh[:, :used].contiguous())
    channels = [torch.clamp(colors + 0.5, min=0)]
    if labels is not None:
        one_hot = torch.zeros(len(gaussians), settings.num_labels, device=device)
        rows = torch.nonzero(labels >= 0)[:, 0]
        one_hot[rows, labels[rows].long()] = 1
        channels.append(one_hot)
    images, alphas, info = _render(rasterization, gaussians, channels, pose, intrinsics, camera)
    means2d = info["means2d"]
    if means2d.requires_grad:
        means2d.register_hook(lambda towards: center_gradient.add_(towards.reshape(center_gradient.shape)))
    image, alpha = images[0], alphas[0, :, :, 0]
    radii = info["radii"][0].float()
    size = (camera.height, camera.width)
    return Rendered(
        rgb=image[..., :3] + (1 - alpha)[..., None] * background,
        alpha=alpha,
        depth=image[..., -1],
        label_masks=image[..., 3:-1].permute(2, 0, 1),
        top_contributor=torch.full(size, -1, dtype=torch.int32, device=device),
        radii=radii.amax(dim=-1) if radii.dim() == 2 else radii,
        max_contribution=torch.zeros(len(gaussians), device=device),
        center_gradient=center_gradient,
    )


def _render(
    rasterization: Any,
    gaussians: GaussianTensors,
    channels: list[Tensor],
    pose: Tensor,
    intrinsics: Tensor,
    camera: Camera,
) -> tuple[Tensor, Tensor, dict[str, Any]]:
    images, alphas, info = rasterization(
        means=gaussians.means,
        quats=torch.nn.functional.normalize(gaussians.quaternions, dim=1),
        scales=torch.exp(gaussians.log_scales),
        opacities=torch.sigmoid(gaussians.opacity_logits),
        colors=torch.cat(channels, dim=1),
        viewmats=pose[None],
        Ks=intrinsics[None],
        width=camera.width,
        height=camera.height,
        near_plane=NEAR_PLANE,
        render_mode="RGB+D",
        packed=False,
    )
    return images, alphas, info
