"""How the colours change where labels touch, and which of these changes are a shadow's. Beyond Split&Splat.

One lamp lights the whole scene: of each colour of light, a shadow leaves a share that depends on how a surface is
turned towards lamp and sky, and not on its own colour (Lambert). So a step that parallel surfaces of different colours
show alike is a shadow's; paint would have to be darker by the same factor on both. So is white paper on a grey wall,
wherever it hangs: a wall that is brighter in one place than in another is no different colour. Where no step repeats
so, no shadow is presumed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ss_flow.tasks.artifacts import Bool, Float64, Int32, PointCloud, UInt8
from ss_flow.tasks.geometry.clustering import nearest_within
from ss_flow.tasks.geometry.shape import plane_through, towards
from ss_flow.tasks.split.votes.touching import Borders, TouchingParams, borders

_GAMMA = 2.2
_DARKEST = 4
"""8-bit step below which a colour is noise."""
_NEAR = 40
"""Nearest points that tell the colours on both sides of a border."""
_DEPTH = (0.3, 1.6)
"""By how much a shadow darkens at least and at most: the mean of the natural logarithms of R, G and B, linear light."""
_TINT = 0.35
"""Difference between these logarithms, as a share of their mean, up to which a step may be a shadow's."""
_UNEVEN = 0.25
"""Median deviation along a border, in each logarithm, up to which it is one step."""
_SAME = 0.12
"""Difference between two steps, in each logarithm, up to which they are the same."""
OTHER = 0.3
"""Difference between two colours, in one logarithm, from which on their surfaces are of different colours."""
_HUE = 0.2
"""Spread of the differences between two colours, in the logarithms, from which on more than the light may differ."""
_PARALLEL = 0.95
"""Cosine of the normals of surfaces on which a shadow makes the same step."""
_REST = 0.15
"""By how much a change of colour may differ, in each logarithm, from a share of a shadow's step."""
_SHARE = (-0.2, 1.25)
"""Least and greatest such share: where labels do not end at the shadow itself, the change is less than the step."""


@dataclass(frozen=True)
class Step:
    """How the colour changes where two labels touch."""

    change: Float64
    """[3] from the lit side to the dark one: natural logarithms of R, G and B, linear light."""
    lit: Float64
    """[3] the lit side's colour, in the same."""
    normal: Float64
    """[3] of the surface there, towards the cameras."""

    def repeats(self, other: Step) -> bool:
        """Whether parallel surfaces of different hues show the same step."""
        same = (np.abs(self.change - other.change) <= _SAME).all()
        different = np.ptp(self.lit - other.lit) >= _HUE
        return bool(same and different and self.normal @ other.normal >= _PARALLEL)


@dataclass(frozen=True)
class _Colors:
    """The colours where labels touch without an edge."""

    near: Int32
    """[T, _NEAR] the points near each touch, of the two labels; -1 for none."""
    change: Float64
    """[T, 3] from the points to the labels that they touch; not a number where a label has no points near."""
    own: Float64
    """[T, 3] on the points' own side."""


@dataclass(frozen=True)
class _Contact:
    """Where two labels touch."""

    of: NDArray[np.intp]
    """[C] which of the touches."""
    first: Bool
    """[C] whether the touch is one of the lower label's points."""
    normal: Float64
    """[3] of the surface there, towards the cameras."""
    change: Float64
    """[C, 3] of the colour there, from the lower label to the higher one."""


@dataclass(frozen=True)
class Touches:
    """Where labels touch without an edge (T touches), and whether light alone tells them apart there."""

    rows: Int32
    """[R] points at the border of their label."""
    beside: Int32
    """[R, B] the points beside each."""
    point: Int32
    """[T] which of the R touches another label."""
    touched: Int32
    """[T] that label."""
    alike: Bool
    """[T] whether the colour stays there, or changes as into a shadow."""
    known: Bool
    """[T] whether both labels have points of their own near, so that no gap is between them."""


def find_shadows(
    cloud: PointCloud, label: Int32, ends: Borders, eye: Float64, *, min_points: int, repeats: int
) -> list[Step]:
    """The steps of colour that enough other borders repeat.

    label: [N] of the cloud's points, 0 = none; ends: their borders. eye: [3] the middle of the cameras. min_points,
    repeats: as in `ShadowParams`.
    """
    colors = _across(cloud, label, label, ends, _around(cloud, ends))
    steps = []
    for contact in _contacts(cloud, label, ends, colors, eye):
        if len(contact.of) >= min_points:
            step = _step(contact.change, colors.own[contact.of], contact.first, contact.normal)
            if step is not None:
                steps.append(step)
    return [step for step in steps if sum(step.repeats(other) for other in steps) >= repeats]


