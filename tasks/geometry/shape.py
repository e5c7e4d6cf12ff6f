"""How large a group of points is, and which way it faces."""

from __future__ import annotations

import numpy as np

from ss_flow.tasks.artifacts import Bool, Cameras, Float32, Float64, Int32
from ss_flow.tasks.geometry.cameras import centers_of

Plane = tuple[Float64, Float64]
"""A point of it [3], and its unit normal [3]."""
_FEW = 10
"""Points that a plane is not fitted to."""
_PATCHES = 50
"""Places of some points at which a plane is fitted to those round it."""


def box_diagonal(points: Float32 | Float64, trim: float = 0.005) -> float:
    """The diagonal of the box around points, less the outermost share `trim` on each side of each axis.

    points: [N, 3] world. Returns world units.
    """
    low, high = np.quantile(points, (trim, 1 - trim), axis=0)
    return float(np.linalg.norm(high - low))


def extent_of(points: Float32 | Float64) -> float:
    """How large a group of dense points [N, 3] is, world units: a fiftieth of them on each side may be strays."""
    return box_diagonal(points, 0.02)


def thinned(points: Float32 | Float64, enough: int = 2000) -> Float64:
    """Every n-th of the points [N, 3], so that at least `enough` are left, or all, but less than twice as many."""
    return points[:: max(1, len(points) // enough)].astype(np.float64)


def plane_through(points: Float64) -> Plane:
    """The plane with the least squared distances from points [N, 3]: their mean, and its unit normal."""
    centre = points.mean(axis=0)
    return centre, np.linalg.eigh((points - centre).T @ (points - centre))[1][:, 0]


def normals_of(offsets: Float32, part: Bool) -> Float64:
    """[R, 3] the normal, to either side, of the plane through some of the points [R, K, 3]: those of `part` [R, K]."""
    own = part[..., None]
    mean = (offsets * own).sum(axis=1, keepdims=True) / np.maximum(part.sum(axis=1), 1)[:, None, None]
    centred = (offsets - mean) * own
    return np.asarray(np.linalg.eigh(np.einsum("rki,rkj->rij", centred, centred))[1][:, :, 0])


def axes_in(normal: Float64) -> Float64:
    """[2, 3] two directions of length 1 in the planes with this normal [3], across each other."""
    return np.linalg.svd(normal[None])[2][1:]


def sector_of(flat: Float64, count: int) -> Int32:
    """[N] in which of so many equal directions round the origin points [N, 2] lie, from the first axis on."""
    turn = np.arctan2(flat[:, 1], flat[:, 0]) / (2 * np.pi) % 1
    return (turn * count).astype(np.int32) % count


def on_plane(points: Float64, plane: Plane, thickness: float) -> Bool:
    """[N] which points [N, 3] lie on a plane, at most so far from it."""
    centre, normal = plane
    return np.asarray(np.abs((points - centre) @ normal) <= thickness)


def refitted(points: Float64, plane: Plane, thickness: float, rounds: int) -> Plane:
    """A plane after so many fits, each to the points [N, 3] that lie on the last one; none where hardly any do."""
    for _ in range(rounds):
        near = on_plane(points, plane, thickness)
        if near.sum() < _FEW:
            break
        plane = plane_through(points[near])
    return plane


def plane_of_most(points: Float64, thickness: float, rounds: int) -> Plane:
    """The plane that most points [N, 3] lie on, which the others do not draw away: a point of it, and its unit normal.

    thickness: how far from the plane a point still lies on it. rounds: fits, each to the points on the plane of the
    last one, or to the nearer half of all points where that is more.
    """
    near = np.ones(len(points), bool)
    for _ in range(rounds):
        centre, normal = plane_through(points[near])
        distance = np.abs((points - centre) @ normal)
        near = distance <= max(thickness, float(np.median(distance)))
    return centre, normal


def planes_of_patches(points: Float64) -> list[Plane]:
    """Planes through small patches of points [N, 3]: at some 50 places, each with a 50th of the points round it."""
    from scipy.spatial import cKDTree

    count = max(len(points) // _PATCHES, min(_FEW, len(points)))
    _, near = cKDTree(points).query(points[:: max(1, len(points) // _PATCHES)], k=count)
    return [plane_through(points[rows]) for rows in np.reshape(near, (-1, count))]


def largest_plane(points: Float64, thickness: float, rounds: int) -> Plane:
    """The plane, of those through small patches of some points [N, 3], that most of the points lie on.

    thickness: how far from it a point still does. rounds: fits, each to the points on the last one.
    """
    best = max(planes_of_patches(points), key=lambda plane: on_plane(points, plane, thickness).sum())
    return refitted(points, best, thickness, rounds)


def middle_of(cameras: Cameras) -> Float64:
    """[3] the mean place of the cameras."""
    return np.asarray(centers_of(cameras.world_to_camera).mean(axis=0))


def towards(normal: Float64, centre: Float64, eye: Float64) -> Float64:
    """The normal of a plane through `centre`, on the side of `eye`."""
    return normal if (eye - centre) @ normal > 0 else -normal
