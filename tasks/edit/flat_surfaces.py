"""The flat surfaces among points: planes by RANSAC (Fischler & Bolles 1981), each as far as it hangs together."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ss_flow.tasks.artifacts import Bool, Float64, Int32, PointCloud
from ss_flow.tasks.geometry.shape import Plane, on_plane, refitted

_COVERED = 0.5
"""Share of the convex hull of a plane's points that must hold points; what has less is no surface."""
_MOST_PLANES = 4
"""Of each place that something left."""
_TRIALS = 300
"""Planes that are tried, each through three points."""
_FEWEST = 30
"""Points below which nothing is called a plane."""
_ENOUGH = 20_000
"""At least so many points, and less than twice as many, tell which of them is best."""


@dataclass(frozen=True)
class FlatSurface:
    """A connected piece of a plane, by the points on it."""

    centre: Float64
    normal: Float64
    axes: Float64
    """[2, 3] unit, in the plane."""
    rows: Int32
    """[I] its points, as rows of the dense points."""
    flat: Float64
    """[I, 2] where these lie in the plane."""

    def flattened(self, places: Float64) -> Float64:
        """[M, 2] where points [M, 3] fall on the plane."""
        return (places - self.centre) @ self.axes.T


def flat_surfaces(points: PointCloud, rows: Int32, thickness: float) -> list[FlatSurface]:
    """The planes that some of the dense points lie on, the largest first; each point on one of them at most.

    rows: [R] of these points. thickness: how far from a plane a point still lies on it, world units.
    """
    places, spacing = points.points[rows].astype(np.float64), points.spacing_of(rows)
    rng = np.random.default_rng(0)
    rest = np.arange(len(places), dtype=np.int32)
    least = max(_FEWEST, len(places) // 20)
    found: list[FlatSurface] = []
    for _ in range(_MOST_PLANES):
        if len(rest) < least:
            break
        own = places[rest]
        best = _through_three(own, thickness, rng)
        if best is None:
            break
        centre, normal = refitted(own, best, thickness, 2)
        near = on_plane(own, (centre, normal), thickness)
        if near.sum() < least:
            break
        axes = np.linalg.svd(own[near] - centre, full_matrices=False)[2][:2]
        flat = (own[near] - centre) @ axes.T
        together = _largest_piece(flat, spacing)
        piece = flat[together]
        if piece[:, 1].std() > thickness and _coverage(piece, spacing) >= _COVERED:
            found.append(FlatSurface(centre, normal, axes, rows[rest[near][together]], piece))
        rest = rest[~near]
    return found


def _through_three(places: Float64, thickness: float, rng: np.random.Generator) -> Plane | None:
    """Of planes through three of some points [N, 3] the one that most points lie on; None where none has a normal."""
    sample = places[:: max(1, len(places) // _ENOUGH)]
    best, support = None, 0
    for triple in rng.integers(0, len(places), (_TRIALS, 3)):
        a, b, c = places[triple]
        normal = np.cross(b - a, c - a)
        length = float(np.linalg.norm(normal))
        if length == 0:
            continue
        plane = a, normal / length
        count = int(on_plane(sample, plane, thickness).sum())
        if count > support:
            best, support = plane, count
    return best


def _largest_piece(flat: Float64, spacing: float) -> Bool:
    """[I] which points [I, 2] lie on the largest connected piece: a plane also cuts other surfaces far away."""
    from scipy.ndimage import label

    cells = np.floor(flat / (2 * spacing)).astype(np.int64)
    cells -= cells.min(axis=0)
    held = np.zeros(cells.max(axis=0) + 1, bool)
    held[tuple(cells.T)] = True
    piece = label(held, np.ones((3, 3)))[0][tuple(cells.T)]
    return piece == np.bincount(piece).argmax()


def _coverage(flat: Float64, spacing: float) -> float:
    """The share of the convex hull of points [I, 2] that is less than about two spacings from one."""
    from scipy.spatial import ConvexHull

    cells = np.unique(np.floor(flat / (2 * spacing)), axis=0)
    return len(cells) * (2 * spacing) ** 2 / float(ConvexHull(flat).volume)
