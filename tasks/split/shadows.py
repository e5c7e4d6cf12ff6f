"""Which labels are one surface: parted by a shadow, or by nothing that can be seen. Beyond Split&Splat.

A segmenter cuts at a hard shadow as at the edge of a print. One lamp lights the whole scene, though: of each colour of
light, a shadow leaves a share that depends on how a surface is turned towards lamp and sky, and not on its own colour
(Lambert). So a step that parallel surfaces of different colours show alike is a shadow's; paint would have to be
darker by the same factor on both. Where no step repeats so, no shadow is presumed. And where the colour does not change
at all from one label to the other, the views' masks end somewhere, but nothing ends there.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ss_flow.tasks.artifacts import Bool, Cameras, Float64, Int32, PointCloud, UInt8
from ss_flow.tasks.geometry.shape import box_diagonal, middle_of, plane_through, thinned, towards
from ss_flow.tasks.ranges import Count, Fraction
from ss_flow.tasks.split.votes.color_histograms import bins_of, histogram, likeness
from ss_flow.tasks.split.votes.smoothing import smooth
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
_OTHER = 0.3
"""Difference between two colours, in one logarithm, from which on their surfaces are of different colours."""
_PARALLEL = 0.95
"""Cosine of the normals of surfaces on which a shadow makes the same step."""
_OPEN = 0.2
"""Least share of a common border at which the colour stays nevertheless: a poster's outline shows all along."""
_REST = 0.15
"""By how much a change of colour may differ, in each logarithm, from a share of a shadow's step."""
_SHARE = (-0.2, 1.25)
"""Least and greatest such share: where labels do not end at the shadow itself, the change is less than the step."""
_ACROSS = 2
"""How many points beside one carry another label where its own label ends, as in `votes.touching`."""
_TRIM = 0.02
"""Share of the points, on every side, that an extent leaves out."""
_MOST = 2000
"""So many points of a label tell its plane."""
_ROUNDS = 8
_FILLED = 30
"""How often points without a label take that of their neighbours, to tell which labels touch."""


@dataclass(frozen=True)
class ShadowParams:
    """When two labels are one surface, across the border of a shadow or without a border that can be seen."""

    agreement: Fraction = 0.6
    """What this counts as beside the agreement of views (see `split.granularity`); 0 = surfaces are not looked for."""
    repeats: Count = 2
    """Other borders, on parallel surfaces of other colours, that must show the same step: one may be chance."""
    alike: Fraction = 0.75
    """Share of their common border at which the colour stays, or changes as into a shadow."""
    colors: Fraction = 0.95
    """Or else, cosine of both colour histograms from which on they are of one colour, whatever lies along most of their
    border: a part of a shadow, or the joint of two planks. 1 = the border alone tells."""
    contact: Fraction = 0.03
    """Share of the border of one of them along which they touch without an edge: not much of a table's top is left
    between the things that stand on it."""
    flat: Fraction = 0.6
    """Share of the points of each that must lie on one plane."""
    thickness: Fraction = 0.01
    """Distance from the plane up to which they do, as a share of the extent of the smaller one: a book lies on a table,
    not in it. At least the cloud's spacing."""
    min_points: Count = 10
    """Points on both sides at which two labels must touch."""


@dataclass(frozen=True)
class _Step:
    """How the colour changes where two labels touch."""

    change: Float64
    """[3] from the lit side to the dark one: natural logarithms of R, G and B, linear light."""
    lit: Float64
    """[3] the lit side's colour, in the same."""
    normal: Float64
    """[3] of the surface there, towards the cameras."""

    def repeats(self, other: _Step) -> bool:
        """Whether parallel surfaces of different colours show the same step."""
        same = (np.abs(self.change - other.change) <= _SAME).all()
        different = (np.abs(self.lit - other.lit) >= _OTHER).any()
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
class _Touches:
    """Where labels touch without an edge, and whether light alone tells them apart there."""

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


