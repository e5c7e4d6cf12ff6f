"""Which labels are one surface: parted by a shadow, or by nothing that can be seen. Beyond Split&Splat.

A segmenter cuts at a hard shadow as at the edge of a print (`shadows` tells them apart). And where the colour does not
change at all from one label to the other, the views' masks end somewhere, but nothing ends there.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ss_flow.tasks.artifacts import Cameras, Float64, Int32, PointCloud
from ss_flow.tasks.geometry.shape import box_diagonal, middle_of, plane_of_most, thinned
from ss_flow.tasks.ranges import Count, Fraction
from ss_flow.tasks.split.shadows import OTHER, Touches, bright, find_shadows, find_touches, logarithms
from ss_flow.tasks.split.votes.color_histograms import bins_of, histogram, likeness
from ss_flow.tasks.split.votes.smoothing import smooth
from ss_flow.tasks.split.votes.touching import Borders, TouchingParams

_OPEN = 0.2
"""Least share of a common border at which the colour stays nevertheless: a poster's outline shows all along."""
_ACROSS = 2
"""How many points beside one carry another label where its own label ends, as in `votes.touching`."""
_TRIM = 0.02
"""Share of the points, on every side, that an extent leaves out."""
_ENOUGH = 2000
"""At least so many points of a label, and less than twice as many, tell its plane."""
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
    shadows = find_shadows(cloud, label, ends, eye, min_points=params.min_points, repeats=params.repeats)
    # Between the things that stand on a table, and along shadows, its points have no label: masks do not agree there.
    filled = smooth(label, label == 0, cloud.points, cloud.spacing, _FILLED)
    touches = find_touches(cloud, label, filled, eye, shadows)
    bins, brightness = bins_of(cloud.colors), logarithms(cloud.colors)
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
    if (np.abs(first - second) >= OTHER).any() or not bright(first[None])[0]:
        return False
    spread = TouchingParams().color_spread
    return likeness(*(histogram(bins[part], spread) for part in rows)) >= params.colors


def _meeting(touches: Touches, surface: Int32, label: Int32, params: ShadowParams) -> list[tuple[int, int, bool]]:
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
    larger, smaller = (thinned(cloud.points[part], _ENOUGH) for part in sorted((a, b), key=len, reverse=True))
    thickness = max(params.thickness * box_diagonal(smaller, _TRIM), cloud.spacing)
    centre, normal = plane_of_most(larger, thickness, _ROUNDS)
    return all((np.abs((part - centre) @ normal) <= thickness).mean() >= params.flat for part in (larger, smaller))
