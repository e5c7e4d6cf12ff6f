"""Monocular depth: a network's guess from one photo, brought to the scene's scale (spec row 10, "mono+align")."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ss_flow.errors import InputError
from ss_flow.task import FileRef, Resources, task
from ss_flow.tasks.artifacts import Cameras, DepthMap, Float32, Float64, Frame
from ss_flow.tasks.geometry.alignment import fit_scale_shift
from ss_flow.tasks.geometry.cameras import camera_of, pixels_in_view
from ss_flow.tasks.geometry.images import decode_rgb, decode_valid, resampled
from ss_flow.tasks.models.onnx import imagenet_input, network_identity, open_session, run
from ss_flow.tasks.ranges import Count, Fraction, Positive


@dataclass(frozen=True)
class MonoParams:
    """How the network is asked, and its answer brought to scale."""

    input_side: Count = 518
    """Longer side of the network's input, in pixels, unless the model fixes it."""
    multiple: Count = 14
    """Both sides of the input are multiples of this (a patch of the network)."""
    max_relative: Positive = 0.05
    """A known depth counts as met when it is off by no more than this share."""
    min_points: Count = 20
    """The fewest known depths that the scale is fitted to."""
    min_met: Fraction = 0.2
    """The share of known depths that the fit must meet."""
    max_known_points: Count = 4000
    """The most known depths that are used, evenly spaced."""
    max_extrapolation: Positive = 2.0
    """Depths beyond so many times the farthest known depth are unknown."""


@task(name="capture.mono", resources=Resources(gpus=0.1), environment=network_identity)
def mono(
    frame: Frame,
    cameras: Cameras,
    known: tuple[DepthMap, ...],
    *,
    model: FileRef,
    params: MonoParams = MonoParams(),
) -> DepthMap:
    """Depth of one view by a monocular network, at the network's resolution.

    known: depth maps among which the view's own, if there is one, gives the scale (a sensor's, or a sweep's); otherwise
        the sparse points of structure from motion do.
    model: ONNX; input [1, 3, h, w] (`imagenet_input`), output [1, h, w] or [1, 1, h, w] that grows with inverse depth.
    Raises InputError when the model has another form, or too little is known to fit the scale.
    """
    predicted = _predict(frame, model, params)
    relative, depth = _known_depths(frame, cameras, known, predicted, params)
    fit = fit_scale_shift(relative, 1 / depth, params.max_relative) if len(depth) >= params.min_points else None
    if fit is None or fit[2] < params.min_met:
        met = "" if fit is None else f", of which the best fit meets {fit[2]:.0%}"
        raise InputError(
            f"the scale of the monocular depth of {frame.name} cannot be fitted to {len(depth)} known depths{met}; "
            f"{params.min_points} that agree are needed, from structure from motion or a sensor."
        )
    scale, shift, _ = fit
    inverse = scale * predicted + shift
    farthest = params.max_extrapolation * float(np.quantile(depth, 0.98))
    keep = inverse > 1 / farthest
    height, width = predicted.shape
    if frame.valid.size:
        keep &= resampled(decode_valid(frame), height, width)
    return DepthMap(frame.name, np.where(keep, 1 / np.where(keep, inverse, 1), 0).astype(np.float32), "mono")


def _predict(frame: Frame, model: FileRef, params: MonoParams) -> Float32:
    import cv2

    session = open_session(model)
    wanted = session.get_inputs()[0]
    if len(session.get_inputs()) != 1 or len(wanted.shape) != 4:
        raise InputError(f"{model.path} does not take one image [1, 3, h, w]; a monocular depth model is expected.")
    fixed_height, fixed_width = (n if isinstance(n, int) else 0 for n in wanted.shape[2:])
    scale = params.input_side / max(frame.width, frame.height)
    height = fixed_height or _rounded(frame.height * scale, params.multiple)
    width = fixed_width or _rounded(frame.width * scale, params.multiple)
    rgb = decode_rgb(frame)
    shrinks = width < frame.width
    resized = cv2.resize(rgb, (width, height), interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_CUBIC)
    output = np.asarray(run(session, {wanted.name: imagenet_input(resized)})[0], np.float32)
    if output.ndim not in (3, 4) or output.size != output.shape[-1] * output.shape[-2]:
        raise InputError(
            f"{model.path} gives an output of shape {output.shape}; [1, h, w] is expected of a depth model."
        )
    return output.reshape(output.shape[-2:])


def _rounded(length: float, multiple: int) -> int:
    return max(multiple, round(length / multiple) * multiple)


def _known_depths(
    frame: Frame, cameras: Cameras, known: tuple[DepthMap, ...], predicted: Float32, params: MonoParams
) -> tuple[Float32, Float64]:
    height, width = predicted.shape
    own = next((m.depth for m in known if m.name == frame.name), None)
    if own is not None and np.count_nonzero(own) >= params.min_points:
        v, u = np.nonzero(own)
        depth = own[v, u].astype(np.float64)
        rows = (v + 0.5) * height / own.shape[0]
        columns = (u + 0.5) * width / own.shape[1]
    else:
        camera = camera_of(cameras, cameras.names.index(frame.name)).scaled(width, height)
        _, columns, rows, depth = pixels_in_view(cameras.sparse_points, camera)
    step = max(1, -(-len(depth) // params.max_known_points))
    sampled = predicted[rows.astype(np.intp)[::step], columns.astype(np.intp)[::step]]
    return sampled, depth[::step]
