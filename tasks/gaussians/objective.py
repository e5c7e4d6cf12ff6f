"""The loss of one view and its gradients towards the rendered images."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ss_flow.tasks.artifacts import Bool, Float32, Int32
from ss_flow.tasks.gaussians.losses import photometric, weighted_l1
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
    present: Int32
    """[P] the labels that the view shows. All other labels share one channel after theirs, which should stay empty: a
    sum of absolute values that are nowhere negative is the absolute value of their sum, so the loss is the same."""
    channel: Int32
    """[h, w] which of the channels each pixel belongs to, negative where to none."""
    labelled: Float32
    """[h, w] 1 / (L * number of pixels that are not ignored) there, 0 elsewhere."""
    channel_of_label: Int32
    """[L + 1] the channel of each label; the last entry, which the label -1 finds, is -1. Empty without mask loss."""

    @property
    def num_labels(self) -> int:
        """Number of mask channels."""
        return len(self.present) + 1 if len(self.channel_of_label) else 0

    def masks(self) -> Float32:
        """The mask of each channel: [P + 1, h, w] one-hot."""
        return (self.channel == np.arange(self.num_labels)[:, None, None]).astype(np.float32)

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
        present = channel_of_label = np.zeros(0, np.int32)
        channel, labelled = np.full(size, -1, np.int32), np.zeros(size, np.float32)
        if ids is not None and num_labels:
            if ids.max(initial=-1) >= num_labels:
                raise ValueError(f"ids must be below the {num_labels} label ids, but one is {int(ids.max())}")
            present = np.unique(ids[ids >= 0]).astype(np.int32)
            channel_of_label = np.full(num_labels + 1, len(present), np.int32)
            channel_of_label[present] = np.arange(len(present))
            channel_of_label[-1] = -1
            channel = np.where(ids >= 0, channel_of_label[np.maximum(ids, 0)], -1).astype(np.int32)
            labelled = _mean(ids != -1) / np.float32(num_labels)
        return cls(
            camera,
            np.ascontiguousarray(image),
            inside.astype(np.float32),
            _mean(inside | free),
            np.where(known, depth, 1).astype(np.float32),
            _mean(known),
            present,
            channel,
            labelled,
            channel_of_label,
        )


def _mean(where: Bool) -> Float32:
    """Weights of a mean over some pixels."""
    return (where / max(int(where.sum()), 1)).astype(np.float32)


def gradients_of(
    rendered: NativePass, target: Target, weights: Weights
) -> tuple[float, tuple[Float32, Float32, Float32 | None, Float32 | None]]:
    """The loss, and its gradients towards rgb, alpha, depth and label masks (None = zero).

    Colour: L1 and SSIM inside. Alpha: 1 inside, 0 where free. Depth, inside where known: |sum of weight * (z / depth
    - 1)|, a relative error, so that the scale of the world does not matter. Masks: absolute difference between each
    rendered label and its one-hot target, a mean over pixels and labels (spec A25).
    """
    color = photometric(rendered.rgb, target.image, target.inside, weights.ssim)
    loss, towards_alpha = weighted_l1(rendered.alpha, target.inside, target.judged)
    total = color.loss + weights.alpha * loss
    towards_alpha *= np.float32(weights.alpha)
    towards_depth = towards_masks = None
    if weights.depth > 0:
        relative = rendered.depth / target.depth - rendered.alpha
        loss, towards = weighted_l1(relative, np.zeros_like(relative), target.known)
        towards *= np.float32(weights.depth)
        total += weights.depth * loss
        towards_alpha -= towards
        towards_depth = towards / target.depth
    if target.num_labels:
        weight = np.broadcast_to(target.labelled, rendered.masks.shape)
        loss, towards_masks = weighted_l1(rendered.masks, target.masks(), weight)
        towards_masks *= np.float32(weights.mask)
        total += weights.mask * loss
    return total, (color.gradient, towards_alpha, towards_depth, towards_masks)
