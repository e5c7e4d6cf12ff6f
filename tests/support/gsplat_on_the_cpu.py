"""What the adapter to gsplat calls, written out densely in torch, with gsplat's own names, shapes and rules.

Stands in for the module `gsplat` where there is no CUDA: every tile lists all Gaussians. Without data-dependent shapes
it also runs on torch's device "meta", which has no values; but for `rasterize_to_indices_in_range`.
"""

from __future__ import annotations

import torch

NOBODY = -1
"""In the place of a row that is not listed: how many are would depend on values."""
LIMIT, END, CLIP = 1 / 255, 1e-4, 0.999
KERNELS = (1, 2, 3, 4, 5, 8, 9, 16, 17, 32, 33, 64, 65, 128, 129, 256, 257, 512, 513)
"""Of so many channels; gsplat 1.5.3 pads others itself, later versions refuse them."""


def fully_fused_projection(
    means, covars, quats, scales, viewmats, Ks, width, height, eps2d=0.3, near_plane=0.01, far_plane=1e10,
    radius_clip=0.0, packed=False, sparse_grad=False, calc_compensations=False, camera_model="pinhole", opacities=None,
):  # fmt: skip
    """EWA splatting (Zwicker et al. 2001), from each camera."""
    assert covars is None and not packed and len(viewmats) == len(Ks)
    seen = [_projection(means, quats, scales, *of, width, height, eps2d, near_plane, far_plane, opacities)
            for of in zip(viewmats, Ks, strict=True)]  # fmt: skip
    return (*(torch.stack(values) for values in zip(*seen, strict=True)), None)


def _projection(means, quats, scales, viewmat, k, width, height, eps2d, near_plane, far_plane, opacities):
    """From one camera; the slope of what lies outside the picture is limited as in 3DGS."""
    rotation, translation = viewmat[:3, :3], viewmat[:3, 3]
    w, x, y, z = torch.nn.functional.normalize(quats, dim=1).unbind(1)
    turn = torch.stack(
        [
            1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
            2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
            2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
        ],
        dim=1,
    ).reshape(-1, 3, 3)  # fmt: skip
    factor = rotation @ (turn * scales[:, None])
    px, py, depth = (means @ rotation.T + translation).unbind(1)
    fx, fy, cx, cy = k[0, 0], k[1, 1], k[0, 2], k[1, 2]

    def sloped(offset, focal, centre, size):
        more = 0.3 * 0.5 * size / focal
        return torch.maximum(torch.minimum(offset / depth, (size - centre) / focal + more), -centre / focal - more)

    nothing = torch.zeros_like(depth)
    jacobian = torch.stack(
        [
            torch.stack([fx / depth, nothing, -fx * sloped(px, fx, cx, width) / depth], dim=1),
            torch.stack([nothing, fy / depth, -fy * sloped(py, fy, cy, height) / depth], dim=1),
        ],
        dim=1,
    )
    flat = jacobian @ factor
    spread = flat @ flat.mT + eps2d * torch.eye(2, device=means.device)
    a, b, c = spread[:, 0, 0], spread[:, 0, 1], spread[:, 1, 1]
    conics = torch.stack([c, -b, a], dim=1) / (a * c - b * b)[:, None]
    centres = torch.stack([fx * px / depth + cx, fy * py / depth + cy], dim=1)
    reach = torch.sqrt(2 * torch.log(torch.clamp(opacities / LIMIT, min=1))).clamp(max=3.33)
    radii = torch.ceil(reach[:, None] * torch.sqrt(torch.stack([a, c], dim=1))).detach()
    seen = (depth > near_plane) & (depth < far_plane) & (opacities >= LIMIT)
    seen = seen & (centres + radii > 0).all(dim=1)
    seen = seen & (centres[:, 0] - radii[:, 0] < width) & (centres[:, 1] - radii[:, 1] < height)
    centres = torch.where(seen[:, None], centres, 1e6)  # gsplat lists the others in no tile
    return torch.where(seen[:, None], radii, 0).int(), centres, depth, conics


def spherical_harmonics(degrees_to_use, dirs, coeffs, masks=None):
    """The real basis of 3DGS up to degree 1."""
    assert degrees_to_use <= 1 and coeffs.shape[1] == (degrees_to_use + 1) ** 2
    found = 0.28209479177387814 * coeffs[:, 0]
    if degrees_to_use:
        x, y, z = torch.nn.functional.normalize(dirs, dim=1)[..., None].unbind(1)
        found = found + 0.4886025119029199 * (-y * coeffs[:, 1] + z * coeffs[:, 2] - x * coeffs[:, 3])
    return found if masks is None else torch.where(masks[:, None], found, torch.nan)  # gsplat leaves the rest unset


