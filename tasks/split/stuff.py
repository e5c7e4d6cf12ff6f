"""Walls, floors and the like, told from things: large planes with nothing behind them. Beyond Split&Splat."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ss_flow.tasks.artifacts import Bool, Cameras, Float64, PointCloud, PointLabels
from ss_flow.tasks.geometry.clustering import rows_by_label
from ss_flow.tasks.geometry.shape import box_diagonal, middle_of, plane_through, thinned, towards
from ss_flow.tasks.ranges import Fraction

_ROUNDS = 4
_TRIM = 0.02
"""Share of the points, on every side, that an extent leaves out."""
_FEW = 10
"""Points below which a label has no plane."""
_MOST = 4000
"""So many points of a label, and ten times as many of the scene, tell."""


@dataclass(frozen=True)
class StuffParams:
    """When a label is stuff."""

    extent: Fraction = 0.35
    """Least extent, as a share of that of the scene."""
    flat: Fraction = 0.8
    """Share of its points that must lie on one plane."""
    thickness: Fraction = 0.03
    """Distance from the plane up to which they do, as a share of the label's extent."""
    behind: Fraction = 0.1
    """Share of the scene's points that may lie behind the plane, more than twice that distance away."""


def find_stuff(points: PointCloud, cameras: Cameras, labels: PointLabels, params: StuffParams) -> Bool:
    """[L] which of the labels that occur, ascending, are stuff.

    Stuff is large and flat, and has (nearly) nothing of the scene behind it: a wall, a floor, a ceiling, the top of a
    table that the capture never looks beyond. A poster on a wall is a thing.
    """
    names = np.unique(labels.label[labels.label > 0])
    scene, eye = thinned(points.points, 10 * _MOST), middle_of(cameras)
    least = params.extent * box_diagonal(scene, _TRIM) if len(scene) else 0.0
    rows_of = rows_by_label(labels.label)
    stuff = np.zeros(len(names), bool)
    for row, name in enumerate(names.tolist()):
        own = thinned(points.points[rows_of[name]], _MOST)
        if (extent := box_diagonal(own, _TRIM)) < least or len(own) < _FEW:
            continue
        thickness = params.thickness * extent
        centre, normal = _plane(own, thickness)
        flat = (np.abs((own - centre) @ normal) <= thickness).mean() >= params.flat
        in_front = (scene - centre) @ towards(normal, centre, eye)
        stuff[row] = flat and (in_front < -2 * thickness).mean() <= params.behind
    return stuff


def _plane(places: Float64, thickness: float) -> tuple[Float64, Float64]:
    """The plane that most of some points [N, 3] lie on: a point on it, and its unit normal."""
    near = np.ones(len(places), bool)
    for _ in range(_ROUNDS):
        centre, normal = plane_through(places[near])
        distance = np.abs((places - centre) @ normal)
        near = distance <= max(thickness, float(np.median(distance)))
    return centre, normal
