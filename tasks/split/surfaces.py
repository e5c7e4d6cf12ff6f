"""Which labels are one surface: parted by a shadow, by what stands on it, or by nothing at all. Beyond Split&Splat.

A segmenter cuts at a hard shadow as at the edge of a print (`shadows` tells them apart). Where the colour does not
change at all from one label to the other, the views' masks end somewhere, but nothing ends there. And a flat surface
goes on under what stands on it (`gaps`).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ss_flow.tasks.artifacts import Float64, Int32
from ss_flow.tasks.geometry.clustering import rows_by_label
from ss_flow.tasks.geometry.shape import extent_of, middle_of, on_plane, plane_of_most, thinned, towards
from ss_flow.tasks.ranges import Count, Fraction
from ss_flow.tasks.split.gaps import bridged
from ss_flow.tasks.split.looks import Looks
from ss_flow.tasks.split.shadows import OTHER, Touches, bright, find_shadows, find_touches, logarithms
from ss_flow.tasks.split.votes.color_histograms import bins_of, histogram, likeness
from ss_flow.tasks.split.votes.smoothing import smooth
from ss_flow.tasks.split.votes.touching import Borders, TouchingParams

_OPEN = 0.2
"""Least share of a common border at which the colour stays nevertheless: a poster's outline shows all along."""
_ACROSS = 2
"""How many points beside one carry another label where its own label ends, as in `votes.touching`."""
_ROUNDS = 8
_FILLED = 30
"""How often points without a label take that of their neighbours, to tell which labels touch."""
_FEW = 100
"""Points below which a label that touches no other has no plane."""

Meeting = dict[tuple[int, int], bool | None]
"""Which surfaces touch: see `_meeting`."""


@dataclass(frozen=True)
class ShadowParams:
    """When two labels are one surface, across the border of a shadow or without a border that can be seen."""

    agreement: Fraction = 0.6
    """What this counts as beside the agreement of views (see `split.granularity`); 0 = surfaces are not looked for."""
    repeats: Count = 2
    """Other borders, on parallel surfaces of another hue, that must show the same step: one may be chance."""
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
    not in it. At least the points' spacing."""
    min_points: Count = 10
    """Points on both sides at which two labels must touch."""
    gap: Fraction = 0.3
    """Longest gap that what lies or stands on a surface leaves between two pieces of it, as a share of the extent of
    the smaller one; 0 = they must touch."""


def lit_surfaces(looks: Looks, label: Int32, ends: Borders, params: ShadowParams) -> Int32:
    """[L + 1] the lowest label of the surface that each label is a piece of; itself where it is all of one.

    label: [N] of the cloud's points, 0 = none; ends: their borders. Round by round, the labels are united that lie
    in one plane and touch without an edge where light alone, or nothing, tells them apart: those that do so along
    the largest share of a border first, each once a round. When none are left, those of one colour that lie in one
    plane and touch nowhere, but between which the views see only what is on it.
    """
    if not params.agreement or not label.any():
        return np.arange(int(label.max(initial=0)) + 1, dtype=np.int32)
    cloud, eye = looks.cloud, middle_of(looks.cameras)
    found = _Surfaces(looks, label, params)
    shadows = find_shadows(cloud, label, ends, eye, min_points=params.min_points, repeats=params.repeats)
    # Between the things that stand on a table, and along shadows, its points have no label: masks do not agree there.
    filled = smooth(label, label == 0, cloud.points, cloud.spacing, _FILLED)
    touches = find_touches(cloud, label, filled, eye, shadows)
    while True:
        meeting = _meeting(touches, found.surface, filled, params)
        if not found.unite(found.touching(meeting)) and not found.unite(found.apart(meeting)):
            return found.surface


