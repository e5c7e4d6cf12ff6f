"""Real spherical harmonics of the colour, and how they turn with an object.

The basis is that of 3DGS (and of native/harmonics.h): orthonormal, with the Condon-Shortley phase, ordered by degree l
and within it by m = -l .. l; degrees 0 to 3.
"""

from __future__ import annotations

import numpy as np

from ss_flow.tasks.artifacts import Float32, Float64
from ss_flow.tasks.geometry.sampling import sphere

_SAMPLES = 32


def basis(degree: int, directions: Float64) -> Float64:
    """The basis functions up to a degree: [M, (degree + 1)^2]; directions: [M, 3] of unit length."""
    x, y, z = directions.T
    xx, yy, zz = x * x, y * y, z * z
    functions = [np.full(len(directions), np.sqrt(1 / (4 * np.pi)))]
    if degree > 0:
        k = np.sqrt(3 / (4 * np.pi))
        functions += [-k * y, k * z, -k * x]
    if degree > 1:
        k, k0 = np.sqrt(15 / (4 * np.pi)), np.sqrt(5 / (16 * np.pi))
        functions += [k * x * y, -k * y * z, k0 * (2 * zz - xx - yy), -k * x * z, k / 2 * (xx - yy)]
    if degree > 2:
        a, b, c, d = (np.sqrt(n / np.pi) for n in (35 / 32, 105 / 4, 21 / 32, 7 / 16))
        functions += [
            -a * y * (3 * xx - yy),
            b * x * y * z,
            -c * y * (4 * zz - xx - yy),
            d * z * (2 * zz - 3 * xx - 3 * yy),
            -c * x * (4 * zz - xx - yy),
            b / 2 * z * (xx - yy),
            -a * x * (xx - 3 * yy),
        ]
    return np.stack(functions, axis=1)


def rotated(sh: Float32, rotation: Float64) -> Float32:
    """The coefficients of the same colours on an object that was turned.

    sh: [N, (degree + 1)^2, 3]. rotation: [3, 3], from the old to the new orientation, in world coordinates. The colour
    seen along a direction d is then what was seen along rotation^T d. Each degree turns within itself: its matrix
    (Wigner's, for the real basis) is what maps the basis at turned-back directions to the basis at directions, found
    from more directions than it has rows; it is exact to the rounding of float64.
    """
    degree = round(sh.shape[1] ** 0.5) - 1
    directions = sphere(_SAMPLES)
    there, back = basis(degree, directions), basis(degree, directions @ rotation)
    turned = sh.astype(np.float64)
    for band in range(1, degree + 1):
        own = slice(band**2, (band + 1) ** 2)
        matrix = np.linalg.lstsq(there[:, own], back[:, own], rcond=None)[0]
        turned[:, own] = np.einsum("ij,njc->nic", matrix, sh[:, own].astype(np.float64))
    return turned.astype(np.float32)