def find_touches(cloud: PointCloud, label: Int32, filled: Int32, eye: Float64, shadows: list[Step]) -> Touches:
    """Where labels touch without an edge, and where the colour stays there or changes as into one of the shadows.

    filled: [N] the labels, and for points without one that of their neighbours; eye: [3] the middle of the cameras.
    That the colour stays is told by points that have a label of themselves: what fills a gap beside a sheet of paper is
    table.
    """
    ends = borders(filled, cloud, TouchingParams())
    near = _around(cloud, ends)
    colors = _across(cloud, label, filled, ends, near)
    # Where no change of colour can be seen, it stays; black tells nothing.
    alike = bright(colors.own) & (np.abs(colors.change) < OTHER).all(axis=1)
    if shadows:
        for contact in _contacts(cloud, filled, ends, _across(cloud, filled, filled, ends, near), eye):
            for step in shadows:
                shaded = _shaded(contact.change, step.change)
                if step.normal @ contact.normal >= _PARALLEL and shaded.sum() > alike[contact.of].sum():
                    alike[contact.of] = shaded
    known = np.asarray(np.isfinite(colors.change).all(axis=1))
    return Touches(ends.rows, ends.beside, ends.smooth[0], ends.smooth[1], alike, known)


def _contacts(cloud: PointCloud, label: Int32, ends: Borders, colors: _Colors, eye: Float64) -> list[_Contact]:
    """The touches without an edge, by the two labels that touch."""
    own, touched = label[ends.rows[ends.smooth[0]]], ends.smooth[1]
    low, high = np.minimum(own, touched), np.maximum(own, touched)
    change = np.where((own == high)[:, None], -colors.change, colors.change)
    order = np.lexsort((high, low))
    starts = np.flatnonzero(np.diff(low[order]) | np.diff(high[order])) + 1
    contacts = []
    for here in np.split(order, starts) if len(order) else []:
        around = np.unique(colors.near[here])
        centre, normal = plane_through(cloud.points[around[around >= 0]].astype(np.float64))
        contacts.append(_Contact(here, (own == low)[here], towards(normal, centre, eye), change[here]))
    return contacts


def bright(brightness: Float64) -> Bool:
    """[N] which colours, as `logarithms` [N, 3], are more than black."""
    return np.asarray((brightness > logarithms(np.full(3, _DARKEST, np.uint8)) + 1e-6).any(axis=1))


def _around(cloud: PointCloud, ends: Borders) -> Int32:
    """[T, _NEAR] the points near each touch without an edge, -1 for none."""
    from scipy.spatial import cKDTree

    tree = cKDTree(cloud.points)
    reach = TouchingParams().reach * cloud.spacing
    rows = ends.rows[ends.smooth[0]]
    near = nearest_within(tree, cloud.points[rows], _NEAR, reach[rows])
    return np.where(near < tree.n, near, -1).astype(np.int32)


def _across(cloud: PointCloud, shown: Int32, label: Int32, ends: Borders, near: Int32) -> _Colors:
    """The colours on both sides where labels [N] touch without an edge, by the points near that `shown` labels so."""
    color = logarithms(cloud.colors)[near]
    own, touched = label[ends.rows[ends.smooth[0]]], ends.smooth[1]
    sides = [(near >= 0) & (shown[near] == of[:, None]) for of in (own, touched)]
    count = [side.sum(axis=1)[:, None] for side in sides]
    here, there = (
        np.where(n > 0, np.einsum("tk,tkc->tc", side, color) / np.maximum(n, 1), np.nan)
        for side, n in zip(sides, count, strict=True)
    )
    return _Colors(np.where(sides[0] | sides[1], near, -1), there - here, here)


def logarithms(colors: UInt8) -> Float64:
    """[N, 3] natural logarithms of 8-bit colours [N, 3], in linear light."""
    return np.asarray(_GAMMA * np.log(np.maximum(colors, _DARKEST) / 255))


def _step(change: Float64, color: Float64, first: Bool, normal: Float64) -> Step | None:
    """The step between two labels, if it may be a shadow's.

    change: [T, 3] from the first label to the second. color: [T, 3] of one side, which is the first label's where
    `first` [T].
    """
    step = np.median(change, axis=0)
    lit = first
    if step.mean() > 0:
        step, change, lit = -step, -change, ~first
    if not may_shade(step) or not lit.any():
        return None
    if (np.median(np.abs(change - step), axis=0) > _UNEVEN).any():
        return None
    return Step(step, np.median(color[lit], axis=0), normal)


def may_shade(change: Float64) -> bool:
    """Whether a change of colour [3], natural logarithms of R, G and B in linear light, may be one into a shadow."""
    depth = -float(change.mean())
    return _DEPTH[0] <= depth <= _DEPTH[1] and bool(np.ptp(change) <= _TINT * depth)


def _shaded(change: Float64, step: Float64) -> Bool:
    """[T] which changes of colour are a share of a shadow's step, all of them into the shadow or all out of it."""
    share = change @ step / (step @ step)
    near = (np.abs(change - share[:, None] * step) <= _REST).all(axis=1)
    into, out = (near & (sign * share >= _SHARE[0]) & (sign * share <= _SHARE[1]) for sign in (1, -1))
    return into if into.sum() >= out.sum() else out
