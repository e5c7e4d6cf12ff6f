"""Walls, floors and the like, told from things: large planes with nothing behind them. Beyond Split&Splat."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ss_flow.tasks.artifacts import Bool, Cameras, Float64, PointCloud, PointLabels
from ss_flow.tasks.geometry.clustering import rows_by_label
from ss_flow.tasks.geometry.shape import (
    Plane,
    box_diagonal,
    extent_of,
    largest_plane,
    middle_of,
    on_plane,
    plane_of_most,
    thinned,
    towards,
)
from ss_flow.tasks.ranges import Count, Fraction

_ROUNDS = 4
_STRAY = 0.1
"""Share of the points, on every side, that a label's extent leaves out. Of a picture's mount every tenth point may be a
stray somewhere on the wall."""
_FEW = 10
"""Points below which a label has no plane."""
_ENOUGH = 4000
"""At least so many points of a label, ten times as many of the scene, and less than twice of either, tell."""


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
    planes: Count = 3
    """How many such planes its points may lie on: two walls of one colour, or a wall and a ceiling, are often one mask.
    """


def find_stuff(points: PointCloud, cameras: Cameras, labels: PointLabels, params: StuffParams) -> Bool:
    """[L] which of the labels that occur, ascending, are stuff.

    Stuff is large and flat, and has (nearly) nothing of the scene behind it: a wall, a floor, a ceiling, the top of a
    table that the capture never looks beyond. A poster on a wall is a thing. Two walls that meet are stuff, too.
    """
    names = np.unique(labels.label[labels.label > 0])
    scene, eye = thinned(points.points, 10 * _ENOUGH), middle_of(cameras)
    least = params.extent * extent_of(scene) if len(scene) else 0.0
    rows_of = rows_by_label(labels.label)
    stuff = np.zeros(len(names), bool)
    for row, name in enumerate(names.tolist()):
        own = thinned(points.points[rows_of[name]], _ENOUGH)
        extent = _extent(own)
        if extent < least or len(own) < _FEW:
            continue
        thickness, planes = params.thickness * extent, planes_of(own, params)
        in_front = [(scene - centre) @ towards(normal, centre, eye) for centre, normal in planes]
        stuff[row] = bool(planes) and all((ahead < -2 * thickness).mean() <= params.behind for ahead in in_front)
    return stuff


def planes_of(places: Float64, params: StuffParams) -> list[Plane]:
    """The planes that enough of the points of stuff [N, 3] lie on: one, or else one after the other, each with as many
    as it can of those that are left; none if there would have to be too many."""
    thickness = params.thickness * _extent(places)
    one = plane_of_most(places, thickness, _ROUNDS)
    if on_plane(places, one, thickness).mean() >= params.flat:
        return [one]
    planes: list[Plane] = []
    rest = places
    while 1 < params.planes > len(planes) and len(rest) > (1 - params.flat) * len(places):
        planes.append(largest_plane(rest, thickness, _ROUNDS))
        rest = rest[~on_plane(rest, planes[-1], thickness)]
    return planes if len(rest) <= (1 - params.flat) * len(places) else []


def _extent(places: Float64) -> float:
    # What lies evenly on a plane reaches so much farther than its middle does.
    return box_diagonal(places, _STRAY) / (1 - 2 * _STRAY)
