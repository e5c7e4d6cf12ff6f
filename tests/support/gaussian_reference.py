"""Slow, obvious rendering of 3D Gaussians in float64 torch: every Gaussian in every pixel, no bins, no early end."""

from __future__ import annotations

import torch
from torch import Tensor


def rotations(quaternions: Tensor) -> Tensor:
    w, x, y, z = (quaternions / quaternions.norm(dim=1, keepdim=True)).unbind(1)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return torch.stack([torch.stack(row, dim=1) for row in rows], dim=1)


def sh_basis(degree: int, d: Tensor) -> Tensor:
    """Associated Legendre polynomials by recurrence, times cos or sin: independent of the closed forms."""
    x, y, z = d.unbind(1)
    from math import factorial, pi, sqrt

    cosines, sines = [torch.ones_like(x)], [torch.zeros_like(x)]
    for _ in range(degree):  # radius^m cos(m phi), radius^m sin(m phi)
        c, s = cosines[-1], sines[-1]
        cosines.append(x * c - y * s)
        sines.append(x * s + y * c)
    legendre: dict[tuple[int, int], Tensor] = {}  # P_l^m / radius^m, with the Condon-Shortley phase
    for m in range(degree + 1):
        double = 1.0
        for k in range(1, 2 * m, 2):
            double *= k
        legendre[m, m] = torch.full_like(x, (-1.0) ** m * double)
        if m + 1 <= degree:
            legendre[m + 1, m] = z * (2 * m + 1) * legendre[m, m]
        for n in range(m + 2, degree + 1):
            legendre[n, m] = (z * (2 * n - 1) * legendre[n - 1, m] - (n + m - 1) * legendre[n - 2, m]) / (n - m)
    out = []
    for n in range(degree + 1):
        for m in range(-n, n + 1):
            k = sqrt((2 * n + 1) / (4 * pi) * factorial(n - abs(m)) / factorial(n + abs(m)))
            trig = torch.ones_like(x) if m == 0 else sqrt(2) * (cosines[m] if m > 0 else sines[-m])
            out.append(k * trig * legendre[n, abs(m)])
    return torch.stack(out, dim=1)


def slope_limits(camera) -> list[tuple[float, float]]:
    """gsplat's rule: three tenths of the tangent of half the field of view beyond the photo's borders, x / z, y / z."""
    left, top, right, bottom = camera.borders
    half_x, half_y = (right - left) / 2, (bottom - top) / 2
    return [(left - 0.3 * half_x, right + 0.3 * half_x), (top - 0.3 * half_y, bottom + 0.3 * half_y)]


def render(
    parameters, camera, background, labels=None, num_labels=0, sh_degree=0, near=0.01, limits=None
) -> dict[str, Tensor]:
    means, quaternions, log_scales, opacity_logits, sh = parameters
    to_camera = torch.as_tensor(camera.world_to_camera, dtype=torch.float64)
    rotation, translation = to_camera[:3, :3], to_camera[:3, 3]
    local = means @ rotation.T + translation
    x, y, z = local.unbind(1)
    keep = z > near
    safe = torch.where(keep, z, torch.ones_like(z))
    tx, ty = ((a / safe).clamp(*limit) for a, limit in zip((x, y), limits or slope_limits(camera), strict=True))
    zero = torch.zeros_like(z)
    jacobian = torch.stack(
        [
            torch.stack([camera.fx / safe, zero, -camera.fx * tx / safe], dim=1),
            torch.stack([zero, camera.fy / safe, -camera.fy * ty / safe], dim=1),
        ],
        dim=1,
    )
    factor = rotations(quaternions) * log_scales.exp()[:, None, :]
    screen = jacobian @ rotation @ factor
    covariance = screen @ screen.transpose(1, 2) + 0.3 * torch.eye(2, dtype=torch.float64)
    inverse = torch.linalg.inv(covariance)
    opacity = torch.sigmoid(opacity_logits)
    center = -rotation.T @ translation
    direction = torch.nn.functional.normalize(means - center, dim=1)
    used = (sh_degree + 1) ** 2
    color = torch.einsum("nk,nkc->nc", sh_basis(sh_degree, direction), sh[:, :used]) + 0.5
    color = color.clamp(min=0)
    u, v = camera.fx * x / safe + camera.cx, camera.fy * y / safe + camera.cy

    rows, columns = torch.meshgrid(
        torch.arange(camera.height, dtype=torch.float64) + 0.5,
        torch.arange(camera.width, dtype=torch.float64) + 0.5,
        indexing="ij",
    )
    transmittance = torch.ones_like(rows)
    live = torch.ones_like(rows, dtype=torch.bool)
    rgb = torch.zeros(*rows.shape, 3, dtype=torch.float64)
    alpha_sum, depth = torch.zeros_like(rows), torch.zeros_like(rows)
    masks = [torch.zeros_like(rows) for _ in range(num_labels)]
    top, best = torch.full(rows.shape, -1), torch.zeros_like(rows)
    strongest = torch.zeros(len(means), dtype=torch.float64)
    for i in torch.sort(local[:, 2].detach().float(), stable=True).indices.tolist():
        if not keep[i]:
            continue
        dx, dy = columns - u[i], rows - v[i]
        k = inverse[i]
        q = k[0, 0] * dx * dx + 2 * k[0, 1] * dx * dy + k[1, 1] * dy * dy
        alpha = (opacity[i] * torch.exp(-q / 2)).clamp(max=0.99)
        counts = live & (alpha >= 1 / 255)
        after = transmittance * (1 - alpha)
        live = live & ~(counts & (after < 1e-4))
        counts = counts & live
        weight = torch.where(counts, transmittance * alpha, 0.0)
        rgb = rgb + weight[..., None] * color[i]
        alpha_sum, depth = alpha_sum + weight, depth + weight * z[i]
        if num_labels and labels[i] >= 0:
            masks[labels[i]] = masks[labels[i]] + weight
        top = torch.where(weight > best, i, top)
        best = torch.maximum(best, weight).detach()
        strongest[i] = weight.max().detach()
        transmittance = torch.where(counts, after, transmittance)
    return {
        "rgb": rgb + transmittance[..., None] * background,
        "alpha": alpha_sum,
        "depth": depth,
        "label_masks": torch.stack(masks) if masks else torch.zeros(0, *rows.shape, dtype=torch.float64),
        "top_contributor": top,
        "max_contribution": strongest,
    }
