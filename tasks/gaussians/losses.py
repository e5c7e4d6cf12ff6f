"""Losses of training, fused in the native library on the CPU; pixels of weight 0 count for nothing."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ss_flow.tasks.artifacts import Float32
from ss_flow.tasks.gaussians.library import address, library


class Photometric(NamedTuple):
    """(1 - ssim_weight) * L1 + ssim_weight * (1 - SSIM) and its gradient towards the image."""

    loss: float
    l1: float
    ssim: float
    gradient: Float32
    """[H, W, C]."""


def photometric(image: Float32, target: Float32, weight: Float32, ssim_weight: float = 0.2) -> Photometric:
    """The colour loss of 3D Gaussian Splatting (Kerbl et al. 2023, Eq. 7) over the pixels of weight > 0.

    image, target: [H, W, C] float32, 0..1. weight: [H, W] float32. SSIM: an 11 x 11 Gaussian window with sigma 1.5,
    zeros beyond the border and where the weight is 0 (in both images alike).
    """
    height, width, channels = image.shape
    if target.shape != image.shape or weight.shape != (height, width):
        raise ValueError(f"image {image.shape}, target {target.shape} and weight {weight.shape} do not fit")
    image, target, weight = (np.ascontiguousarray(a, np.float32) for a in (image, target, weight))
    gradient, out = np.empty_like(image), np.empty(3, np.float64)
    failed = library().ss_photometric(
        width, height, channels, address(image), address(target), address(weight), ssim_weight, address(gradient),
        out.ctypes.data,
    )  # fmt: skip
    if failed:
        raise MemoryError("not enough memory for the colour loss")
    return Photometric(float(out[0]), float(out[1]), float(out[2]), gradient)


def weighted_l1(value: Float32, target: Float32, weight: Float32) -> tuple[float, Float32]:
    """The sum of weight * |value - target| and its gradient towards the value; three arrays of one shape."""
    if not value.shape == target.shape == weight.shape:
        raise ValueError(f"value {value.shape}, target {target.shape} and weight {weight.shape} do not fit")
    value, target, weight = (np.ascontiguousarray(a, np.float32) for a in (value, target, weight))
    gradient = np.empty_like(value)
    loss = library().ss_weighted_l1(value.size, address(value), address(target), address(weight), address(gradient))
    return float(loss), gradient
