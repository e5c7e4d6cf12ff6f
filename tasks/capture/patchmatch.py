"""PatchMatch multi-view stereo: the depth of one photo from others, from a first guess at each pixel.

Slanted planes per pixel, propagated and varied on a checkerboard (Galliani et al. 2015), matched by the correlation of
windows weighted by gray level (Schoenberger et al. 2016) in the best of several photos, and held together by what
neighbours have (Besse et al. 2012). The loops are in native/patchmatch.cpp beside the rasterizer.
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from ss_flow.tasks.artifacts import Float32, Float64
from ss_flow.tasks.gaussians.library import StereoPhoto, StereoProblem, instruction_set, library
from ss_flow.tasks.geometry.cameras import Camera
from ss_flow.tasks.geometry.images import inverse_depth
from ss_flow.tasks.geometry.plane_sweep import SweepView, pixel_transfer
from ss_flow.tasks.processor import on_this_processor
from ss_flow.tasks.ranges import Count, NonNegative, Positive, Range

_STEP = 2
_STEEPEST = 5.0
"""Largest change of inverse depth, as a share of it, over one focal length: surfaces seen at 11 degrees."""


@dataclass(frozen=True)
class PatchMatchParams:
    """How planes are matched and varied."""

    turns: Count = 4
    """How often every pixel tries its neighbours' planes and changes of its own."""
    best: Annotated[int, Range(1, 8)] = 2
    """Out of the other photos, so many that match a pixel best decide."""
    window: Count = 11
    """Side of the window that is compared, in pixels, of which every second counts; even is one more."""
    gray_scale: Positive = 15.0
    """Pixels of a window whose gray level differs by so much from the middle's count 1/e."""
    smoothness: NonNegative = 0.15
    """Price of a plane that none of the neighbours continues (matching costs lie in 0..1)."""
    smooth_scale: Positive = 0.02
    """Inverse depths that differ by this share, or more, do not continue one another."""
    consistency: NonNegative = 0.2
    """Price of a plane that the other photo's depth contradicts by 3 pixels or more."""


@dataclass(frozen=True)
class Source:
    """Another photo, and what is known of its depth."""

    view: SweepView
    depth: Float32
    """[h, w] z-depth in world units at the photo's size, 0 where unknown."""


def stereo_identity() -> dict[str, str]:
    """What the result depends on besides its inputs: the instruction set of the library that the rasterizer is in."""
    return {"rasterizer": on_this_processor(instruction_set())}


def patchmatch(
    reference: SweepView, sources: Sequence[Source], guess: Float32, seed: int, params: PatchMatchParams
) -> tuple[Float32, Float32]:
    """The depth of a photo, and what matching costs at it.

    guess: [H, W] z-depth > 0 in world units to start from, at the photo's size; the result lies in its range.
    Returns [H, W] z-depth, and [H, W] cost: (1 - correlation) / 2 plus `consistency` where depths contradict, 0.5 where
    no photo sees the pixel's window. Raises MemoryError.
    """
    planes = np.zeros((3, *guess.shape), np.float32)
    np.reciprocal(guess, out=planes[0])
    cost = improved(reference, sources, planes, seed, params)
    return 1 / planes[0], cost


def improved(
    reference: SweepView, sources: Sequence[Source], planes: Float32, seed: int, params: PatchMatchParams
) -> Float32:
    """Improve the planes of all pixels in place; return their cost, [H, W].

    planes: [3, H, W] inverse depth and its gradient over the image, along x and y.
    """
    height, width = planes.shape[1:]
    held = [(quads(s.view.gray), s.view.valid.astype(np.uint8), inverse_depth(s.depth)) for s in sources]
    photos = (StereoPhoto * len(sources))(
        *(
            StereoPhoto(
                *(array.ctypes.data for array in arrays), *s.view.gray.shape[::-1], *_there_and_back(reference, s.view)
            )
            for arrays, s in zip(held, sources, strict=True)
        )
    )
    own, cost = quads(reference.gray), np.empty((height, width), np.float32)
    problem = StereoProblem(
        own.ctypes.data,
        ctypes.addressof(photos),
        planes.ctypes.data,
        cost.ctypes.data,
        *(width, height, len(sources), min(params.best, len(sources)), params.window // 2, _STEP, params.turns),
        seed,
        *(planes[0].min(), planes[0].max(), _STEEPEST / reference.camera.fx),
        *(params.gray_scale, params.smoothness, params.smooth_scale, params.consistency),
    )
    if library().ss_patchmatch(ctypes.byref(problem)):
        raise MemoryError("not enough memory for the depth of a photo")
    return cost


def quads(gray: Float32) -> np.ndarray:
    """[H, W] uint32: each pixel's gray level, its right, its lower and its lower right neighbour's, from the lowest
    byte up; what bilinear interpolation needs, in one read."""
    rounded = np.pad(np.clip(np.rint(gray), 0, 255).astype(np.uint32), ((0, 1), (0, 1)), mode="edge")
    joined = rounded[:-1, :-1] | rounded[:-1, 1:] << 8 | rounded[1:, :-1] << 16 | rounded[1:, 1:] << 24
    return np.ascontiguousarray(joined)


def _there_and_back(reference: SweepView, source: SweepView) -> list[ctypes.Array[ctypes.c_float]]:
    def floats(matrix: Float64) -> ctypes.Array[ctypes.c_float]:
        return (ctypes.c_float * matrix.size)(*matrix.ravel())

    def way(start: Camera, end: Camera) -> list[ctypes.Array[ctypes.c_float]]:
        return [floats(matrix) for matrix in pixel_transfer(start, end)]

    return [*way(reference.camera, source.camera), *way(source.camera, reference.camera)]
