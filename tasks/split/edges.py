"""Which labels meet in a convex edge, as the faces of a box do. Beyond Split&Splat.

What stands on a table or leans on a wall meets it in a hollow. For two things to meet in a convex edge, both would have
to end along the same line, which is no place where things come to lie; the faces of one thing always do.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ss_flow.tasks.artifacts import Bool, Cameras, Float32, Float64, Int32, PointCloud, Visibility
from ss_flow.tasks.geometry.cameras import camera_of
from ss_flow.tasks.geometry.clustering import nearest_within
from ss_flow.tasks.geometry.shape import normals_of
from ss_flow.tasks.split.votes.touching import Borders, counts_between

_REACH = 8.0
"""Distance up to which points tell how two labels meet, in spacings of the points. It is twice the one at
which they touch: a sensor's depth is bent at the outline of what stands before a wall."""
_NEAREST = 256
"""Points within it at most."""
_FEW = (6, 3)
"""Points of its own label, and of the other one, below which a point tells nothing."""
_SINKS = 0.2
"""Mean depth of the other label's points below the plane of the own ones, as a share of their mean distance, from which
on an edge is convex. It is .6 where the faces of a box meet."""
_CONVEX = 0.5
"""Share of the points that touch a label, on either side, at which the edge must be convex."""
_ALONG = 0.2
"""Share of its border along which one of the two must meet the other so."""
_PRESUMED = 20
"""Border points that are presumed besides: of so short a border little is known."""
_AT_ONCE = 1 << 12
"""Points that are looked at at once."""


def convex_edges(
    points: PointCloud,
    cameras: Cameras,
    visibility: Sequence[Visibility],
    label: Int32,
    ends: Borders,
) -> Bool:
    """[L, L] which labels, those that occur, ascending, meet in a convex edge along a good part of a border.

    visibility: of all views, which tells the outside of a surface. label: [N] of the points, 0 = none; ends: its
    borders. Both labels must fall off behind the other's plane at most of the points where they touch.
    """
    labels = np.unique(label[label > 0])
    sinks = _sinking(points, _towards_cameras(points, cameras, visibility), label, ends)
    touches = ends.touches, ends.touches[:, sinks >= _SINKS]
    meets, convex = (counts_between(labels, label[ends.rows], of) for of in touches)
    border = np.bincount(np.searchsorted(labels, label[ends.rows[np.unique(ends.touches[0])]]), minlength=len(labels))
    mostly = convex > _CONVEX * meets
    along = convex >= _ALONG * (border[:, None] + _PRESUMED)
    return np.asarray(mostly & mostly.T & (along | along.T))


def _towards_cameras(points: PointCloud, cameras: Cameras, visibility: Sequence[Visibility]) -> Float32:
    """[N, 3] the sum of the directions from each point to the cameras that see it."""
    total = np.zeros((len(points.points), 3), np.float32)
    for number, view in enumerate(visibility):
        ray = camera_of(cameras, number).center - points.points[view.point_index]
        total[view.point_index] += ray / np.linalg.norm(ray, axis=1, keepdims=True)
    return total


def _sinking(points: PointCloud, outwards: Float32, label: Int32, ends: Borders) -> Float64:
    """[T] how far the label that a point touches falls off behind the plane of the point's own label there: the mean
    depth of its points, as a share of their mean distance; 0 where too few points tell."""
    from scipy.spatial import cKDTree

    tree = cKDTree(points.points)
    sinks = np.zeros(ends.touches.shape[1])
    order = np.argsort(ends.touches[0], kind="stable")
    for some in np.array_split(order, max(1, -(-len(order) // _AT_ONCE))):
        row, of = np.unique(ends.touches[0][some], return_inverse=True)
        here = ends.rows[row]
        near = nearest_within(tree, points.points[here], _NEAREST, _REACH * points.spacing[here])
        found = near < tree.n
        near = np.where(found, near, 0)
        offset = np.where(found[..., None], points.points[near] - points.points[here][:, None], 0)
        carries = np.where(found, label[near], 0)
        own = carries == label[here][:, None]
        normal = normals_of(offset, own)
        normal = np.where((normal * outwards[here]).sum(axis=1, keepdims=True) < 0, -normal, normal)
        depth = np.einsum("rkc,rc->rk", offset, -normal)[of]
        others = carries[of] == ends.touches[1][some][:, None]
        distance = (np.linalg.norm(offset, axis=2)[of] * others).sum(axis=1)
        known = (own.sum(axis=1)[of] >= _FEW[0]) & (others.sum(axis=1) >= _FEW[1])
        sinks[some] = known * (depth * others).sum(axis=1) / np.maximum(distance, np.finfo(np.float32).tiny)
    return sinks
