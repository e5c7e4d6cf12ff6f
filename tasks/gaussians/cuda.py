"""The same rendering by gsplat, on CUDA (imports torch and gsplat: import it inside functions).

gsplat ends a pixel and cuts small contributions by rules of its own, and sums gradients in any order: results agree
with the CPU's to about a grey level, and with those of another run to rounding.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from ss_flow.tasks.gaussians.native_pass import NEAR_PLANE, Settings
from ss_flow.tasks.gaussians.rasterize import GaussianTensors, Rendered
from ss_flow.tasks.geometry.cameras import Camera

_TILE = 16
"""Pixels on a side of gsplat's tiles."""
_CHANNELS = (1, 2, 3, 4, 5, 8, 9, 16, 17, 32)
"""Of so many channels gsplat has kernels, up to the most that it blends at once at full speed."""
_STRIP = 4
"""Rows of tiles whose contributions are listed at once: they may be a hundred for every pixel."""
_LEAST_ALPHA, _MOST_ALPHA = 1 / 255, 0.999
"""gsplat's smallest alpha and its largest."""


class DeviceCamera(NamedTuple):
    """A camera with its matrices on the device."""

    camera: Camera
    pose: Tensor
    """[1, 4, 4] world to camera."""
    intrinsics: Tensor
    """[1, 3, 3] of the whole photo, by whose borders gsplat limits slopes."""
    photo: tuple[int, int]
    """Its width and height."""
    corner: Tensor
    """[1, 1, 2] where the image lies in it."""
    half: Tensor
    """[1, 1, 2] half of the image's width and height."""
    center: Tensor
    """[3] world."""


def camera_on(device: torch.device, camera: Camera) -> DeviceCamera:
    """See `Renderer`."""
    pose = torch.tensor(camera.world_to_camera, dtype=torch.float32, device=device)
    left, upper, right, lower = camera.borders
    cx, cy = -left * camera.fx, -upper * camera.fy
    intrinsics, corner, half, center = (
        torch.tensor(values, dtype=torch.float32, device=device)
        for values in (
            [[[camera.fx, 0, cx], [0, camera.fy, cy], [0, 0, 1]]],
            [[[cx - camera.cx, cy - camera.cy]]],
            [[[camera.width / 2, camera.height / 2]]],
            camera.center.tolist(),
        )
    )
    photo = round((right - left) * camera.fx), round((lower - upper) * camera.fy)
    return DeviceCamera(camera, pose[None], intrinsics, photo, corner, half, center)


class _Splats(NamedTuple):
    """Gaussians on the screens of C cameras, and gsplat's list of those in each tile, front to back."""

    means: Tensor
    """[C, N, 2] pixels."""
    conics: Tensor
    """[C, N, 3]."""
    opacities: Tensor
    """[C, N]."""
    depths: Tensor
    """[C, N]."""
    radii: Tensor
    """[C, N, 2] int32, 0 = not in view."""
    offsets: Tensor
    """[C, tile rows, tile columns] where each tile's list begins."""
    listed: Tensor
    """[I] rows of Gaussians."""