def lit_surfaces(cloud: PointCloud, cameras: Cameras, label: Int32, ends: Borders, params: ShadowParams) -> Int32:
    """[L + 1] the lowest label of the surface that each label is a piece of; itself where it is all of one.

    label: [N] of the cloud's points, 0 = none; ends: their borders. Round by round, the labels are united that lie in
    one plane and touch without an edge where light alone, or nothing, tells them apart: those that do so along the
    largest share of a border first, each once a round.
    """
    surface = np.arange(int(label.max(initial=0)) + 1, dtype=np.int32)
    if not params.agreement or not label.any():
        return surface
    eye = middle_of(cameras)
    shadows = _shadows(cloud, label, ends, eye, params)
    # Between the things that stand on a table, and along shadows, its points have no label: masks do not agree there.
    filled = smooth(label, label == 0, cloud.points, cloud.spacing, _FILLED)
    touches = _touches(cloud, label, filled, eye, shadows)
    bins, brightness = bins_of(cloud.colors), _logarithms(cloud.colors)
    while True:
        taken: set[int] = set()
        for a, b, stays in _meeting(touches, surface, filled, params):
            if taken & {a, b}:
                continue
            of = surface[label]
            rows = np.flatnonzero(of == a), np.flatnonzero(of == b)
            if (stays or _of_one_color(bins, brightness, rows, params)) and _in_one_plane(cloud, *rows, params):
                taken |= {a, b}
                surface[surface == b] = a
        if not taken:
            return surface


def _of_one_color(
    bins: Int32, brightness: Float64, rows: tuple[NDArray[np.intp], NDArray[np.intp]], params: ShadowParams
) -> bool:
    """Whether two sets of points have the same colours all over; black tells nothing.

    bins: [N] of all points' colours; brightness: [N, 3] their logarithms.
    """
    if params.colors == 1:
        return False
    first, second = (np.median(brightness[part], axis=0) for part in rows)
    if (np.abs(first - second) >= _OTHER).any() or not _bright(first[None])[0]:
        return False
    spread = TouchingParams().color_spread
    return likeness(*(histogram(bins[part], spread) for part in rows)) >= params.colors


def _shadows(cloud: PointCloud, label: Int32, ends: Borders, eye: Float64, params: ShadowParams) -> list[_Step]:
    """The steps that enough other borders repeat."""
    colors = _across(cloud, label, label, ends, _around(cloud, ends))
    steps = []
    for contact in _contacts(cloud, label, ends, colors, eye):
        if len(contact.of) >= params.min_points:
            step = _step(contact.change, colors.own[contact.of], contact.first, contact.normal)
            if step is not None:
                steps.append(step)
    return [step for step in steps if sum(step.repeats(other) for other in steps) >= params.repeats]


def _touches(cloud: PointCloud, label: Int32, filled: Int32, eye: Float64, shadows: list[_Step]) -> _Touches:
    """Where labels touch without an edge, and where the colour stays there or changes as into one of the shadows.

    filled: [N] the labels, and for points without one that of their neighbours. That the colour stays is told by points
    that have a label of themselves: what fills a gap beside a sheet of paper is table.
    """
    ends = borders(filled, cloud, TouchingParams())
    near = _around(cloud, ends)
    colors = _across(cloud, label, filled, ends, near)
    alike = _stays(colors)
    if shadows:
        for contact in _contacts(cloud, filled, ends, _across(cloud, filled, filled, ends, near), eye):
            for step in shadows:
                shaded = _shaded(contact.change, step.change)
                if step.normal @ contact.normal >= _PARALLEL and shaded.sum() > alike[contact.of].sum():
                    alike[contact.of] = shaded
    known = np.asarray(np.isfinite(colors.change).all(axis=1))
    return _Touches(ends.rows, ends.beside, ends.smooth[0], ends.smooth[1], alike, known)


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


def _stays(colors: _Colors) -> Bool:
    """[T] where no change of colour can be seen; black tells nothing."""
    return np.asarray(_bright(colors.own) & (np.abs(colors.change) < _OTHER).all(axis=1))


def _bright(brightness: Float64) -> Bool:
    """[N] which logarithms [N, 3] are of more than black."""
    return np.asarray((brightness > _logarithms(np.full(3, _DARKEST, np.uint8)) + 1e-6).any(axis=1))


def _around(cloud: PointCloud, ends: Borders) -> Int32:
    """[T, _NEAR] the points near each touch without an edge, -1 for none."""
    from scipy.spatial import cKDTree

    tree = cKDTree(cloud.points)
    reach = TouchingParams().reach * cloud.spacing
    places = cloud.points[ends.rows[ends.smooth[0]]]
    _, near = tree.query(places, k=np.arange(1, _NEAR + 1), distance_upper_bound=reach)
    return np.where(near < tree.n, near, -1).astype(np.int32)


