"""Rendering without gradients, arrays in and arrays out."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ss_flow.running import cores
from ss_flow.tasks.artifacts import Bool, Float32, Gaussians, Int32
from ss_flow.tasks.gaussians.initialise import select
from ss_flow.tasks.gaussians.native_pass import PARAMETERS, NativePass, Settings
from ss_flow.tasks.gaussians.rasterize import device_for
from ss_flow.tasks.geometry.cameras import Camera

OPAQUE_LOGIT = 20.0
"""Opacity 1 in float32."""
_MASK_BYTES = 100_000_000
"""Of the mask images that are held at once: fewer take more renderings, each of which bins all Gaussians again."""


class Rendering(NamedTuple):
    """One rendering."""

    rgb: Float32
    """[H, W, 3] composited over the background; may exceed 1."""
    alpha: Float32
    """[H, W]."""
    depth: Float32
    """[H, W] sum of weight * z; divide by alpha for the expected depth."""
    label_masks: Float32
    """[L, H, W] sum of the weights of each label's Gaussians."""
    top_contributor: Int32
    """[H, W] row of the Gaussian with the largest weight T * alpha, -1 = none; all -1 without `winners`."""
    visible: Bool
    """[N] reaches the image."""
    max_contribution: Float32
    """[N] largest weight over the image; zeros without `winners`."""


def channels_of(instance_id: Int32, label_ids: Sequence[int]) -> Int32:
    """The mask channel of each Gaussian: the place of its id in `label_ids`, -1 where it is not there."""
    channels = np.full(len(instance_id), -1, np.int32)
    for channel, label in enumerate(label_ids):
        channels[instance_id == label] = channel
    return channels


def render(
    gaussians: Gaussians,
    camera: Camera,
    *,
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
    opaque: bool = False,
    label_ids: Sequence[int] = (),
    winners: bool = True,
) -> Rendering:
    """Render Gaussians, on CUDA where pictures of this size are drawn faster there and it has the memory.

    opaque: every opacity 1, with the falloff kept (spec P2). label_ids: instance ids, one mask channel each. winners:
    whether `top_contributor` and `max_contribution` are asked for, which take long on CUDA.
    Raises ValueError when a parameter is not finite.
    """
    if opaque:
        gaussians = replace(gaussians, opacity_logits=np.full(len(gaussians), OPAQUE_LOGIT, np.float32))
    parameters = tuple(np.ascontiguousarray(getattr(gaussians, name), np.float32) for name in PARAMETERS)
    for name, array in zip(PARAMETERS, parameters, strict=True):
        if not np.isfinite(array).all():
            raise ValueError(f"{name} holds values that are not finite")
    labels = channels_of(gaussians.instance_id, label_ids) if len(label_ids) else None
    red, green, blue = background
    settings = Settings((red, green, blue), len(label_ids), gaussians.sh_degree, winners)
    # Nothing at all is drawn on the CPU.
    device = device_for(camera.width * camera.height) if len(gaussians) else "cpu"
    if device != "cpu":
        from ss_flow.tasks.gaussians.torch_render import draw

        with suppress(MemoryError):
            there = draw(device, parameters, labels, camera, settings)
            return Rendering(
                there.rgb.cpu().numpy(),
                there.alpha.cpu().numpy(),
                there.depth.cpu().numpy(),
                there.label_masks.cpu().numpy(),
                there.top_contributor.cpu().numpy(),
                there.radii.cpu().numpy() > 0,
                there.max_contribution.cpu().numpy(),
            )
    done = NativePass(parameters, labels, camera, settings, threads=cores())  # type: ignore[arg-type]
    none = np.full(done.alpha.shape, -1, np.int32), np.zeros(len(gaussians), np.float32)
    top, strongest = none if done.top is None or done.strongest is None else (done.top, done.strongest)
    return Rendering(done.rgb, done.alpha, done.depth, done.masks, top, done.radii > 0, strongest)


class ShownInstances(NamedTuple):
    """What a view shows of the instances; an instance's weight is the sum of its Gaussians' weights T * alpha."""

    ids: NDArray[np.uint16]
    """[H, W] the one with the largest weight, 0 = the background, or nothing is there."""
    weight: Float32
    """[H, W] its weight."""
    of_known: Float32
    """[H, W] that of the instance which is known in each pixel; zeros where none was given."""
    alpha: Float32
    """[H, W] of all together."""


def shown_instances(gaussians: Gaussians, camera: Camera, known: NDArray[np.uint16] | None = None) -> ShownInstances:
    """The instance that weighs most in each pixel.

    known: [H, W] ids that are asked about besides. Many instances are rendered some at a time, in as little memory as
    that takes.
    """
    ids = np.zeros((camera.height, camera.width), np.uint16)
    heaviest, of_known = np.zeros(ids.shape, np.float32), np.zeros(ids.shape, np.float32)
    at_once = max(1, _MASK_BYTES // heaviest.nbytes)
    present = np.unique(gaussians.instance_id)
    few = len(present) <= at_once  # so that one rendering shows them all
    whole = render(gaussians, camera, label_ids=present.tolist() if few else (), winners=False)
    shown = gaussians if few else select(gaussians, whole.visible)
    present = np.unique(shown.instance_id)
    for start in range(0, len(present), at_once):
        some = present[start : start + at_once].tolist()
        drawn = whole if few else render(shown, camera, label_ids=some, winners=False)
        for instance, weight in zip(some, drawn.label_masks, strict=True):
            ids[weight > heaviest] = instance
            np.maximum(heaviest, weight, out=heaviest)
            if known is not None:
                np.copyto(of_known, weight, where=known == instance)
    return ShownInstances(ids, heaviest, of_known, whole.alpha)


class Shares(NamedTuple):
    """How much Gaussians show where an image has some id: sums of weights T * alpha, those above 0."""

    row: Int32
    """[A] of the Gaussian."""
    id: Int32
    """[A] ascending; rows of one id ascend."""
    weight: Float32
    """[A] over the pixels of that id."""


def shares(gaussians: Gaussians, camera: Camera, ids: Int32) -> Shares:
    """How much each Gaussian shows in the pixels of each id.

    ids: [H, W] of the camera's size; pixels below 0 count for none. Always on the CPU: gsplat tells it by gradients
    alone, three ids at once.
    """
    grey = replace(gaussians, sh=np.zeros((len(gaussians), 1, 3), np.float32))  # no colour matters
    parameters = tuple(np.ascontiguousarray(getattr(grey, name), np.float32) for name in PARAMETERS)
    settings = Settings((0.0, 0.0, 0.0), 0, 0, winners=False)
    done = NativePass(parameters, None, camera, settings, threads=cores())  # type: ignore[arg-type]
    rows, found, weights = done.shares(ids)
    key, place = np.unique(found.astype(np.int64) * len(gaussians) + rows, return_inverse=True)
    one, row = np.divmod(key, max(len(gaussians), 1))
    return Shares(row.astype(np.int32), one.astype(np.int32), np.bincount(place, weights, len(key)).astype(np.float32))
