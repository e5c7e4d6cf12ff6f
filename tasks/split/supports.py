"""What stands on something level: it rises from a surface that goes on all round its foot. Beyond Split&Splat.

A mask of a table often holds what stands on it, too. Of a whole thing, in however many pieces, its place tells more
than the border of each piece does: the body of a mug goes on into its handle and meets the book beside it.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ss_flow.tasks.artifacts import Cameras, Float64, PointCloud, PointLabels
from ss_flow.tasks.geometry.cameras import up_of
from ss_flow.tasks.geometry.clustering import rows_by_label
from ss_flow.tasks.geometry.shape import (
    Plane,
    axes_in,
    extent_of,
    middle_of,
    on_plane,
    plane_of_most,
    planes_of_patches,
    refitted,
    sector_of,
    thinned,
    towards,
)

_FEW = 20
"""Points below which nothing has a shape."""
_THICKNESS = 2.0
"""Distance from a plane up to which a point lies on it, in spacings of the surface's points."""
_FLAT = 0.7
"""Share of its points that must lie on one plane: the rest is the edge of a table top, or noise."""
_TOP = 0.15
"""Or else, share of its points that lie on its top: those of a chest are mostly its sides."""
_ABOVE = 0.1
"""Share of its points that may lie above its top: of a chair of one piece more do."""
_AMID = 1.2
"""So many standard deviations from the middle of a top its points are not yet its sides, which are 1.7 away. There,
`_FLAT` of all points must lie on it: between the crests of a crumpled cloth they do not."""
_WIDE = 2.0
"""A plane's points spread along it, in its narrowest direction, by this many times that distance at least (standard
deviation): of a pot that few points show, most lie near some plane through it."""
_ROUNDS = 3
"""How often a plane is fitted to the points on it."""
_LEVEL = 0.5
"""Least cosine between the plane's normal and upwards: a handle does not stand on its door. Where cameras look down,
what is up in photos leans away from them, and from such a door."""
_RISES = 3.0
"""Distance, in spacings of its points, that what stands rises at least."""
_SMALL = 0.5
"""What stands on a surface spreads over less than this share of it."""
_FOOT = 0.3
"""Share of its points, the lowest, that are its foot."""
_SECTORS = 16
"""Directions round the foot."""
_ROUND = 0.75
"""Share of these in which the surface goes on. Behind the back of a chair there is no seat."""

Labels = tuple[int, ...]
"""Some labels, by their rows."""


