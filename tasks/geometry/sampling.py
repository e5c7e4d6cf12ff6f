"""Choosing some of many points, spread over a region."""

from __future__ import annotations

import numpy as np

from ss_flow.tasks.artifacts import Float32, Float64, Int32, Int64


def greedy_farthest(points: Float32 | Float64, count: int, *, alpha: float = 0.3, drop_hull: bool = True) -> Int32:
    """Indices of at most `count` points, far from each other yet not at the border (spec row 26, A16).

    points: [N, 2] image points. The first is the one closest to their mean; each next one maximises its distance to
    those already taken, less `alpha` times its distance to the mean. Ties go to the lowest index. `drop_hull` leaves
    out the vertices of the convex hull, unless fewer than `count` points would remain. A place is never taken twice:
    fewer than `count` come back where there are fewer distinct points.
    """
    points = np.asarray(points, np.float64)
    candidates = np.arange(len(points))
    if drop_hull and len(points) > count:
        inner = np.setdiff1d(candidates, _hull_vertices(points))
        if len(inner) >= count:
            candidates = inner
    if count < 1 or not len(candidates):
        return np.zeros(0, np.int32)
    places = points[candidates]
    to_mean = np.linalg.norm(places - points.mean(axis=0), axis=1)
    taken = [int(to_mean.argmin())]
    nearest = np.linalg.norm(places - places[taken[0]], axis=1)
    while len(taken) < count:
        score = np.where(nearest > 0, nearest - alpha * to_mean, -np.inf)
        best = int(score.argmax())
        if nearest[best] == 0:
            break
        taken.append(best)
        nearest = np.minimum(nearest, np.linalg.norm(places - places[best], axis=1))
    return candidates[taken].astype(np.int32)


def first_of_each_cube(points: Float32, side: float) -> Int32:
    """The first point in each cube of a grid that begins at the points' lowest corner: rows, ascending.

    points: [N, 3], N >= 1; side: of the cubes, in the points' unit.
    """
    return np.sort(np.unique(cube_of_each(points, side), return_index=True)[1]).astype(np.int32)


def cube_of_each(points: Float32, side: float) -> Int64:
    """[N] the cube of that grid which each point lies in, by a number of its own."""
    cell = np.floor((points - points.min(axis=0)) / side).astype(np.int64)
    # One number a cube: rows of three are compared many times more slowly.
    x, y, z = cell.T
    size = cell.max(axis=0) + 1
    return np.asarray((x * size[1] + y) * size[2] + z)


def sphere(count: int) -> Float64:
    """Directions evenly spread over the sphere, [N, 3] of length 1: each turned by the golden angle, steps of equal
    area from pole to pole along z."""
    step = np.arange(count) + 0.5
    polar, turn = np.arccos(1 - 2 * step / count), np.pi * (1 + np.sqrt(5)) * step
    return np.stack([np.sin(polar) * np.cos(turn), np.sin(polar) * np.sin(turn), np.cos(polar)], axis=1)


def _hull_vertices(points: Float64) -> np.ndarray:
    """Rows of `points` at the corners of their convex hull; none where they all lie on one line."""
    from scipy.spatial import ConvexHull, QhullError

    try:
        return ConvexHull(points).vertices
    except (QhullError, ValueError):
        return np.zeros(0, np.intp)