def _across(cloud: PointCloud, shown: Int32, label: Int32, ends: Borders, near: Int32) -> _Colors:
    """The colours on both sides where labels [N] touch without an edge, by the points near that `shown` labels so."""
    color = _logarithms(cloud.colors)[near]
    own, touched = label[ends.rows[ends.smooth[0]]], ends.smooth[1]
    sides = [(near >= 0) & (shown[near] == of[:, None]) for of in (own, touched)]
    count = [side.sum(axis=1)[:, None] for side in sides]
    here, there = (
        np.where(n > 0, np.einsum("tk,tkc->tc", side, color) / np.maximum(n, 1), np.nan)
        for side, n in zip(sides, count, strict=True)
    )
    return _Colors(np.where(sides[0] | sides[1], near, -1), there - here, here)


def _logarithms(colors: UInt8) -> Float64:
    """Natural logarithms of colours [N, 3] in linear light."""
    return np.asarray(_GAMMA * np.log(np.maximum(colors, _DARKEST) / 255))


def _step(change: Float64, color: Float64, first: Bool, normal: Float64) -> _Step | None:
    """The step between two labels, if it may be a shadow's.

    change: [T, 3] from the first label to the second. color: [T, 3] of one side, which is the first label's where
    `first` [T].
    """
    step = np.median(change, axis=0)
    lit = first
    if step.mean() > 0:
        step, change, lit = -step, -change, ~first
    depth = -float(step.mean())
    if not _DEPTH[0] <= depth <= _DEPTH[1] or np.ptp(step) > _TINT * depth or not lit.any():
        return None
    if (np.median(np.abs(change - step), axis=0) > _UNEVEN).any():
        return None
    return _Step(step, np.median(color[lit], axis=0), normal)


def _shaded(change: Float64, step: Float64) -> Bool:
    """[T] which changes of colour are a share of a shadow's step, all of them into the shadow or all out of it."""
    share = change @ step / (step @ step)
    near = (np.abs(change - share[:, None] * step) <= _REST).all(axis=1)
    into, out = (near & (sign * share >= _SHARE[0]) & (sign * share <= _SHARE[1]) for sign in (1, -1))
    return into if into.sum() >= out.sum() else out


def _meeting(touches: _Touches, surface: Int32, label: Int32, params: ShadowParams) -> list[tuple[int, int, bool]]:
    """The pairs of surfaces that may be one, those that touch along the largest share of a border first; and of each
    whether light alone tells them apart there. Otherwise their own points touch.

    surface: [L + 1] of each label. label: [N] of the points.
    """
    own = surface[label[touches.rows]]
    at_border = (surface[label[touches.beside]] != own[:, None]).sum(axis=1) >= _ACROSS
    length = np.bincount(own[at_border], minlength=len(surface))
    a, b = own[touches.point], surface[touches.touched]
    kept = np.flatnonzero(at_border[touches.point] & (a != b))
    pairs, of = np.unique(np.sort(np.stack([a[kept], b[kept]]), axis=0), axis=1, return_inverse=True)
    found = []
    for number, (low, high) in enumerate(pairs.T.tolist()):
        here = kept[of.ravel() == number]
        alike = touches.alike[here].mean()
        stays = bool(alike >= params.alike)
        if alike < min(_OPEN, params.alike) or (here if stays else here[touches.known[here]]).size < params.min_points:
            continue
        share = max(len(np.unique(touches.point[here[a[here] == name]])) / max(length[name], 1) for name in (low, high))
        if share >= params.contact:
            found.append((-share, low, high, stays))
    return [(low, high, stays) for _, low, high, stays in sorted(found)]


def _in_one_plane(cloud: PointCloud, a: NDArray[np.intp], b: NDArray[np.intp], params: ShadowParams) -> bool:
    """Whether most of two sets of points (rows) lies on the plane of the larger one."""
    larger, smaller = (thinned(cloud.points[part], _MOST) for part in sorted((a, b), key=len, reverse=True))
    thickness = max(params.thickness * box_diagonal(smaller, _TRIM), cloud.spacing)
    near = np.ones(len(larger), bool)
    for _ in range(_ROUNDS):
        centre, normal = plane_through(larger[near])
        distance = np.abs((larger - centre) @ normal)
        near = distance <= max(thickness, float(np.median(distance)))
    return all((np.abs((part - centre) @ normal) <= thickness).mean() >= params.flat for part in (larger, smaller))
