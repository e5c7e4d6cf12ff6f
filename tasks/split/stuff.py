"""Walls, floors and the like, told from things: large planes with nothing behind them. Beyond Split&Splat."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ss_flow.tasks.artifacts import Bool, Cameras, Float64, PointCloud, PointLabels
from ss_flow.tasks.ranges import Fraction

_ROUNDS = 4
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
    scene = points.points[:: max(1, len(points.points) // (10 * _MOST))].astype(np.float64)
    least = params.extent * _extent(scene) if len(scene) else 0.0
    eye = np.mean([-pose[:3, :3].T @ pose[:3, 3] for pose in cameras.world_to_camera], axis=0)
    stuff = np.zeros(len(names), bool)
    for row, name in enumerate(names):
        own = points.points[labels.label == name]
        own = own[:: max(1, len(own) // _MOST)].astype(np.float64)
        if (extent := _extent(own)) < least or len(own) < _FEW:
            continue
        thickness = params.thickness * extent
        centre, normal = _plane(own, thickness)
        towards = normal if (eye - centre) @ normal > 0 else -normal
        flat = (np.abs((own - centre) @ normal) <= thickness).mean() >= params.flat
        stuff[row] = flat and ((scene - centre) @ towards < -2 * thickness).mean() <= params.behind
    return stuff


def _extent(places: Float64) -> float:
    """Diagonal of the box of points [N, 3], without the outermost 2 % on every side."""
    low, high = np.quantile(places, (0.02, 0.98), axis=0)
    return float(np.linalg.norm(high - low))


def _plane(places: Float64, thickness: float) -> tuple[Float64, Float64]:
    """The plane that most of some points [N, 3] lie on: a point on it, and its unit normal."""
    near = np.ones(len(places), bool)
    for _ in range(_ROUNDS):
        centre = places[near].mean(axis=0)
        normal = np.linalg.svd(places[near] - centre, full_matrices=False)[2][2]
        distance = np.abs((places - centre) @ normal)
        near = distance <= max(thickness, float(np.median(distance)))
    return centre, normal
