"""The loss of one view and its gradients towards the rendered images."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ss_flow.tasks.artifacts import Bool, Float32, Int32
from ss_flow.tasks.gaussians.library import Workspace
from ss_flow.tasks.gaussians.losses import photometric, surface
from ss_flow.tasks.gaussians.native_pass import NativePass
from ss_flow.tasks.geometry.cameras import Camera


@dataclass(frozen=True)
class Weights:
    """How much each part counts."""

    ssim: float
    alpha: float
    depth: float
    mask: float


@dataclass(frozen=True)
class Target:
    """What one view should look like, laid out for the losses."""

    camera: Camera
    image: Float32
    """[h, w, 3]."""
    inside: Float32
    """[h, w] 1 where the colour counts."""
    judged: Float32
    """[h, w] 1 / number of pixels where alpha counts."""
    depth: Float32
    """[h, w] 1 where unknown."""
    known: Float32
    """[h, w] 1 / number of inside pixels of known depth there, 0 elsewhere."""
    ids: Int32 | None
    """[h, w] the label that each pixel should show, negative where none; None without mask loss."""
    labelled: Float32 | None
    """[h, w] 1 / (number of labels * number of pixels that are not ignored) there, 0 elsewhere."""

    @property
    def pixels(self) -> int:
        """Number of pixels in the mean of the colour loss."""
        return int(self.inside.sum())

    @classmethod
    def of(
        cls,
        camera: Camera,
        image: Float32,
        inside: Bool,
        free: Bool,
        depth: Float32,
        ids: Int32 | None,
        num_labels: int,
    ) -> Target:
        """Raises ValueError when an array does not have the camera's size or an id is out of range."""
        size = (camera.height, camera.width)
        for name, array in (("inside", inside), ("free", free), ("depth", depth), ("ids", ids)):
            if array is not None and array.shape != size:
                raise ValueError(f"{name} must be {list(size)} like its camera, not {list(array.shape)}")
        if image.shape != (*size, 3) or image.dtype != np.float32:
            raise ValueError(f"image must be {[*size, 3]} float32, not {list(image.shape)} {image.dtype}")
        inside, free = np.asarray(inside, bool), np.asarray(free, bool)
        known = inside & (depth > 0) & np.isfinite(depth)
        labelled = None
        if ids is None or not num_labels:
            ids = None
        else:
            if ids.max(initial=-1) >= num_labels:
                raise ValueError(f"ids must be below the {num_labels} label ids, but one is {int(ids.max())}")
            labelled = _mean(ids != -1) / np.float32(num_labels)
            ids = np.ascontiguousarray(ids, np.int32)
        return cls(
            camera,
            np.ascontiguousarray(image),
            inside.astype(np.float32),
            _mean(inside | free),
            np.where(known, depth, 1).astype(np.float32),
            _mean(known),
            ids,
            labelled,
        )


def _mean(where: Bool) -> Float32:
    """Weights of a mean over some pixels."""
    return (where / max(int(where.sum()), 1)).astype(np.float32)


def gradients_of(
    rendered: NativePass, target: Target, weights: Weights, workspace: Workspace, threads: int
) -> tuple[float, tuple[Float32, Float32, Float32, Float32 | None]]:
    """The loss, and its gradients towards rgb, alpha, depth and mismatch (None = zero).

    Colour: L1 and SSIM inside. Alpha: 1 inside, 0 where free. Depth: inside, where known. Masks: each rendered label
    against its one-hot target, a mean over pixels and labels (spec A25).
    """
    color = photometric(
        rendered.rgb, target.image, target.inside, weights.ssim, workspace=workspace, threads=threads
    )  # fmt: skip
    rest = surface(
        rendered.alpha,
        rendered.depth,
        rendered.mismatch,
        inside=target.inside,
        judged=target.judged,
        target_depth=target.depth,
        known=target.known,
        labelled=target.labelled,
        ids=target.ids,
        alpha_weight=weights.alpha,
        depth_weight=weights.depth,
    )
    total = color.loss + weights.alpha * rest.alpha + weights.depth * rest.depth + weights.mask * rest.labels
    towards_mismatch = None if target.labelled is None else target.labelled * np.float32(weights.mask)
    return total, (color.gradient, rest.towards_alpha, rest.towards_depth, towards_mismatch)
