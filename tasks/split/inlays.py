"""What lies in the surface of another thing, all round it: a picture in its mount, a screen in its frame.

It has an outline of its own in every photo, and so has what it lies in. A page lies in a table as well; but there few
views have one mask for both, and the page is small. Beyond Split&Splat.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ss_flow.tasks.artifacts import Bool, Float64, Int32
from ss_flow.tasks.geometry.clustering import rows_by_label
from ss_flow.tasks.geometry.shape import Plane, axes_in, middle_of, on_plane, plane_of_most, thinned, towards
from ss_flow.tasks.split.looks import Looks
from ss_flow.tasks.split.votes.touching import Borders, counts_between

_FEW = 100
"""Points below which a label has no outline."""
_THICKNESS, _ROUNDS = 3.0, 4
"""Distance from a plane up to which points lie on it, in spacings; and how often it is fitted to those."""
_FLAT = 0.8
"""Share of the points of a label that must do so."""
_CELL = 2.0
"""Side of the squares in its plane that show where a label is, in spacings."""
_SQUARES = 300
"""How many a label is across at most: of a larger one, or one with a stray point far off, squares are larger."""
_BESIDE = (2, 4)
"""Squares beyond its outline between which one looks for what is around it."""
_MOST = 150
"""Squares around a label at which views look, at least so many where there are, and less than twice as many."""
_SEEN = 12
"""Of them, how many some view must see."""
_AROUND = 0.8
"""Share of these at which views mostly see the other thing."""
_SHARE = 0.1
"""Share of the points of both that lie within at least: more than a page on a table."""
_MOSTLY = 0.6
"""Share of the points that touch the other thing at which a piece must go on into that without an edge: halfway between
what lies in another thing (.77 and more) and what does not (.41 and less), in 45 scenes."""


@dataclass(frozen=True)
class Inlays:
    """What views see around labels, in their planes; L labels, those that occur, ascending."""

    size: Float64
    """[L] points."""
    places: Float64
    """[L] places around each that some view sees, or looks at in vain."""
    shown: Float64
    """[L, L] those at which views mostly see each label."""
    meets: Float64
    """[L, L] points at the border of each that touch each other one."""
    smooth: Float64
    """[L, L] those that do so without an edge."""

    def pairs(self, pieces: Sequence[tuple[int, ...]]) -> list[tuple[int, int]]:
        """Which pieces, each some labels (rows), lie in which other one, and mostly go on into it without an edge where
        they touch: (inner, outer) by number."""
        member = np.zeros((len(pieces), len(self.size)))
        for row, labels in enumerate(pieces):
            member[row, list(labels)] = 1
        shown, size = member @ self.shown @ member.T, member @ self.size
        places = member @ self.places - np.diag(shown)  # between the labels of a piece is not around it
        np.fill_diagonal(shown, 0)
        found = (shown >= _AROUND * places[:, None]) & (places[:, None] >= _SEEN)
        found &= size[:, None] >= _SHARE * (size[:, None] + size)
        return [
            (inner, outer)
            for inner, outer in np.argwhere(found).tolist()
            if self._goes_on(pieces[inner], pieces[outer])
        ]

    def _goes_on(self, piece: tuple[int, ...], other: tuple[int, ...]) -> bool:
        """Whether a piece, some labels (rows), goes on without an edge into another one, mostly, where they touch."""
        here = np.ix_(piece, other)
        return bool(self.smooth[here].sum() >= max(_MOSTLY * self.meets[here].sum(), 1))


def find_inlays(looks: Looks, label: Int32, ends: Borders, asked: Bool) -> Inlays:
    """What views see around those labels of a cloud that are flat.

    label: [N] of its points, 0 = none; ends: the borders of the labels. asked: [L] whether one wants to know it of
    each. Where all that is seen rises from the label's plane, that is hidden, and tells nothing; where what is seen
    lies behind it, nothing is around.
    """
    names, size = np.unique(label[label > 0], return_counts=True)
    rows_of, cloud, eye = rows_by_label(label), looks.cloud, middle_of(looks.cameras)
    own, places, planes, thick = list[int](), list[Float64](), list[Float64](), list[float]()
    for row in np.flatnonzero(asked & (size >= _FEW)).tolist():
        rows = rows_of[int(names[row])]
        points, spacing = cloud.points[rows].astype(np.float64), cloud.spacing_of(rows)
        thickness = _THICKNESS * spacing
        centre, normal = plane_of_most(thinned(points), thickness, _ROUNDS)
        if on_plane(points, (centre, normal), thickness).mean() >= _FLAT:
            own.append(row)
            places.append(_beside(points, (centre, normal), _CELL * spacing))
            thick.append(thickness)
            planes.append(np.stack([centre, towards(normal, centre, eye)]))
    count, shown = np.zeros(len(names)), np.zeros((len(names), len(names)))
    if own:
        of = np.repeat(np.arange(len(own)), [len(some) for some in places])
        told, most = _seen_at(looks, label, np.concatenate(places), np.stack(planes)[of], np.array(thick)[of])
        around, labelled = np.array(own)[of], told & (most > 0)
        np.add.at(count, around[told], 1)
        np.add.at(shown, (around[labelled], np.searchsorted(names, most[labelled])), 1)
    meets, smooth = (counts_between(names, label[ends.rows], touches) for touches in (ends.touches, ends.smooth))
    return Inlays(size.astype(np.float64), count, shown, meets, smooth)


def _beside(points: Float64, plane: Plane, cell: float) -> Float64:
    """[P, 3] places on a plane around points [N, 3], some way beyond their outline. cell: least side of the squares
    that tell the outline, world units."""
    from scipy.ndimage import binary_dilation

    centre, normal = plane
    axes = axes_in(normal)
    flat = (points - centre) @ axes.T
    near, far = _BESIDE
    cell = max(cell, float(np.ptp(flat, axis=0).max()) / _SQUARES)
    corner = flat.min(axis=0) - (far + 1) * cell
    square = ((flat - corner) / cell).astype(np.intp)
    covered = np.zeros(square.max(axis=0) + far + 2, bool)
    covered[tuple(square.T)] = True
    ring = np.argwhere(binary_dilation(covered, iterations=far) & ~binary_dilation(covered, iterations=near))
    ring = ring[:: max(1, len(ring) // _MOST)]
    return np.asarray(centre + ((ring + 0.5) * cell + corner) @ axes)


def _seen_at(
    looks: Looks, label: Int32, places: Float64, planes: Float64, thickness: Float64
) -> tuple[Bool, NDArray[np.intp]]:
    """[P] whether views tell what is at places, and [P] the label that most see there, 0 for none.

    places: [P, 3]. planes: [P, 2, 3] point and normal, towards the cameras, of the plane of each; thickness: [P]
    how far from it a point still lies on it.
    """
    span = int(label.max()) + 1
    looked, hidden, found = np.zeros(len(places), bool), np.zeros(len(places), bool), [np.zeros(0, np.intp)]
    for view in range(len(looks.visibility)):
        place, point = looks.at(view, places)
        looked[place] = True
        place, point = place[point >= 0], point[point >= 0]
        height = ((looks.cloud.points[point] - planes[place, 0]) * planes[place, 1]).sum(axis=1)
        hidden[place[height > thickness[place]]] = True
        flat = np.abs(height) <= thickness[place]
        found.append(place[flat] * span + label[point[flat]])
    pair, times = np.unique(np.concatenate(found), return_counts=True)
    order = np.lexsort((times, pair // span))  # the last of each place is the label of most
    most = np.zeros(len(places), np.intp)
    most[pair[order] // span] = pair[order] % span
    hidden[pair // span] = False
    return looked & ~hidden, most
