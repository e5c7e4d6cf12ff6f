"""Where a sensor measures nothing: the depth that several photos agree on.

Depth cameras are blind to what is black, shiny or far, and that is half of a room: chairs, screens, doors, the next
room. Photos show it, and the sensor's own depth around it tells where to look. What a sensor knows stays as it is.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ss_flow.task import task
from ss_flow.tasks.artifacts import DepthMap, Float32, Frame, Int32
from ss_flow.tasks.geometry.cameras import Camera
from ss_flow.tasks.geometry.holes import close_holes
from ss_flow.tasks.geometry.images import decode_valid, resampled, size_within
from ss_flow.tasks.ranges import Fraction


@dataclass(frozen=True)
class CompletionParams:
    """Which views of a depth sensor are completed."""

    below: Fraction = 0.9
    """Share of a photo's pixels, below which a sensor's depth is completed by comparing photos; 0 = it never is. Holes
    of at most two pixels across within one surface count as known."""


@dataclass(frozen=True)
class Gaps:
    """Which views' depth a sensor knows too little of."""

    view: Int32
    """[G] their places in the scene's order, ascending."""


@task(name="capture.gaps")
def gaps(
    frames: tuple[Frame, ...], depths: tuple[DepthMap, ...], *, params: CompletionParams = CompletionParams()
) -> Gaps:
    """The views of whose valid pixels a sensor knows less than `below`; depths: the sensor's, of all frames.

    Thin holes, as a warp leaves them between known pixels, are nothing that the sensor is blind to.
    """
    known = np.array([_known(frame, depth.depth) for frame, depth in zip(frames, depths, strict=True)])
    return Gaps(np.flatnonzero(known < params.below).astype(np.int32))


@task(name="capture.sized")
def sized(sensor: DepthMap, camera: Camera, *, max_side: int) -> DepthMap:
    """A sensor's depth at the size at which photos are compared: a longer side of at most `max_side` pixels."""
    width, height = size_within(max_side, camera.width, camera.height)
    return DepthMap(sensor.name, resampled(sensor.depth, height, width), sensor.source)


@task(name="capture.completed")
def completed(sensor: DepthMap, found: DepthMap) -> DepthMap:
    """A sensor's depth, and what was found where it has none; at the sensor's size."""
    other = resampled(found.depth, *sensor.depth.shape)
    return DepthMap(sensor.name, np.where(sensor.depth > 0, sensor.depth, other), "completed")


def _known(frame: Frame, depth: Float32) -> float:
    """Share of a frame's valid pixels whose depth is known, or would be without thin holes."""
    valid = resampled(decode_valid(frame), *depth.shape)
    return float((close_holes(depth)[valid] > 0).mean()) if valid.any() else 1.0
