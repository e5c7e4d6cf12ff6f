"""Tiles of a floor or a wall: pieces of nearly one size that lie in its plane, side by side. Beyond Split&Splat.

A segmenter finds each tile near the camera, as sure of it as of a sheet of paper. That they repeat tells them from
pictures and mats, which are things.
"""

from __future__ import annotations

import numpy as np

from ss_flow.tasks.artifacts import Bool, Int32, PointCloud
from ss_flow.tasks.geometry.clustering import rows_by_label
from ss_flow.tasks.geometry.shape import extent_of, on_plane, plane_of_most, thinned
from ss_flow.tasks.split.votes.touching import Borders

_MANY = 8
"""Pieces of one size that make tiles."""
_ALIKE = 1.25
"""By which factor their extents differ at most, from the smallest to the largest of them."""
_SMALL = 0.2
"""Extent of a tile at most, as a share of that of what it tiles."""
_ELSEWHERE = 0.2
"""Share of its border along which a tile may touch what is neither stuff nor in this plane: what stands on it."""
_THICKNESS = 2.0
"""Distance from the plane up to which points lie in it, in spacings."""
_FLAT = 0.8
"""Share of a piece's points that must do so."""
_FEW = 20
"""Points below which nothing tells its size."""
_ROUNDS = 4


def with_tiles(points: PointCloud, label: Int32, surface: Int32, ends: Borders, stuff: Bool) -> Int32:
    """[L + 1] the surface of each label, tiles in that of the stuff that they tile; 0 of 0.

    label: [N] of the points, 0 = none; surface: the same without tiles; ends: the borders of the labels; stuff: [S]
    which surfaces, ascending, are. Where at least eight flat pieces in the plane of stuff have one size, these are
    tiles, and so are smaller pieces there, which are tiles cut off or half hidden. A tile touches stuff and what else
    lies in that plane, and hardly anything besides.
    """
    of = surface[label]
    names = np.unique(of[of > 0])
    rows_of = rows_by_label(of)
    places = [points.points[rows_of[name]] for name in names.tolist()]
    size = np.array([len(own) for own in places], np.int64)
    extent = np.array([extent_of(own) for own in places])
    own, other, _ = np.unique(ends.of_surfaces(label, surface, names), axis=1)
    border = np.bincount(own, minlength=len(names))
    thickness, ground_of = _THICKNESS * points.spacing, names.copy()
    for ground in sorted(np.flatnonzero(stuff & (size >= _FEW)).tolist(), key=lambda row: (-size[row], row)):
        plane = plane_of_most(thinned(places[ground]), thickness, _ROUNDS)
        small = ~stuff & (size >= _FEW) & (extent <= _SMALL * extent[ground])
        flat = [row for row in np.flatnonzero(small)
                if on_plane(thinned(places[row]), plane, thickness).mean() >= _FLAT]  # fmt: skip
        level = stuff.copy()
        level[flat] = True
        elsewhere = np.bincount(own[~level[other]], minlength=len(names))
        pieces = np.array([row for row in flat if elsewhere[row] <= _ELSEWHERE * border[row]], np.intp)
        ordered = np.sort(extent[pieces])
        alike = np.searchsorted(ordered, _ALIKE * ordered, side="right") - np.arange(len(ordered))
        if alike.max(initial=0) >= _MANY:
            tiles = pieces[extent[pieces] <= _ALIKE * ordered[alike.argmax()]]
            ground_of[tiles[ground_of[tiles] == names[tiles]]] = names[ground]
    tiled = np.arange(len(surface), dtype=np.int32)
    tiled[names] = ground_of
    return tiled[surface]
