"""SPZ, version 3: a gzip stream of about a tenth of the PLY's size."""

from __future__ import annotations

import gzip
import struct

import numpy as np

from ss_flow.errors import InputError
from ss_flow.task import task
from ss_flow.tasks.artifacts import Float32, Gaussians, UInt8
from ss_flow.tasks.deliver.export.content import FileContent, base_colors, levels, smallest_three
from ss_flow.tasks.gaussians.initialise import SH_ZERO

_MAGIC = 0x5053474E
_VERSION = 3
_FRACTION_BITS = 12
"""Of coordinates up to a unit and more, as far as there is room; one more for each time that the largest halves."""
_MOST_FRACTION_BITS = 23
_FARTHEST = (1 << 23) - 1
"""Largest coordinate in steps of the fixed point."""
_COLOR_SCALE = 0.15
_STEPS_OF_DEGREE = (0, 8, 16, 16)
"""The levels of a coefficient, of 256 for -1..1, that count as one: 5 bits for degree 1, 4 above."""
_FLIPS = np.array([-1, -1, 1, -1, 1, 1, -1, 1, -1, 1, -1, -1, 1, -1, 1], np.float32)
"""What becomes of the harmonics of degree 1 to 3 where y and z change their signs."""


@task(name="deliver.export.spz")
def spz(gaussians: Gaussians) -> FileContent:
    """Positions of 24 bits in fixed point, scales, colour and opacity of 8, rotations of 10 bits a component; higher
    harmonics of 5 and 4 bits in -1..1. The format's axes are right, up, back; ours count as right, down, forward.

    Raises InputError where a coordinate is too large for the fixed point (beyond 8 million units).
    """
    farthest = float(np.abs(gaussians.means).max(initial=0))
    size = max(farthest, 1e-9)
    fine = _FRACTION_BITS + max(0, -int(np.floor(np.log2(size))))
    bits = min(fine, _MOST_FRACTION_BITS, int(np.floor(np.log2(_FARTHEST / size))))
    if bits < 0:
        raise InputError(f"a Gaussian lies {farthest:.3g} units from the origin; SPZ holds coordinates to {_FARTHEST}.")
    degree = gaussians.sh_degree
    header = struct.pack("<IIIBBBB", _MAGIC, _VERSION, len(gaussians), degree, bits, 0, 0)
    turned = gaussians.means.astype(np.float64) * (1, -1, -1)
    fixed = np.rint(turned * (1 << bits)).astype("<i4")
    positions = fixed.view(np.uint8).reshape(-1, 3, 4)[:, :, :3]
    alphas = levels(gaussians.opacities, 8).astype(np.uint8)
    base = (base_colors(gaussians) - 0.5) / SH_ZERO
    colors = np.clip(np.rint((base * _COLOR_SCALE + 0.5) * 255), 0, 255).astype(np.uint8)
    scales = np.clip(np.rint((gaussians.log_scales.astype(np.float64) + 10) * 16), 0, 255).astype(np.uint8)
    parts = [positions, alphas, colors, scales, _rotations(gaussians.quaternions), _harmonics(gaussians.sh, degree)]
    body = b"".join(np.ascontiguousarray(part).tobytes() for part in parts)
    return FileContent.of(gzip.compress(header + body, mtime=0))


def _rotations(quaternions: Float32) -> np.ndarray:
    """[N] the three smaller components, of order x y z w, as sign and 9 bits each, and which was left out."""
    largest, others = smallest_three(quaternions[:, [1, 2, 3, 0]] * np.array([1, -1, -1, 1], np.float32))
    packed = largest.astype(np.uint32)
    for component in others.T:
        size = np.floor(511 * np.abs(component) * 2**0.5 + 0.5).clip(0, 511).astype(np.uint32)
        packed = packed << np.uint32(10) | (component < 0).astype(np.uint32) << np.uint32(9) | size
    return packed.astype("<u4")


def _harmonics(sh: Float32, degree: int) -> UInt8:
    """[N, K - 1, 3] the coefficients above degree 0."""
    steps = np.concatenate([[_STEPS_OF_DEGREE[d]] * (2 * d + 1) for d in range(1, degree + 1)] or [[]])[:, None]
    turned = sh[:, 1:].astype(np.float64) * _FLIPS[: sh.shape[1] - 1, None]
    whole = np.rint(turned * 128) + 128
    return np.clip(np.floor((whole + steps // 2) / np.maximum(steps, 1)) * steps, 0, 255).astype(np.uint8)