def draw(
    gaussians: GaussianTensors,
    camera: DeviceCamera,
    background: Tensor,
    labels: Tensor | None,
    settings: Settings,
    center_gradient: Tensor,
) -> Rendered:
    """See `Renderer`; top contributors and largest weights, if asked for, take longer than all the rest."""
    from gsplat import rasterize_to_pixels, spherical_harmonics

    width, height = camera.camera.width, camera.camera.height
    splats = _projected(gaussians, [camera], width, height)
    if splats.means.requires_grad:

        def note(towards: Tensor) -> None:  # what a hook returns would take the gradient's place
            center_gradient.add_(towards[0])

        splats.means.register_hook(note)
    reach = splats.radii[0].amax(dim=-1)
    used = (settings.sh_degree + 1) ** 2
    sh = gaussians.sh if used == gaussians.sh.shape[1] else gaussians.sh[:, :used]
    colors = spherical_harmonics(settings.sh_degree, gaussians.means - camera.center, sh, masks=reach > 0)
    channels = [torch.clamp(colors + 0.5, min=0), splats.depths.view(-1, 1)]
    behind = [background, background.new_zeros(1 + settings.num_labels)]
    if labels is not None:
        channels.append((labels[:, None] == torch.arange(settings.num_labels, device=labels.device)).float())
    drawn = [
        rasterize_to_pixels(
            splats.means, splats.conics, _padded(some)[None], splats.opacities, width, height, _TILE, splats.offsets,
            splats.listed, backgrounds=_padded(color)[None],
        )
        for some, color in zip(
            torch.cat(channels, dim=1).split(_CHANNELS[-1], dim=1), torch.cat(behind).split(_CHANNELS[-1]), strict=True
        )
    ]  # fmt: skip
    image = drawn[0][0] if len(drawn) == 1 else torch.cat([images for images, _ in drawn], dim=-1)
    # Views whose gradients are put together by one kernel; slices would be added up, each as large as the image.
    image = image.view(height, width, -1)
    parts = [3, 1, settings.num_labels]
    rgb, depth, label_masks, _ = image.split([*parts, image.shape[-1] - sum(parts)], dim=-1)
    alpha = drawn[0][1].view(height, width)
    top = torch.full((height, width), -1, dtype=torch.int32, device=alpha.device)
    strongest = alpha.new_zeros(len(gaussians))
    if settings.winners:
        with torch.no_grad():
            _find_winners(splats, alpha, top, strongest)
    return Rendered(
        rgb=rgb,
        alpha=alpha,
        depth=depth.squeeze(-1),
        label_masks=label_masks.permute(2, 0, 1),
        top_contributor=top,
        radii=reach.float(),
        max_contribution=strongest,
        center_gradient=center_gradient,
    )


def _padded(channels: Tensor) -> Tensor:
    """[..., C] with channels of zeros up to a number that gsplat has a kernel for; some versions of it do not pad."""
    count = channels.shape[-1]
    return torch.nn.functional.pad(channels, (0, next(known for known in _CHANNELS if known >= count) - count))


def alphas(parts: Sequence[tuple[GaussianTensors, DeviceCamera]]) -> list[Tensor]:
    """See `Renderer`: all by the same kernels, as one picture of the largest size from each camera."""
    from gsplat import rasterize_to_pixels

    groups, cameras = zip(*parts, strict=True)
    sizes = [(camera.camera.height, camera.camera.width) for camera in cameras]
    height, width = (max(side) for side in zip(*sizes, strict=True))
    together = GaussianTensors(*(torch.cat(tensors) for tensors in zip(*(g.tensors() for g in groups), strict=True)))
    owner = torch.zeros(len(parts), len(together), dtype=torch.bool, device=together.means.device)
    start = 0
    for own, group in zip(owner, groups, strict=True):
        own[start : start + len(group)] = True
        start += len(group)
    splats = _projected(together, cameras, width, height, owner)
    _, drawn = rasterize_to_pixels(
        splats.means, splats.conics, torch.zeros_like(splats.depths)[..., None], splats.opacities, width, height, _TILE,
        splats.offsets, splats.listed,
    )  # fmt: skip
    return [alpha[:rows, :columns, 0] for alpha, (rows, columns) in zip(drawn, sizes, strict=True)]


