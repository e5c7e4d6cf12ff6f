"""What a thing casts on a wall or a floor: a label that lies in stuff and looks like it, in shadow. Beyond Split&Splat.

A shadow is in nearly every mask of the picture that casts it. `shadows` is sure of one only where other borders repeat
its step, and then it is one with the wall. Here less is asked and less is claimed: that it is no part of a thing.
"""

from __future__ import annotations

import numpy as np

from ss_flow.tasks.artifacts import Bool, Int32, PointCloud
from ss_flow.tasks.geometry.clustering import rows_by_label
from ss_flow.tasks.geometry.shape import extent_of, on_plane, plane_of_most, thinned
from ss_flow.tasks.split.shadows import logarithms, may_shade
from ss_flow.tasks.split.votes.touching import Borders

_ALONG = 0.4
"""Share of its border along which a shadow touches stuff."""
_BESIDE = 0.1
"""Share along which it touches what casts it: a grey mat may lie alone on a floor."""
_THICKNESS = 2.0
"""Distance from the plane of the stuff round it up to which its points lie in that, in spacings."""
_FLAT = 0.7
"""Share of them that must do so: a sensor's depth is bent at the outline of what casts it."""
_EVEN = 0.25
"""Median deviation of its colours, in each logarithm: what is printed has several."""
_FEW = 20
"""Points below which nothing has a plane."""
_ROUNDS = 4


def find_casts(points: PointCloud, label: Int32, surface: Int32, ends: Borders, stuff: Bool) -> Bool:
    """[S] which surfaces, ascending, are shadows on stuff.

    label: [N] of the points, 0 = none; surface: [L + 1] of each label, 0 of 0; ends: the borders of the labels; stuff:
    [S] which surfaces are known to be. A shadow touches stuff along its border, and what casts it; it lies in the plane
    that the stuff has there, and has its colour but for one step into a shadow. So has a grey rug on a white floor with
    a chair on it: it stays a label of its own, which masks may unite with the floor, but not with the chair.
    """
    of = surface[label]
    names = np.unique(of[of > 0])
    casts = np.zeros(len(names), bool)
    row, touched = ends.touches
    own, other = (np.searchsorted(names, to) for to in (of[ends.rows[row]], surface[touched]))
    own, other, point = np.stack([own, other, row])[:, own != other]
    rows_of, brightness = rows_by_label(of), logarithms(points.colors)
    for name in np.unique(own[stuff[other] & ~stuff[own]]).tolist():
        mine = own == name
        on_stuff = mine & stuff[other]
        border, along, beside = (len(np.unique(point[of])) for of in (mine, on_stuff, mine & ~on_stuff))
        if along < _ALONG * border or beside < _BESIDE * border:
            continue
        rows, ground = rows_of[int(names[name])], rows_of[int(names[np.bincount(other[on_stuff]).argmax()])]
        places = points.points[rows].astype(np.float64)
        away = np.linalg.norm(points.points[ground] - places.mean(axis=0), axis=1)
        ground = ground[away <= extent_of(places)]
        if min(len(rows), len(ground)) < _FEW:
            continue
        color = np.median(brightness[rows], axis=0)
        even = np.median(np.abs(brightness[rows] - color), axis=0).max() <= _EVEN
        if even and may_shade(color - np.median(brightness[ground], axis=0)):
            thickness = _THICKNESS * points.spacing_of(ground)
            plane = plane_of_most(thinned(points.points[ground]), thickness, _ROUNDS)
            casts[name] = on_plane(thinned(places), plane, thickness).mean() >= _FLAT
    return casts
