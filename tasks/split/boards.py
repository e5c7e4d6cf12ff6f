"""What hangs or stands on a board, and is in every mask with it: two things, told by their shape. Beyond Split&Splat.

No mask of a trophy on its plaque parts the two, so they are one label, or labels that all views show as one. But the
plaque is flat, and the trophy rises from the middle of it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from ss_flow.running import in_threads
from ss_flow.task import Resources, task
from ss_flow.tasks.artifacts import Bool, Cameras, Float64, Hierarchy, Int32, PointCloud, PointLabels
from ss_flow.tasks.geometry.clustering import rows_by_label
from ss_flow.tasks.geometry.shape import Plane, axes_in, extent_of, middle_of, refitted, sector_of, thinned, towards
from ss_flow.tasks.ranges import Fraction
from ss_flow.tasks.split.votes.color_histograms import bins_of, histogram, likeness
from ss_flow.tasks.split.votes.touching import TouchingParams

_FEW = 500
"""Points below which an instance has any shape, by the noise of its depth."""
_THICKNESS = 0.04
"""Distance from a plane up to which points lie on it, as a share of the extent; at least two spacings of the points."""
_COARSE = 0.06
"""Share of the extent beyond which two spacings are too much to tell."""
_SHARE = 0.1
"""Share of the points that lie on a board at least, and that rise from it at least."""
_BEHIND = 0.05
"""Share of them that may lie behind it: a seat has legs."""
_ENOUGH = 3000
"""At least so many points of an instance, and less than twice as many, tell."""
_TRIPLES, _BEST, _ROUNDS = 1500, 60, 3
"""Planes that are tried, each through three points; how many of them, those that most points lie on, are looked at
closely; and how often each of these is then fitted to the points on it."""
_SECTORS = 24
"""Directions in which a board may go on beyond what rises from it."""
_BEYOND = 0.1
"""Points that show that it does, in one direction, as a share of those of the board in one on average."""
_FEET = (0.1, 0.3)
"""A board surrounds what rises from it up to these shares of the height of that."""
_OUTLINE = 0.9
"""Share of the points of a foot, in one direction, that lie within its outline."""


@dataclass(frozen=True)
class BoardParams:
    """When an instance is a board and something that rises from it."""

    rises: Fraction = 0.15
    """How far what rises does so at least (half of its points), as a share of the extent of both; 0 = boards are not
    looked for."""
    around: Fraction = 0.85
    """Share of the directions in which the board goes on beyond its foot: the back of a chair stands at the edge of the
    seat."""
    alike: Fraction = 0.9
    """Cosine of both colour histograms up to which they are two things: a lamp has the colour of its base."""


@task(name="split.part_boards", resources=Resources(cores=1, most_cores=8))
def part_boards(
    points: PointCloud, cameras: Cameras, labels: PointLabels, tree: Hierarchy, *, params: BoardParams
) -> PointLabels:
    """The instances, of which those are divided that are a flat board and something that rises from the middle of it.

    labels: the instances, after the cut of `tree`; stuff stays as it is. Both halves get new ids, and all other
    instances keep theirs. A mask that showed both shows neither.
    """
    eye, spread, bins = middle_of(cameras), TouchingParams().color_spread, bins_of(points.colors)
    changed, parted = labels.label.copy(), list[int]()
    rows_of = rows_by_label(labels.label)
    names = sorted(rows_of.keys() - {0, *tree.node[tree.stuff].tolist()})

    def board_in(name: int) -> Bool | None:
        rows = rows_of[name]
        places = points.points[rows].astype(np.float64)
        return board_of(places, points.spacing_of(rows), eye, rises=params.rises, around=params.around)

    for name, board in zip(names, in_threads(board_in, names), strict=True):
        if board is None:
            continue
        rows = rows_of[name]
        if likeness(*(histogram(bins[rows[side]], spread) for side in (board, ~board))) <= params.alike:
            changed[rows] = labels.num_labels + 2 * len(parted) + np.where(board, 1, 2)
            parted.append(name)
    kept = ~np.isin(labels.match_label, parted)
    return replace(
        labels,
        label=changed,
        num_labels=labels.num_labels + 2 * len(parted),
        match_view=labels.match_view[kept],
        match_mask=labels.match_mask[kept],
        match_label=labels.match_label[kept],
    )


def board_of(places: Float64, spacing: float, eye: Float64, *, rises: float, around: float) -> Bool | None:
    """[N] which of some points [N, 3] are of a board that the others rise from; None without one.

    spacing: of the points. eye: [3] where they are seen from. rises, around: as in `BoardParams`. What lies as low as
    the board, below what rises, is no part of it.
    """
    some = thinned(places, _ENOUGH)
    extent = extent_of(some) if len(some) else 0.0
    if len(places) < _FEW or 2 * spacing > _COARSE * extent:
        return None
    thickness = max(_THICKNESS * extent, 2 * spacing)
    best, board = (around, 0.0), None
    for plane in _planes(some, thickness, eye):
        relief = _Relief(some, plane, thickness)
        if relief.rise < rises * extent:
            continue
        found = (min(relief.around(foot) for foot in _FEET), float(relief.low.mean()))
        if found >= best:
            best, board = found, plane
    if board is None:
        return None
    whole = _Relief(places, board, thickness)
    return whole.low & ~whole.below(_FEET[0])


class _Relief:
    """Points over a plane.

    low: [N] which of them lie on it, or behind. rise: how far, beyond its thickness, half of the others rise at least.
    """

    def __init__(self, places: Float64, plane: Plane, thickness: float) -> None:
        centre, normal = plane
        height = (places - centre) @ normal
        self.low: Bool = height <= thickness
        self.rise = float(np.median(height[~self.low])) - thickness
        self._over = height - thickness
        self._flat = (places - centre) @ axes_in(normal).T

    def around(self, foot: float) -> float:
        """Share of the directions in which low points lie beyond the outline of a foot, as `_outline` takes it."""
        sector, distance, outline = self._outline(foot)
        beyond = np.bincount(sector[self.low & (distance > outline[sector])], minlength=_SECTORS)
        return float((beyond >= _BEYOND * self.low.sum() / _SECTORS).mean())

    def below(self, foot: float) -> Bool:
        """[N] which points lie within the outline of a foot, as `_outline` takes it."""
        sector, distance, outline = self._outline(foot)
        return np.asarray(distance <= outline[sector])

    def _outline(self, foot: float) -> tuple[Int32, Float64, Float64]:
        """[N] the direction of each point from the middle of the foot, [N] how far it is from there, and [_SECTORS] how
        far the foot reaches in each direction. foot: up to which share of `rise`, from the lowest point on, what rises
        is its foot."""
        within = np.flatnonzero(~self.low & (self._over <= self._over[~self.low].min() + foot * self.rise))
        off = self._flat - np.median(self._flat[within], axis=0)
        distance = np.hypot(*off.T)
        sector = sector_of(off, _SECTORS)
        reach = [distance[within[sector[within] == one]] for one in range(_SECTORS)]
        return sector, distance, np.array([np.quantile(far, _OUTLINE) if len(far) else 0.0 for far in reach])


def _planes(places: Float64, thickness: float, eye: Float64) -> Iterator[Plane]:
    """The planes that may be a board, with normals towards the eye: of those through three of the points [N, 3], drawn
    from a fixed seed, the ones that most points lie on and few behind, and from which enough points rise."""
    corner = places[np.random.default_rng(0).integers(0, len(places), (_TRIPLES, 3))]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    length = np.linalg.norm(normal, axis=1)
    centre, normal = corner[length > 0, 0], normal[length > 0] / length[length > 0, None]
    normal *= np.where(((eye - centre) * normal).sum(axis=1) > 0, 1, -1)[:, None]
    height = places @ normal.T - (centre * normal).sum(axis=1)
    on, behind = (np.abs(height) <= thickness).mean(axis=0), (height < -thickness).mean(axis=0)
    rough = np.flatnonzero((on >= _SHARE / 2) & (behind <= 2 * _BEHIND))  # fitting may mend as much
    for row in rough[np.argsort(-on[rough], kind="stable")][:_BEST]:
        middle, across = refitted(places, (centre[row], normal[row]), thickness, _ROUNDS)
        across = towards(across, middle, eye)
        above = (places - middle) @ across
        enough = min((np.abs(above) <= thickness).mean(), (above > thickness).mean()) >= _SHARE
        if enough and (above < -thickness).mean() <= _BEHIND:
            yield middle, across