@dataclass(frozen=True)
class Supports:
    """Where L labels lie, those that occur, ascending."""

    rows: list[NDArray[np.intp]]
    """L x the points of each."""
    points: PointCloud
    up: Float64
    """[3] of unit length, world: what is up in most photos."""
    eye: Float64
    """[3] the mean place of the cameras."""
    height: float
    """How far something must rise from a surface to stand on it, as a share of its extent."""
    _planes: dict[Labels, Plane | None] = field(default_factory=dict, init=False)
    _answers: dict[tuple[Labels, Labels, Labels], bool] = field(default_factory=dict, init=False)
    _shares: dict[tuple[Labels, Labels], float] = field(default_factory=dict, init=False)
    _spacings: dict[Labels, float] = field(default_factory=dict, init=False)
    """What was found so far: many sets share their pieces."""

    def levels(self, labels: Labels) -> list[Labels]:
        """Which of these labels lie in a level plane, or have a level top: all together, or single ones."""
        together = [labels] if len(labels) > 1 else []
        return [level for level in (*together, *((row,) for row in labels)) if self._plane_of(level)]

    def goes_on(self, level: Labels, labels: Labels) -> bool:
        """Whether labels lie in the plane of others that `levels` names, as the pieces of a rug do."""
        plane = self._plane_of(level)
        if plane is None:
            return False
        if (level, labels) not in self._shares:
            on = on_plane(self._places(labels), plane, self._thickness(level))
            self._shares[level, labels] = float(on.mean())
        return self._shares[level, labels] >= _FLAT

    def hold(self, level: Labels, labels: Labels, more: Labels = ()) -> bool:
        """Whether labels, taken together, stand on others that `levels` names. more: labels in which these go on."""
        if (level, labels, more) not in self._answers:
            plane = self._plane_of(level)
            self._answers[level, labels, more] = plane is not None and self._stands(plane, (*level, *more), labels)
        return self._answers[level, labels, more]

    def _plane_of(self, labels: Labels) -> Plane | None:
        """The level plane, its normal upwards, in which labels lie, or their top; None where there is neither."""
        if labels not in self._planes:
            self._planes[labels] = None
            places = self._places(labels)
            if len(places) >= _FEW:
                thickness = self._thickness(labels)
                plane = plane_of_most(places, thickness, _ROUNDS)
                on = on_plane(places, plane, thickness)
                if self._level(plane) and on.mean() >= _FLAT and _wide(places[on], plane, thickness):
                    self._planes[labels] = plane[0], towards(plane[1], plane[0], self.eye)
                else:
                    self._planes[labels] = self._top_of(places, thickness)
        return self._planes[labels]

    def _top_of(self, places: Float64, thickness: float) -> Plane | None:
        """The level plane on which most points [N, 3] lie, if it is a top: with hardly any above it, and no others amid
        it, as the sides of a chest are not."""
        level = [plane for plane in planes_of_patches(places) if self._level(plane)]
        if not level:
            return None
        best = max(level, key=lambda plane: on_plane(places, plane, thickness).sum())
        centre, normal = refitted(places, best, thickness, _ROUNDS)
        normal = towards(normal, centre, self.eye)
        height, along = (places - centre) @ normal, (places - centre) @ axes_in(normal).T
        on = np.abs(height) <= thickness
        if normal @ self.up < _LEVEL or on.mean() < _TOP or (height > thickness).mean() > _ABOVE:
            return None
        if not _wide(places[on], (centre, normal), thickness):
            return None
        spread = np.linalg.pinv(np.cov(along[on].T))
        amid = np.einsum("ni,ij,nj->n", along, spread, along) <= _AMID**2
        return (centre, normal) if on[amid].mean() >= _FLAT else None

    def _level(self, plane: Plane) -> bool:
        return bool(towards(plane[1], plane[0], self.eye) @ self.up >= _LEVEL)

    def _stands(self, plane: Plane, level: Labels, labels: Labels) -> bool:
        """Whether labels rise from the plane of others, which go on round their foot."""
        own = self._places(labels)
        if len(own) < _FEW:
            return False
        centre, normal = plane
        thickness = self._thickness(level)
        height, extent = (own - centre) @ normal, extent_of(own)
        low, high = np.quantile(height, (0.1, 0.9))
        if high < max(self.height * extent, _RISES * self._spacing(labels)) or low < -thickness:
            return False
        along = axes_in(normal)
        ground = self._places(level)
        ground = ground[on_plane(ground, plane, thickness)]
        lies, ground = (own - centre) @ along.T, (ground - centre) @ along.T
        if _spread(lies) >= _SMALL * _spread(ground):
            return False
        foot = lies[height <= np.quantile(height, _FOOT)]
        middle = foot.mean(axis=0)
        reach = np.quantile(np.linalg.norm(foot - middle, axis=1), 0.9) + extent / 2
        beside = ground[np.linalg.norm(ground - middle, axis=1) <= reach] - middle
        return len(np.unique(sector_of(beside, _SECTORS))) >= _ROUND * _SECTORS

    def _thickness(self, labels: Labels) -> float:
        return _THICKNESS * self._spacing(labels)

    def _spacing(self, labels: Labels) -> float:
        if labels not in self._spacings:
            self._spacings[labels] = self.points.spacing_of(self._rows(labels))
        return self._spacings[labels]

    def _rows(self, labels: Labels) -> NDArray[np.intp]:
        return np.concatenate([self.rows[row] for row in labels])

    def _places(self, labels: Labels) -> Float64:
        return thinned(self.points.points[self._rows(labels)])


def find_supports(points: PointCloud, cameras: Cameras, labels: PointLabels, *, height: float) -> Supports:
    """Where the labels of `points` lie, and which way is up; height: see `Supports`."""
    rows_of = rows_by_label(labels.label)
    rows = [rows_of[name] for name in np.unique(labels.label[labels.label > 0]).tolist()]
    return Supports(rows, points, up_of(cameras.world_to_camera), middle_of(cameras), height)


def _wide(places: Float64, plane: Plane, thickness: float) -> bool:
    """Whether points [N, 3] on a plane show that it is one: they are spread farther along it than across."""
    along = places @ axes_in(plane[1]).T
    return bool(np.linalg.eigvalsh(np.cov(along.T))[0] >= (_WIDE * thickness) ** 2)


def _spread(places: Float64) -> float:
    """How much area points [N, 2] take, but for a factor that is the same for all of one shape."""
    return float(np.sqrt(max(np.linalg.det(np.cov(places.T)), 0)))
