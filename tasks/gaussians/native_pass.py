"""One rendering by the native library, on NumPy arrays: forward, then any number of backward passes."""

from __future__ import annotations

import ctypes
from dataclasses import dataclass
from typing import Any

import numpy as np

from ss_flow.tasks.artifacts import Float32, Int32
from ss_flow.tasks.gaussians.library import Gradients, Images, Scene, address, library
from ss_flow.tasks.geometry.cameras import Camera


@dataclass(frozen=True)
class Settings:
    """What a rendering depends on besides the Gaussians and the camera."""

    background: tuple[float, float, float]
    num_labels: int
    sh_degree: int
    near_plane: float
    antialias: bool
    winners: bool
    """Whether to find each pixel's top contributor and each Gaussian's largest weight."""


class NativePass:
    """A forward pass and what its backward pass needs; give the arrays C-contiguous, float32 and int32.

    Images after construction: rgb [H, W, 3], alpha [H, W], depth [H, W], masks [L, H, W], top [H, W] int32;
    for the Gaussians: radii [N] pixels, strongest [N] largest weight (zeros without `winners`).
    """

    def __init__(
        self,
        parameters: tuple[Float32, Float32, Float32, Float32, Float32],
        labels: Int32 | None,
        camera: Camera,
        settings: Settings,
    ) -> None:
        means, quaternions, log_scales, opacity_logits, sh = parameters
        h, w, n = camera.height, camera.width, len(means)
        self._kept: Any = None
        self._inputs = (*parameters, labels)  # the scene below holds only their addresses
        self._scene = Scene(
            n,
            *(address(a) for a in (means, quaternions, log_scales, opacity_logits, sh, labels)),
            sh.shape[1],
            settings.sh_degree,
            settings.num_labels,
            w,
            h,
            settings.antialias,
            camera.fx,
            camera.fy,
            camera.cx,
            camera.cy,
            (ctypes.c_double * 12)(*np.asarray(camera.world_to_camera, np.float64)[:3].ravel()),
            settings.near_plane,
            (ctypes.c_float * 3)(*settings.background),
        )
        self.rgb = np.empty((h, w, 3), np.float32)
        self.alpha = np.empty((h, w), np.float32)
        self.depth = np.empty((h, w), np.float32)
        self.masks = np.zeros((settings.num_labels, h, w), np.float32)
        self.top = np.full((h, w), -1, np.int32)
        self.radii = np.empty(n, np.float32)
        self.strongest = np.zeros(n, np.float32)
        top, strongest = (self.top, self.strongest) if settings.winners else (None, None)
        images = (self.rgb, self.alpha, self.depth, self.masks, top, self.radii, strongest)
        self._images = Images(*(address(a) for a in images))
        self._kept = library().ss_rasterize(ctypes.byref(self._scene), ctypes.byref(self._images))
        if self._kept is None:
            raise MemoryError(f"not enough memory to render {n} Gaussians at {w}x{h}")

    def __del__(self) -> None:
        if self._kept is not None:
            library().ss_rasterize_release(self._kept)

    def backward(
        self, rgb: Float32 | None, alpha: Float32 | None, depth: Float32 | None, masks: Float32 | None
    ) -> dict[str, Float32]:
        """Gradients of the parameters, of the background and of the projected means (`centers` [N, 2], pixels)."""
        given = Images(*(address(a) for a in (rgb, alpha, depth, masks)), None, None, None)
        names = ("means", "quaternions", "log_scales", "opacity_logits", "sh")
        out = {name: np.zeros_like(a) for name, a in zip(names, self._inputs[:5], strict=True)}
        out["centers"] = np.zeros((len(self.radii), 2), np.float32)
        out["background"] = np.zeros(3, np.float32)
        gradients = Gradients(*(address(a) for a in out.values()))
        failed = library().ss_rasterize_backward(
            self._kept,
            ctypes.byref(self._scene),
            ctypes.byref(self._images),
            ctypes.byref(given),
            ctypes.byref(gradients),
        )
        if failed:
            raise MemoryError("not enough memory for the gradients of a rendering")
        return out
