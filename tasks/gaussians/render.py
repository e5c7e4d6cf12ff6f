"""Rendering without gradients, arrays in and arrays out."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ss_flow.running import cores
from ss_flow.tasks.artifacts import Bool, Float32, Gaussians, Int32
from ss_flow.tasks.gaussians.initialise import SH_ZERO
from ss_flow.tasks.gaussians.native_pass import PARAMETERS, NativePass, Settings
from ss_flow.tasks.gaussians.rasterize import device_here
from ss_flow.tasks.geometry.cameras import Camera

OPAQUE_LOGIT = 20.0
"""Opacity 1 in float32."""


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
    """Render Gaussians, on CUDA where Gaussians are trained there and it has the memory.

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
    if _device(gaussians) != "cpu":
        from ss_flow.tasks.gaussians.torch_render import draw

        with suppress(MemoryError):
            there = draw(_device(gaussians), parameters, labels, camera, settings)
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


def weights_shown(gaussians: Gaussians, camera: Camera, ids: Int32) -> tuple[Float32, Float32]:
    """[N] the sum of each Gaussian's weights T * alpha over the image, and over the pixels of its own instance.

    ids: [H, W] the instance that each pixel shows, of the camera's size. Always on the CPU.
    """
    parameters = tuple(np.ascontiguousarray(getattr(gaussians, name), np.float32) for name in PARAMETERS)
    labels, settings = np.ascontiguousarray(gaussians.instance_id, np.int32), Settings((0.0, 0.0, 0.0), 0, 0, False)
    return NativePass(parameters, labels, camera, settings, ids=ids, threads=cores()).shares()  # type: ignore[arg-type]


def weights_by_id(gaussians: Gaussians, camera: Camera, ids: NDArray[np.integer]) -> Iterator[tuple[int, Float32]]:
    """For each id of an image, ascending: the sum of each Gaussian's weights T * alpha over the id's pixels: [N].

    ids: [H, W] integers from 0 on, of the camera's size; pixels below 0 count for none. A rendering is linear in the
    colours, so these sums are its gradient towards them, where the gradient of the image is 1 in the id's pixels; the
    three channels hold three ids at once.
    """
    grey = replace(gaussians, sh=np.zeros((len(gaussians), 1, 3), np.float32))  # no colour is cut off at 0
    parameters = tuple(np.ascontiguousarray(getattr(grey, name), np.float32) for name in PARAMETERS)
    weigh = _weigher(_device(grey), parameters, camera, Settings((0.0, 0.0, 0.0), 0, 0, winners=False))
    found = np.unique(ids[ids >= 0]).tolist()
    for start in range(0, len(found), 3):
        some = found[start : start + 3]
        towards = np.zeros((camera.height, camera.width, 3), np.float32)
        for channel, one in enumerate(some):
            towards[..., channel] = ids == one
        weights = weigh(towards) / np.float32(SH_ZERO)
        for channel, one in enumerate(some):
            yield one, weights[:, channel]


def _weigher(
    device: str, parameters: tuple[Float32, ...], camera: Camera, settings: Settings
) -> Callable[[Float32], Float32]:
    """What gives the gradient towards the constant colours [N, 3] for one towards the picture [H, W, 3]."""
    if device != "cpu":
        from ss_flow.tasks.gaussians.torch_render import weigher

        with suppress(MemoryError):
            return weigher(device, parameters, camera, settings)
    drawn = NativePass(parameters, None, camera, settings, threads=cores())  # type: ignore[arg-type]
    return lambda towards: drawn.backward(towards, None, None, None)["sh"][:, 0]


def _device(gaussians: Gaussians) -> str:
    """Where to draw them; nothing at all is drawn on the CPU."""
    return device_here() if len(gaussians) else "cpu"