def isect_tiles(
    means2d, radii, depths, tile_size, tile_width, tile_height, sort=True, segmented=False, packed=False,
    n_images=None, image_ids=None, gaussian_ids=None,
):  # fmt: skip
    tiles, count = tile_width * tile_height, depths.shape[1]
    order = depths.detach().argsort(dim=1, stable=True)
    shown = (radii > 0).all(dim=2).gather(1, order)
    order = order + count * torch.arange(len(depths), device=depths.device)[:, None]
    listed = torch.where(shown, order, NOBODY).repeat(1, tiles).flatten()
    return torch.full_like(order, tiles).int(), listed, listed.int()


def isect_offset_encode(isect_ids, n_images, tile_width, tile_height):
    tiles = n_images * tile_width * tile_height
    offsets = torch.arange(tiles, device=isect_ids.device, dtype=torch.int32) * (len(isect_ids) // tiles)
    return offsets.reshape(n_images, tile_height, tile_width)


def _alphas(means2d, conics, opacities, rows, width, height):
    """[pixels, rows] of the Gaussians in these rows of all cameras', 0 where too little."""
    y, x = torch.meshgrid(*(torch.arange(n, device=rows.device) + 0.5 for n in (height, width)), indexing="ij")
    means2d, conics, opacities = means2d.flatten(0, 1), conics.flatten(0, 1), opacities.flatten()
    dx, dy = (means2d[rows, axis] - p.reshape(-1, 1) for axis, p in ((0, x), (1, y)))
    a, b, c = conics[rows].unbind(1)
    alpha = (rows != NOBODY) * (opacities[rows] * torch.exp(-0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy)).clamp(
        max=CLIP
    )
    return torch.where(alpha < LIMIT, 0, alpha)


def rasterize_to_pixels(
    means2d, conics, colors, opacities, image_width, image_height, tile_size, isect_offsets, flatten_ids,
    backgrounds=None, masks=None, packed=False, absgrad=False,
):  # fmt: skip
    assert colors.shape[:2] == means2d.shape[:2] and colors.shape[2] in KERNELS
    cameras, count = means2d.shape[:2]
    listed = flatten_ids.view(cameras, -1, count)[:, 0].long()  # in all tiles the same
    behind = [None] * cameras if backgrounds is None else backgrounds
    drawn = [_pixels(means2d, conics, colors.flatten(0, 1), opacities, image_height, image_width, *of)
             for of in zip(listed, behind, strict=True)]  # fmt: skip
    return tuple(torch.stack(images) for images in zip(*drawn, strict=True))


def _pixels(means2d, conics, colors, opacities, image_height, image_width, rows, background):
    alpha = _alphas(means2d, conics, opacities, rows, image_width, image_height)
    left = torch.cumprod(1 - alpha, dim=1)
    before = torch.cat([torch.ones_like(left[:, :1]), left[:, :-1]], dim=1)
    weight = torch.where(left > END, before * alpha, 0)
    opaque = weight.sum(dim=1, keepdim=True)
    images = weight @ torch.nan_to_num(colors[rows])  # of weight 0
    if background is not None:
        assert background.shape == colors.shape[1:]
        images = images + (1 - opaque) * background
    size = (image_height, image_width)
    return images.reshape(*size, -1), opaque.reshape(*size, 1)


def rasterize_to_indices_in_range(
    range_start, range_end, transmittances, means2d, conics, opacities, image_width, image_height, tile_size,
    isect_offsets, flatten_ids,
):  # fmt: skip
    """Who contributes to each pixel, pixel by pixel and front to back, from a part of each tile's list."""
    count = means2d.shape[1]
    batch = tile_size**2
    rows = flatten_ids[: min(range_end * batch, count)][range_start * batch :].long()
    alpha = _alphas(means2d, conics, opacities, rows, image_width, image_height)
    left = torch.cumprod(torch.cat([transmittances.reshape(-1, 1), 1 - alpha], dim=1), dim=1)[:, 1:]
    going = torch.cummin((left > END).int(), dim=1).values > 0
    pixel, place = ((alpha > 0) & going).nonzero(as_tuple=True)
    return rows[place], pixel, torch.zeros_like(pixel)
