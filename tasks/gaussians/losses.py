"""Losses of training, fused in the native library; pixels of weight 0 count for nothing."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ss_flow.tasks.artifacts import Float32
from ss_flow.tasks.gaussians.library import Workspace, address, library
from ss_flow.tasks.gaussians.native_pass import NativePass
from ss_flow.tasks.gaussians.objective import Target, Weights


class Photometric(NamedTuple):
    """(1 - ssim_weight) * L1 + ssim_weight * (1 - SSIM) and its gradient towards the image."""

    loss: float
    l1: float
    ssim: float
    gradient: Float32
    """[H, W, C]."""


def photometric(
    image: Float32,
    target: Float32,
    weight: Float32,
    ssim_weight: float = 0.2,
    *,
    workspace: Workspace | None = None,
    threads: int = 1,
) -> Photometric:
    """The colour loss of 3D Gaussian Splatting (Kerbl et al. 2023, Eq. 7) over the pixels of weight > 0.

    image, target: [H, W, C] float32, 0..1. weight: [H, W] float32. SSIM: an 11 x 11 Gaussian window with sigma 1.5,
    zeros beyond the border and where the weight is 0 (in both images alike).
    """
    height, width, channels = image.shape
    if target.shape != image.shape or weight.shape != (height, width):
        raise ValueError(f"image {image.shape}, target {target.shape} and weight {weight.shape} do not fit")
    image, target, weight = (np.ascontiguousarray(a, np.float32) for a in (image, target, weight))
    gradient, out = np.empty_like(image), np.empty(3, np.float64)
    workspace = Workspace() if workspace is None else workspace
    failed = library().ss_photometric(
        workspace.handle, width, height, channels, address(image), address(target), address(weight), ssim_weight,
        address(gradient), out.ctypes.data, threads,
    )  # fmt: skip
    if failed:
        raise MemoryError("not enough memory for the colour loss")
    return Photometric(float(out[0]), float(out[1]), float(out[2]), gradient)


class Surface(NamedTuple):
    """The losses of alpha, depth and labels, each before its weight, and their weighted gradients."""

    alpha: float
    depth: float
    labels: float
    towards_alpha: Float32
    """[H, W]."""
    towards_depth: Float32
    """[H, W]."""


def surface(
    alpha: Float32, depth: Float32, mismatch: Float32 | None, target: Target, weights: Weights, threads: int = 1
) -> Surface:
    """Three absolute errors, sums over pixels with weights that the target gives; C-contiguous [H, W] arrays.

    Alpha: judged * |alpha - inside|. Depth: known * |depth / target depth - alpha|, a relative error, so that the scale
    of the world does not matter; or, between inverse depths, known * |alpha^2 / depth - 1 / target depth|, where
    alpha / depth, the inverse of the mean depth, stands for 3DGS's mean of inverse depths. Labels, without `mismatch`
    0: labelled * (mismatch + 1 where ids >= 0); its gradient towards `mismatch` is `labelled`. That is the absolute
    error of all label masks against their one-hot targets, l_mask, since no mask falls below 0 or exceeds 1
    (Split&Splat, Eq. 6; spec A25).
    """
    towards_alpha, towards_depth, out = np.empty_like(alpha), np.empty_like(depth), np.empty(3, np.float64)
    asked = (target.inside, target.judged, target.depth, target.known, target.labelled, target.ids)
    images = (alpha, depth, mismatch, *asked)
    if any(a is not None and a.shape != alpha.shape for a in images):
        raise ValueError(f"the images must all be {list(alpha.shape)}")
    failed = library().ss_surface_loss(
        alpha.size, *(address(a) for a in images), weights.alpha, weights.depth, weights.inverse_depth,
        address(towards_alpha), address(towards_depth), out.ctypes.data, threads,
    )  # fmt: skip
    if failed:
        raise MemoryError("not enough memory for the losses of alpha, depth and labels")
    return Surface(float(out[0]), float(out[1]), float(out[2]), towards_alpha, towards_depth)


def gradients_of(
    rendered: NativePass, target: Target, weights: Weights, workspace: Workspace, threads: int
) -> tuple[float, tuple[Float32, Float32, Float32, Float32 | None]]:
    """The loss of one view, and its gradients towards rgb, alpha, depth and mismatch (None = zero).

    l = l_RGB + w_mask l_mask (Split&Splat, Eq. 5), with the losses of alpha and depth that an `Objective` may add:
    colour by L1 and SSIM, and each rendered label against its one-hot target, a mean over pixels and labels (spec A25).
    """
    color = photometric(
        rendered.rgb, target.image, target.counted, weights.ssim, workspace=workspace, threads=threads
    )  # fmt: skip
    rest = surface(rendered.alpha, rendered.depth, rendered.mismatch, target, weights, threads)
    total = color.loss + weights.alpha * rest.alpha + weights.depth * rest.depth + weights.mask * rest.labels
    towards_mismatch = None if target.labelled is None else target.labelled * np.float32(weights.mask)
    return total, (color.gradient, rest.towards_alpha, rest.towards_depth, towards_mismatch)