class _Surfaces:
    """What surfaces the labels of a cloud are pieces of, as far as that is found.

    surface: [L + 1] the lowest label of each label's.
    """

    def __init__(self, looks: Looks, label: Int32, params: ShadowParams) -> None:
        self.surface = np.arange(int(label.max()) + 1, dtype=np.int32)
        self._looks = looks
        self._cloud = cloud = looks.cloud
        self._label = label
        self._params = params
        self._bins, self._brightness = bins_of(cloud.colors), logarithms(cloud.colors)
        self._taken = set[int]()

    def unite(self, pairs: Iterable[tuple[int, int]]) -> bool:
        """Make each pair of surfaces one; no surface may occur twice. Returns whether there were any."""
        self._taken = set()
        for a, b in pairs:
            self._taken |= {a, b}
            self.surface[self.surface == max(a, b)] = min(a, b)
        return bool(self._taken)

    def touching(self, meeting: Meeting) -> Iterator[tuple[int, int]]:
        """Pairs that light alone, or nothing, tells apart where they touch, each surface once."""
        rows_of = rows_by_label(self.surface[self._label])
        for (a, b), stays in meeting.items():
            if stays is not None and not self._taken & {a, b}:
                rows = rows_of[a], rows_of[b]
                if (stays or self._of_one_color(rows)) and self._common_plane(rows):
                    yield a, b

    def apart(self, meeting: Meeting) -> Iterator[tuple[int, int]]:
        """Pairs of one colour in one plane that do not touch but for what lies or stands between them, each surface
        once."""
        of = self.surface[self._label]
        rows_of = rows_by_label(of)
        for larger, smaller, longest in self._near(rows_of) if self._params.gap else ():
            if self._taken & {larger, smaller} or (min(larger, smaller), max(larger, smaller)) in meeting:
                continue
            rows = rows_of[larger], rows_of[smaller]
            plane = self._common_plane(rows)
            if plane is None or not self._of_one_color(rows):
                continue
            centre, normal, thickness = plane
            faces = centre, towards(normal, centre, middle_of(self._looks.cameras))
            color = np.median(self._brightness[np.concatenate(rows)], axis=0)
            alike = np.asarray((np.abs(self._brightness - color) < OTHER).all(axis=1))
            if bridged(self._looks, of, larger, smaller, faces, alike, thickness=thickness, longest=longest):
                yield larger, smaller

    def _near(self, rows_of: dict[int, NDArray[np.intp]]) -> list[tuple[int, int, float]]:
        """The pairs of flat surfaces between whose boxes the gap is not too long, the larger one first in each, and the
        largest first; with each, how long a gap may be."""
        names, boxes, longest = list[int](), list[Float64](), list[float]()
        for name in sorted(rows_of.keys() - {0}, key=lambda name: (-len(rows_of[name]), name)):
            rows = rows_of[name]
            if len(rows) >= _FEW and self._common_plane((rows, rows)) is not None:
                places = self._cloud.points[rows].astype(np.float64)
                names.append(name)
                boxes.append(np.stack([places.min(axis=0), places.max(axis=0)]))
                longest.append(self._params.gap * extent_of(places))
        if not names:
            return []
        low, high = np.stack(boxes, axis=1)
        between = np.linalg.norm(np.maximum(low[:, None] - high, low - high[:, None]).clip(0), axis=2)
        pairs = np.argwhere(np.triu(between <= np.array(longest), 1))
        return [(names[a], names[b], longest[b]) for a, b in pairs.tolist()]

    def _of_one_color(self, rows: tuple[NDArray[np.intp], NDArray[np.intp]]) -> bool:
        """Whether two sets of points have the same colours all over; black tells nothing."""
        if self._params.colors == 1:
            return False
        first, second = (np.median(self._brightness[part], axis=0) for part in rows)
        if (np.abs(first - second) >= OTHER).any() or not bright(first[None])[0]:
            return False
        spread = TouchingParams().color_spread
        return likeness(*(histogram(self._bins[part], spread) for part in rows)) >= self._params.colors

    def _common_plane(self, rows: tuple[NDArray[np.intp], NDArray[np.intp]]) -> tuple[Float64, Float64, float] | None:
        """The plane of the larger of two sets of points, with its thickness; None where not most of each lies on it."""
        larger, smaller = (thinned(self._cloud.points[part]) for part in sorted(rows, key=len, reverse=True))
        spacing = max(self._cloud.spacing_of(part) for part in rows)
        thickness = max(self._params.thickness * extent_of(smaller), spacing)
        plane = plane_of_most(larger, thickness, _ROUNDS)
        if any(on_plane(part, plane, thickness).mean() < self._params.flat for part in (larger, smaller)):
            return None
        return *plane, thickness


def _meeting(touches: Touches, surface: Int32, label: Int32, params: ShadowParams) -> Meeting:
    """The pairs of surfaces that touch, lower one first, those that do so along the largest share of a border first:
    whether light alone tells them apart there, or None where a border shows. If not light alone, their own points
    touch.

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
        here = kept[of == number]
        share = max(len(np.unique(touches.point[here[a[here] == name]])) / max(length[name], 1) for name in (low, high))
        if len(here) < params.min_points or share < params.contact:
            continue
        alike = touches.alike[here].mean()
        stays = bool(alike >= params.alike)
        if stays or touches.known[here].sum() >= params.min_points:
            found.append((-share, low, high, stays if alike >= min(_OPEN, params.alike) else None))
    return {(low, high): stays for _, low, high, stays in sorted(found, key=lambda pair: pair[:3])}
