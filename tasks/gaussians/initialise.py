"""Sets of Gaussians: made from points, joined, picked, measured."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields, replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from ss_flow.running import cores
from ss_flow.tasks.artifacts import Float32, Float64, Gaussians, Int32, UInt8
from ss_flow.tasks.geometry.shape import box_diagonal

G = TypeVar("G", bound=Gaussians)

SH_ZERO = 0.28209479177387814
"""The constant basis function, sqrt(1 / (4 pi))."""
_NEIGHBOURS = 12
"""Centres that tell a surface's normal, the Gaussian's own among them."""

NO_GAUSSIANS = Gaussians(
    means=np.zeros((0, 3), np.float32),
    quaternions=np.zeros((0, 4), np.float32),
    log_scales=np.zeros((0, 3), np.float32),
    opacity_logits=np.zeros(0, np.float32),
    sh=np.zeros((0, 1, 3), np.float32),
    instance_id=np.zeros(0, np.int32),
    instance_conf=np.zeros(0, np.float32),
    part_id=np.zeros(0, np.int32),
)


def initialise(
    points: Float32,
    colors: UInt8,
    instance_id: int | Int32,
    confidence: float | Float32,
    part_id: int | Int32 = 0,
    *,
    opacity: float = 0.1,
) -> Gaussians:
    """Round Gaussians at points (spec P1).

    points: [N, 3] world, N >= 1. colors: [N, 3] RGB. instance_id, confidence, part_id: one for all, or [N].
    The standard deviation is the root of the mean squared distance to the three nearest other points.
    Raises ValueError when the shapes do not fit.
    """
    n = len(points)
    if n == 0 or points.shape != (n, 3) or colors.shape != (n, 3):
        raise ValueError(f"points {points.shape} and colors {colors.shape} must both be [N, 3] with N >= 1")
    spread = np.full(n, 0.01)
    if n > 1:
        spread = neighbour_spread(points)
        # Coincident points would give a scale of 0, a logarithm without end.
        spread = np.maximum(spread, 1e-3 * max(float(np.median(spread)), 1e-6))
    return Gaussians(
        means=np.ascontiguousarray(points, np.float32),
        quaternions=np.tile(np.array([1, 0, 0, 0], np.float32), (n, 1)),
        log_scales=np.repeat(np.log(spread).astype(np.float32)[:, None], 3, axis=1),
        opacity_logits=np.full(n, np.log(opacity / (1 - opacity)), np.float32),
        sh=((colors / 255.0 - 0.5) / SH_ZERO).astype(np.float32)[:, None],
        instance_id=np.broadcast_to(np.asarray(instance_id, np.int32), (n,)).copy(),
        instance_conf=np.broadcast_to(np.asarray(confidence, np.float32), (n,)).copy(),
        part_id=np.broadcast_to(np.asarray(part_id, np.int32), (n,)).copy(),
    )


def neighbour_spread(points: Float32) -> Float64:
    """[N] the root of the mean squared distance of each point to the three nearest others. points: [N, 3], N >= 2."""
    from scipy.spatial import cKDTree

    near, _ = cKDTree(points).query(points, k=min(4, len(points)), workers=cores())
    return np.asarray(np.sqrt(np.square(np.asarray(near)[:, 1:]).mean(axis=1)))


def laid_flat(gaussians: Gaussians, thickness: float) -> Gaussians:
    """Round Gaussians on a surface as discs that lie in it.

    The surface's normal at a centre is the direction in which its nearest other centres spread least (Hoppe et al.
    1992). thickness: standard deviation along it, as a share of that along the surface. Round Gaussians reach as far
    off the surface as along it, which no view that looks straight at it can tell. Fewer than four stay as they are.
    """
    from scipy.spatial import cKDTree

    if len(gaussians) < 4:
        return gaussians
    points = gaussians.means.astype(np.float64)
    _, near = cKDTree(points).query(points, k=min(_NEIGHBOURS, len(points)), workers=cores())
    around = points[near] - points[near].mean(axis=1, keepdims=True)
    _, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", around, around))
    normal = axes[:, :, 0] * np.where(axes[:, 2:, 0] < 0, -1, 1)
    # The shortest turn from z to the normal.
    turn = np.stack([1 + normal[:, 2], -normal[:, 1], normal[:, 0], np.zeros(len(points))], axis=1)
    turn /= np.linalg.norm(turn, axis=1, keepdims=True)
    flat = gaussians.log_scales + np.array([0, 0, np.log(thickness)], np.float32)
    return replace(gaussians, quaternions=turn.astype(np.float32), log_scales=flat)


def with_sh_degree(gaussians: G, degree: int) -> G:
    """The same Gaussians with room for (at least) a degree: missing coefficients are 0."""
    missing = (degree + 1) ** 2 - gaussians.sh.shape[1]
    if missing <= 0:
        return gaussians
    return replace(gaussians, sh=np.pad(gaussians.sh, ((0, 0), (0, missing), (0, 0))))


def concatenate(parts: Sequence[G]) -> G:
    """All rows of several sets, one after the other; lower SH degrees are filled with 0. Needs at least one set."""
    degree = max(p.sh_degree for p in parts)
    same = [with_sh_degree(p, degree) for p in parts]
    return replace(same[0], **{f.name: np.concatenate([getattr(p, f.name) for p in same]) for f in fields(same[0])})


def select(gaussians: G, rows: NDArray[np.bool_] | NDArray[np.integer]) -> G:
    """Some rows, by mask or by index."""
    return replace(gaussians, **{f.name: getattr(gaussians, f.name)[rows] for f in fields(gaussians)})


def log_lengths(gaussians: Gaussians) -> Float32:
    """[N] how long Gaussians are in the instance that each is part of: the median of the logarithm of their longest
    standard deviations, which are in world units."""
    longest = gaussians.log_scales.max(axis=1)
    lengths = np.empty(len(gaussians), np.float32)
    for instance_id in np.unique(gaussians.instance_id):
        own = gaussians.instance_id == instance_id
        lengths[own] = np.median(longest[own])
    return lengths


def extents(gaussians: Gaussians) -> Float32:
    """[N] the size of the instance that each Gaussian is part of, world units: the diagonal of its box."""
    sizes = np.zeros(len(gaussians), np.float32)
    for instance_id in np.unique(gaussians.instance_id):
        own = gaussians.instance_id == instance_id
        sizes[own] = box_diagonal(gaussians.means[own])
    # An instance of a single Gaussian is as large as that.
    return np.maximum(sizes, np.exp(gaussians.log_scales.max(axis=1)))