def _projected(
    gaussians: GaussianTensors,
    cameras: Sequence[DeviceCamera],
    width: int,
    height: int,
    owner: Tensor | None = None,
) -> _Splats:
    """width, height: of the pictures. owner: [C, N] the Gaussians that each camera sees, by default all."""
    from gsplat import fully_fused_projection, isect_offset_encode, isect_tiles

    opacities = torch.sigmoid(gaussians.opacity_logits)
    pose, intrinsics, corner, half = (
        of_each[0] if len(cameras) == 1 else torch.cat(of_each)
        for of_each in zip(*((c.pose, c.intrinsics, c.corner, c.half) for c in cameras), strict=True)
    )
    photo = (max(side) for side in zip(*(c.photo for c in cameras), strict=True))
    radii, means, depths, conics, _ = fully_fused_projection(
        gaussians.means, None, gaussians.quaternions, torch.exp(gaussians.log_scales), pose, intrinsics,
        *photo, near_plane=NEAR_PLANE, opacities=opacities,
    )  # fmt: skip
    means = means - corner
    shown = ((means.detach() - half).abs() < radii + half).all(dim=-1)
    radii = torch.where((shown if owner is None else shown & owner)[..., None], radii, 0)
    columns, rows = -(-width // _TILE), -(-height // _TILE)
    _, keys, listed = isect_tiles(means, radii, depths, _TILE, columns, rows)
    offsets = isect_offset_encode(keys, len(cameras), columns, rows).reshape(len(cameras), rows, columns)
    return _Splats(means, conics, opacities.expand(len(cameras), -1), depths, radii, offsets, listed)


def _find_winners(splats: _Splats, alpha: Tensor, top: Tensor, strongest: Tensor) -> None:
    """Fill in each pixel's Gaussian of the largest weight ([H, W], -1 where none is) and each Gaussian's largest weight
    ([N], 0 where it has none), from gsplat's lists of who contributes to a pixel. alpha: [H, W] as rendered."""
    from gsplat import rasterize_to_indices_in_range

    height, width = alpha.shape
    begins = torch.cat([splats.offsets.flatten(), splats.offsets.new_tensor([len(splats.listed)])]).long()
    columns = splats.offsets.shape[-1]
    for row in range(0, splats.offsets.shape[1], _STRIP):
        tiles = splats.offsets[:, row : row + _STRIP]
        rows = slice(row * _TILE, min((row + tiles.shape[1]) * _TILE, height))
        size = (rows.stop - rows.start, width)
        means = splats.means - splats.means.new_tensor([0, rows.start])
        ends = begins[row * columns : (row + tiles.shape[1]) * columns + 1]
        listed = splats.listed[: int(ends[-1])]
        transmittance, heaviest = means.new_ones(size).flatten(), means.new_zeros(size).flatten()
        best, left = top[rows].view(-1), 1 - alpha[rows].flatten()
        for turn in range(-(-int(ends.diff().max()) // _TILE**2)):  # gsplat takes as many of a tile's list at once
            gaussian, pixel, _ = rasterize_to_indices_in_range(
                turn, turn + 1, transmittance.reshape(1, *size), means, splats.conics, splats.opacities, width, size[0],
                _TILE, tiles, listed,
            )  # fmt: skip
            if not len(gaussian):
                continue
            gaussian, pixel = gaussian.long(), pixel.long()
            each = _alpha(means[0, gaussian], splats.conics[0, gaussian], splats.opacities[0, gaussian], pixel, width)
            # Those of one pixel follow one another, front to back: their sums are differences of the sum over all.
            thinned = torch.log1p(-each.double())
            before = thinned.cumsum(0) - thinned
            first = torch.cat([pixel[:1] >= 0, pixel.diff() != 0]).nonzero()[:, 0]
            start = before.new_zeros(len(heaviest)).index_put((pixel[first],), before[first])
            weight = transmittance[pixel] * torch.exp(before - start[pixel]).float() * each
            strongest.scatter_reduce_(0, gaussian, weight, "amax")
            peak = torch.zeros_like(heaviest).scatter_reduce_(0, pixel, weight, "amax")
            place = torch.arange(len(pixel), device=pixel.device)
            place = torch.where(weight == peak[pixel], place, len(pixel))  # of equal weights the front one leads
            leader = pixel.new_full((len(heaviest),), len(pixel)).scatter_reduce_(0, pixel, place, "amin")
            better = peak > heaviest
            best[better] = gaussian[leader[better]].int()
            heaviest = torch.maximum(heaviest, peak)
            transmittance *= torch.exp(torch.zeros_like(start).index_add_(0, pixel, thinned)).float()
            # A pixel that ends at an opaque Gaussian does not tell: in the next part of the list, a faint one would
            # pass. But no Gaussian is so faint that one more would not be seen in what is left.
            transmittance *= transmittance > (1 + _LEAST_ALPHA / 2) * left


def _alpha(means: Tensor, conics: Tensor, opacities: Tensor, pixel: Tensor, width: int) -> Tensor:
    """[M] of splats at the centres of pixels, which are counted row by row."""
    x, y = means[:, 0] - pixel % width - 0.5, means[:, 1] - pixel // width - 0.5
    power = 0.5 * (conics[:, 0] * x * x + conics[:, 2] * y * y) + conics[:, 1] * x * y
    return torch.clamp(opacities * torch.exp(-power), max=_MOST_ALPHA)
