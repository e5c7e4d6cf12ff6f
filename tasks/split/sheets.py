"""What lies flat in the surface of something larger, as a page on a table does: what rises from it is no part of it.

A mug on a page is in nearly every mask of the page. But the page goes on into the table without an edge, and the mug
does not. Beyond Split&Splat.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ss_flow.tasks.artifacts import Bool, Float64, Int32, PointCloud, PointLabels
from ss_flow.tasks.geometry.clustering import rows_by_label
from ss_flow.tasks.geometry.shape import Plane, extent_of, on_plane, plane_through, thinned
from ss_flow.tasks.split.votes.touching import Borders

_FEW = 20
"""Points at its border with which the share of it that goes on counts half: of so short a border little is known."""
_FLAT = 0.9
"""Share of its points that must lie on one plane."""
_THICKNESS = 2.0
"""Distance from the plane up to which they do, in multiples of the cloud's spacing."""
_RISES = 3.0
"""Distance, in the same, that what stands on a sheet rises from it at least."""
_MOSTLY = 0.6
"""Share of the points that touch something at which a piece must go on into that without an edge, to lie in it: halfway
between what lies in another thing (.77 and more) and what does not (.41 and less), in 45 scenes."""


@dataclass(frozen=True)
class Sheets:
    """How labels go on into each other; L labels, those that occur, ascending."""

    smooth: Float64
    """[L, L] points at the border of each that touch each other one without an edge."""
    meets: Float64
    """[L, L] points at the border of each that touch each other one at all."""
    border: Float64
    """[L] points that touch any other."""
    rows: list[NDArray[np.intp]]
    """L x the points of each."""
    points: PointCloud
    flush: float
    """Least share of its border, less the share that goes on into the set, along which a sheet goes on into larger
    labels outside of the set."""
    height: float
    """How far something must rise from the sheet to stand on it, as a share of its extent."""
    _planes: dict[tuple[int, ...], Plane | None] = field(default_factory=dict, init=False)
    """Planes found so far: many sets share their pieces."""

    def standing(self, pieces: Sequence[tuple[int, ...]]) -> Bool:
        """Which pieces, each some labels (rows), rise from another one that is a sheet in something larger: [P]."""
        stands = np.zeros(len(pieces), bool)
        for sheet in np.flatnonzero(self._outwards(pieces) > self.flush).tolist():
            if (plane := self._plane_of(pieces[sheet])) is None:
                continue
            centre, normal = plane
            for i in set(range(len(pieces))) - {sheet}:
                other = self._places(pieces[i])
                rises = np.quantile(np.abs((other - centre) @ normal), 0.9)
                stands[i] |= bool(rises >= max(self.height * extent_of(other), _RISES * self.points.spacing))
        return stands

    def lies_in(self, piece: tuple[int, ...], other: tuple[int, ...]) -> bool:
        """Whether a piece, some labels (rows), goes on without an edge into another one, mostly, where they touch."""
        here = np.ix_(piece, other)
        return bool(self.smooth[here].sum() >= max(_MOSTLY * self.meets[here].sum(), 1))

    def _plane_of(self, labels: tuple[int, ...]) -> Plane | None:
        """The plane in which the labels (rows) lie; None where they do not lie in one."""
        if labels not in self._planes:
            places = self._places(labels)
            plane = _plane(places)
            flat = on_plane(places, plane, _THICKNESS * self.points.spacing).mean() >= _FLAT
            self._planes[labels] = plane if flat else None
        return self._planes[labels]

    def _outwards(self, pieces: Sequence[tuple[int, ...]]) -> Float64:
        """[P] share of the border of each piece that goes on into larger labels of none of the pieces, less the share
        that goes on into the other pieces. What goes on into smaller labels does not count: a page may be in pieces
        there that no mask shows with these."""
        member = np.zeros((len(pieces), len(self.border)))
        for row, labels in enumerate(pieces):
            member[row, list(labels)] = 1
        size = np.array([len(rows) for rows in self.rows], np.float64)
        within = ((member @ self.meets) * member).sum(axis=1)  # between the labels of a piece is no border
        goes_on, any_piece = member @ self.smooth, member.sum(axis=0)
        larger = size >= (member @ size)[:, None]
        smaller = (goes_on * (1 - any_piece) * ~larger).sum(axis=1)
        border = np.maximum(member @ self.border - within - smaller, 1)
        inside = np.minimum((goes_on * (any_piece - member)).sum(axis=1) / border, 1)
        outside = np.minimum((goes_on * (1 - any_piece) * larger).sum(axis=1) / border, 1)
        return (outside - inside) * border / (border + _FEW)

    def _places(self, labels: tuple[int, ...]) -> Float64:
        return thinned(self.points.points[np.concatenate([self.rows[row] for row in labels])])


def find_sheets(points: PointCloud, labels: PointLabels, ends: Borders, *, flush: float, height: float) -> Sheets:
    """How the labels of `points`, with these borders, go on into each other; flush, height: see `Sheets`."""
    names = np.unique(labels.label[labels.label > 0])
    if not len(names):
        return Sheets(np.zeros((0, 0)), np.zeros((0, 0)), np.zeros(0), [], points, flush, height)
    own = np.searchsorted(names, labels.label[ends.rows])
    rows_of = rows_by_label(labels.label)
    return Sheets(
        smooth=_counts(own, names, ends.smooth),
        meets=_counts(own, names, ends.touches),
        border=np.bincount(own[np.unique(ends.touches[0])], minlength=len(names)).astype(np.float64),
        rows=[rows_of[name] for name in names.tolist()],
        points=points,
        flush=flush,
        height=height,
    )


def _counts(own: NDArray[np.intp], names: Int32, touches: Int32) -> Float64:
    """[L, L] how many points of each label touch each label. own: [R] label (row) of each point. touches: [2, T] which
    of the points touches which label."""
    pair = own[touches[0]] * len(names) + np.searchsorted(names, touches[1])
    return np.bincount(pair, minlength=len(names) ** 2).reshape(len(names), -1).astype(np.float64)


def _plane(places: Float64) -> Plane:
    """The plane through some points [N, 3], without the tenth that is farthest from it."""
    centre, normal = plane_through(places)
    distance = np.abs((places - centre) @ normal)
    return plane_through(places[distance <= np.quantile(distance, 0.9)])
