"""How sets of pieces touch each other, and what else they touch. Beyond Split&Splat."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ss_flow.tasks.artifacts import Bool, Float32, Float64, Int32
from ss_flow.tasks.geometry.clustering import rows_by_label
from ss_flow.tasks.split.agreement import ramp
from ss_flow.tasks.split.votes.touching import Borders

_FAINT = 10.0
"""Points of a border with others that are presumed, so that a faint touch proves nothing."""
_ALONE = 0.5
"""Share of what pieces touch, other than stuff, that must be of their own set for it to begin to stand alone."""
_SLIVER = 0.05
"""Share of what one of two pieces touches that must be the other, so that they hang together: a book that leans on a
wall may meet it at three points."""
_NEARLY_ALL = 0.95
"""Share of the points of a set that hangs together; the rest are crumbs."""


@dataclass(frozen=True)
class Contact:
    """Which of G pieces touch. Sets of them are [S, G], 1 for the pieces of each, else 0."""

    points: Float32
    """[G, G] points at which each touches each other one, from both sides."""
    size: Float32
    """[G] points of each."""

    def joined(self, member: Float32) -> Contact:
        """The same of the pieces that these make up. member: [G, H] 1 where one is part of a new one, else 0."""
        between = np.asarray(member.T @ self.points @ member, np.float32)
        np.fill_diagonal(between, 0)
        return Contact(between, np.asarray(self.size @ member, np.float32))

    def parted(self, members: tuple[int, ...]) -> list[tuple[int, ...]]:
        """These pieces, together those that touch each other, directly or by others of these."""
        from scipy.sparse.csgraph import connected_components

        _, part = connected_components(self.points[np.ix_(members, members)] > 0, directed=False)
        return [tuple(np.array(members)[rows].tolist()) for rows in rows_by_label(part).values()]

    def own(self, member: Float32) -> Float64:
        """[S] share of what the pieces of each set touch, each for itself, that is of the set, 0..1."""
        touched = member @ self.points
        return np.asarray((touched * member).sum(axis=1) / (touched.sum(axis=1) + 2 * _FAINT), np.float64)

    def alone(self, member: Float32, stuff: Bool) -> Float64:
        """[S] how far each set stands alone, 0..1: whether it touches nothing but itself and stuff [G]."""
        touched = member @ self.points
        inside, outside = (touched * member).sum(axis=1) / 2, (touched * (1 - member) * ~stuff).sum(axis=1)
        return ((member @ stuff) == 0) * ramp(inside / (inside + outside + _FAINT), _ALONE, 1.0)

    def hang_together(self, member: Float32) -> Bool:
        """[S] of which sets one gets from the largest piece to nearly all points, over pieces that touch each other by
        more than a sliver."""
        touched = self.points.sum(axis=1)
        least = _SLIVER * np.minimum(touched[:, None], touched)
        touch = ((self.points > 0) & (self.points >= least)).astype(np.float32)
        reached = np.zeros_like(member)
        reached[np.arange(len(member)), (member * self.size).argmax(axis=1)] = 1
        while True:
            farther = np.maximum((reached @ touch > 0) * member, reached)
            if (farther == reached).all():
                return np.asarray(reached @ self.size >= _NEARLY_ALL * (member @ self.size))
            reached = farther


def find_contact(ends: Borders, label: Int32) -> Contact:
    """How the labels that occur, ascending, touch in space. ends: the borders of the labels [N], 0 = none."""
    names, size = np.unique(label[label > 0], return_counts=True)
    points = np.zeros((len(names), len(names)), np.float32)
    if len(names):
        big = int(names[-1]) + 1
        point = np.arange(len(ends.rows), dtype=np.int64)[:, None]
        number, other = np.divmod(np.unique(point * big + label[ends.beside]), big)
        own = label[ends.rows[number]]
        touches = (other > 0) & (other != own)
        pair = np.searchsorted(names, own[touches]), np.searchsorted(names, other[touches])
        np.add.at(points, pair, 1)
    return Contact(points + points.T, size.astype(np.float32))
