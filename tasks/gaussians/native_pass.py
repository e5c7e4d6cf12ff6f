"""One rendering by the native library, on NumPy arrays: forward, then any number of backward passes."""

from __future__ import annotations

import ctypes
from dataclasses import dataclass

import numpy as np

from ss_flow.tasks.artifacts import Float32, Int32
from ss_flow.tasks.gaussians.library import Gradients, Images, Scene, Workspace, address, library
from ss_flow.tasks.geometry.cameras import Camera

NEAR_PLANE = 0.01
"""Nearest depth that is drawn, in world units."""

PARAMETERS = ("means", "quaternions", "log_scales", "opacity_logits", "sh")


@dataclass(frozen=True)
class Settings:
    """What a rendering depends on besides the Gaussians and the camera."""

    background: tuple[float, float, float]
    num_labels: int
    sh_degree: int
    winners: bool
    """Whether to find each pixel's top contributor and each Gaussian's largest weight."""


class NativePass:
    """A forward pass and what its backward pass needs; give the arrays C-contiguous, float32 and int32.

    labels: [N], < 0 = none. With `ids` ([H, W]: the label that each pixel should show), `mismatch` [H, W] is the sum of
    the weights of other labels less those of the pixel's own; without, `masks` [L, H, W] are the sums of each label's
    weights. Further images: rgb [H, W, 3], alpha [H, W], depth [H, W], top [H, W] int32; for the Gaussians: radii [N]
    pixels, strongest [N] largest weight; `top` and `strongest` are None without `winners`. The number of threads
    changes no byte.
    """

    def __init__(
        self,
        parameters: tuple[Float32, Float32, Float32, Float32, Float32],
        labels: Int32 | None,
        camera: Camera,
        settings: Settings,
        *,
        ids: Int32 | None = None,
        workspace: Workspace | None = None,
        threads: int = 1,
    ) -> None:
        h, w, n = camera.height, camera.width, len(parameters[0])
        self._inputs = (*parameters, labels, ids)  # the scene below holds only their addresses
        self._threads = threads
        self._workspace = Workspace() if workspace is None else workspace
        self._scene = Scene(
            n,
            *(address(a) for a in self._inputs),
            parameters[4].shape[1],
            settings.sh_degree,
            settings.num_labels,
            w,
            h,
            camera.fx,
            camera.fy,
            camera.cx,
            camera.cy,
            (ctypes.c_double * 4)(*camera.borders),
            (ctypes.c_double * 12)(*np.asarray(camera.world_to_camera, np.float64)[:3].ravel()),
            NEAR_PLANE,
            (ctypes.c_float * 3)(*settings.background),
        )
        self.rgb = np.empty((h, w, 3), np.float32)
        self.alpha = np.empty((h, w), np.float32)
        self.depth = np.empty((h, w), np.float32)
        self.masks = np.zeros((0 if labels is None or ids is not None else settings.num_labels, h, w), np.float32)
        self.mismatch = np.empty((h, w), np.float32) if ids is not None else None
        self.top = np.full((h, w), -1, np.int32) if settings.winners else None
        self.radii = np.empty(n, np.float32)
        self.strongest = np.empty(n, np.float32) if settings.winners else None
        masks = self.masks if len(self.masks) else None
        images = (self.rgb, self.alpha, self.depth, masks, self.mismatch, self.top, self.radii, self.strongest)
        self._images = Images(*(address(a) for a in images))
        failed = library().ss_rasterize(
            self._workspace.handle, ctypes.byref(self._scene), ctypes.byref(self._images), threads
        )
        self._workspace.turn += 1
        self._turn = self._workspace.turn
        if failed:
            raise MemoryError(f"not enough memory to render {n} Gaussians at {w}x{h}")

    @property
    def entries(self) -> int:
        """How many (Gaussian, 4x4-pixel block) pairs were blended: what the time of a rendering grows with."""
        self._check_workspace()
        return int(library().ss_entries(self._workspace.handle))

    def _check_workspace(self) -> None:
        if self._workspace.turn != self._turn:
            raise RuntimeError("the workspace of this rendering holds another one by now")

    def shares(self, ids: Int32) -> tuple[Int32, Int32, Float32]:
        """Rows, ids and the sums of these rows' weights over the ids' pixels; a row and id may be there several times.

        ids: [H, W], < 0 = none. Raises RuntimeError when another pass has used the workspace.
        """
        self._check_workspace()
        count, ids = ctypes.c_int64(), np.ascontiguousarray(ids, np.int32)
        if library().ss_shares(
            self._workspace.handle, ctypes.byref(self._scene), address(ids), ctypes.byref(count), self._threads
        ):
            raise MemoryError("not enough memory for the weights of a rendering")
        rows, found = (np.empty(count.value, np.int32) for _ in range(2))
        weights = np.empty(count.value, np.float32)
        library().ss_take_shares(self._workspace.handle, *(address(a) for a in (rows, found, weights)))
        return rows, found, weights

    def backward(
        self,
        rgb: Float32 | None,
        alpha: Float32 | None,
        depth: Float32 | None,
        labelled: Float32 | None,
        *,
        out: dict[str, Float32] | None = None,
    ) -> dict[str, Float32]:
        """Gradients of the parameters, of the background and of the projected means (`centers` [N, 2], pixels).

        labelled: the gradient towards `mismatch` or `masks`. out: arrays to fill, as an earlier pass over as many
        Gaussians gave them. Raises RuntimeError when another pass has used the workspace.
        """
        self._check_workspace()
        masks, mismatch = (labelled, None) if self.mismatch is None else (None, labelled)
        given = Images(*(address(a) for a in (rgb, alpha, depth, masks, mismatch)), None, None, None)
        if out is None:
            out = {name: np.empty_like(a) for name, a in zip(PARAMETERS, self._inputs[:5], strict=True)}
            out["centers"] = np.empty((len(self.radii), 2), np.float32)
            out["background"] = np.empty(3, np.float32)
        gradients = Gradients(*(address(out[name]) for name in (*PARAMETERS, "centers", "background")))
        failed = library().ss_rasterize_backward(
            self._workspace.handle,
            ctypes.byref(self._scene),
            ctypes.byref(self._images),
            ctypes.byref(given),
            ctypes.byref(gradients),
            self._threads,
        )
        if failed:
            raise MemoryError("not enough memory for the gradients of a rendering")
        return out
