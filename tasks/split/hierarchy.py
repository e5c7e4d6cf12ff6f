"""Which labels are pieces of one thing: a tree over all views, from how often a mask shows several of them as one.

A segmenter shows the box, its faces and the label printed on it, and often the box with what stands beside it. The
level that is a thing is the one that the views repeat: most views which see two pieces of it have a mask with just
these pieces, and the segmenter is as sure of that mask as of those of the pieces. Three things are known without masks:
what light alone or nothing parts is one surface, what touches nothing but walls and floors stands alone, and what meets
in a convex edge are faces of one thing, unless the views deny it. Beyond Split&Splat.
"""

from __future__ import annotations

import functools
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from ss_flow.task import task
from ss_flow.tasks.artifacts import (
    Bool,
    Cameras,
    Float32,
    Float64,
    Hierarchy,
    Int32,
    PointCloud,
    PointLabels,
    Tally,
    Visibility,
)
from ss_flow.tasks.geometry.clustering import rows_by_label
from ss_flow.tasks.ranges import Count, Fraction, NonNegative
from ss_flow.tasks.split.edges import convex_edges
from ss_flow.tasks.split.mounds import Mounds, find_contact, find_mounds
from ss_flow.tasks.split.shadows import ShadowParams, lit_surfaces
from ss_flow.tasks.split.sheets import Sheets, find_sheets
from ss_flow.tasks.split.stuff import StuffParams, find_stuff
from ss_flow.tasks.split.votes.touching import TouchingParams, borders

_IOU = (0.5, 0.8)
"""IoU of a mask with the pieces from which on it begins to show them as one, and from which it does."""
_REST = (0.3, 0.7)
"""The same for the share that it holds of all but the largest piece, which alone may make up most of the IoU."""
_OWN = 0.75
"""IoU with a single piece from which a mask is the piece's own."""
_BALANCED = 0.1
"""Share of the smaller pieces in what a view sees of all, from which on the view counts in full."""
_ON_TOP = 0.5
"""What is left of an agreement when one piece stands on the others: the views show a group."""
_ALONE = 0.5
"""Share of what pieces touch, other than stuff, that must be of their own set for it to begin to stand alone."""
_TOUCH = 10.0
"""Border points of other things that are presumed, so that a faint touch proves nothing."""
_TOGETHER = 0.5
"""Share of the views which see two pieces that must hold them under one mask, whatever else it holds, so that a convex
edge between them makes them faces of one thing."""
_MOST_SETS = 2000
"""Sets of pieces that are weighed in a round: those that the most masks show."""


@dataclass(frozen=True)
class HierarchyParams:
    """What counts as being shown as one thing."""

    doubt: Fraction = 0.2
    """By how much the segmenter may be surer of a piece than of the whole (predicted IoU times stability) before the
    whole no longer counts; from nothing to this, it counts less and less."""
    prior: NonNegative = 1.0
    """So many views more are taken to have been asked about each union, so that one view alone does not decide."""
    prior_agreement: Fraction = 0.2
    """Share of these that are taken to show it. If none did, what only a few views can see would come apart."""
    min_agreement: Fraction = 0.2
    """Agreement below which pieces are not united even to a group."""
    min_points: Count = 10
    """Points of a piece that a view must see to count."""
    min_visible: Fraction = 0.2
    """Share of the points that any view sees of a piece, which a view must see to count."""
    around: Fraction = 0.8
    """Share of its border with other labels along which a piece is surrounded by what it stands on."""
    bulge: Fraction = 0.09
    """How far it must rise from there, as a share of its extent, where its colours are half like those around it; the
    farther, the more they are alike. A bag on a sofa is no part of the sofa, but its arm is."""
    flush: Fraction = 0.6
    """Share of its border along which a flat piece goes on without an edge into something larger: a mug on a page that
    lies on a table is no part of the page. 1 = none does."""
    stuff: StuffParams = field(default_factory=StuffParams)
    """What is a wall or a floor rather than a thing."""
    shadows: ShadowParams = field(default_factory=ShadowParams)
    """What is one surface, in light and shadow or without a border that can be seen, whatever the masks say."""
    alone: Fraction = 0.3
    """Share by which an agreement rises towards 1 where the pieces touch each other and stuff, and nothing else: a
    chair on a floor. Less where they touch other things, down to nothing at half of what they touch."""
    convex: Fraction = 0.46
    """Agreement that two pieces have at least where they meet in a convex edge, as the faces of a box do, and half of
    the views that see both hold them under one mask. Just above the default of `split.granularity`, so that what the
    views show as one comes first. 0 = convex edges are not looked for."""


@task(name="split.hierarchy")
def hierarchy(
    points: PointCloud,
    cameras: Cameras,
    visibility: Sequence[Visibility],
    labels: PointLabels,
    tallies: Sequence[Tally],
    *,
    params: HierarchyParams,
) -> Hierarchy:
    """The tree of what the labels make up.

    visibility, tallies: one of each a view; labels: of `points`. What light alone or nothing parts is united first.
    Then, round by round, the sets of pieces with the highest agreement are, each piece once a round, until none reaches
    `min_agreement`; a thing and stuff never are. The order of the views does not matter, nor that of the masks.
    """
    names = np.unique(labels.label[labels.label > 0]).astype(np.int32)
    ends = borders(labels.label, points, TouchingParams())
    surface = lit_surfaces(points, cameras, labels.label, ends, params.shadows)
    _, surface_of = np.unique(surface[names], return_inverse=True)
    is_stuff = find_stuff(points, cameras, replace(labels, label=surface[labels.label]), params.stuff)[surface_of]
    mounds = find_mounds(points, cameras, labels, tallies, ends, around=params.around, height=params.bulge)
    contact = find_contact(ends, labels.label)
    sheets = find_sheets(points, labels, ends, flush=params.flush, height=params.bulge)
    edges = np.zeros((len(names), len(names)), bool)
    if params.convex:
        edges = convex_edges(points, cameras, visibility, labels.label, ends)
    pieces = _Pieces.of(names, tallies, is_stuff, contact, edges, mounds, sheets, params)
    node, parent, agreement, stuff = names.tolist(), [0] * len(names), [1.0] * len(names), is_stuff.tolist()
    top = list(range(len(names)))  # the tree's row of each piece
    lit = [tuple(rows.tolist()) for rows in rows_by_label(surface_of.astype(np.int32)).values() if len(rows) > 1]
    united = [(members, params.shadows.agreement) for members in lit] or pieces.best_unions()
    while united:
        for members, share in united:
            row = len(node)
            node.append(labels.num_labels + 1 + row - len(names))
            parent.append(0)
            agreement.append(share)
            stuff.append(stuff[top[members[0]]])
            for piece in members:
                parent[top[piece]] = node[row]
            top.append(row)
        left = sorted(set(range(len(top))) - {piece for members, _ in united for piece in members})
        pieces = pieces.united([members for members, _ in united])
        top = [top[piece] for piece in left]
        united = pieces.best_unions()
    return Hierarchy(
        np.array(node, np.int32), np.array(parent, np.int32), np.array(agreement, np.float32), np.array(stuff, bool)
    )


@dataclass(frozen=True)
class _View:
    """One view's counts, a column for each piece; 0 where it sees too little of a piece."""

    seen: Float32
    """[G]."""
    held: Float32
    """[M, G]."""
    quality: Float64
    """[M] how sure the segmenter is of each mask."""
    own: Float64
    """[G] quality of the best mask that is a piece's own, 0 where there is none."""


@dataclass(frozen=True)
class _Pieces:
    """G pieces that may be united, and what the K views say about sets of them."""

    seen: list[Float32]
    """K x [G] points of each piece that a view sees."""
    held: list[Float32]
    """K x [M, G] those under each of its masks."""
    quality: list[Float64]
    """K x [M] how sure the segmenter is of each mask."""
    stuff: Bool
    """[G]."""
    contact: Float32
    """[G, G] points at which each touches each other one, from both sides."""
    edges: Bool
    """[G, G] which meet in a convex edge."""
    labels: list[tuple[int, ...]]
    """G x the labels (rows) that each is made of."""
    mounds: Mounds
    sheets: Sheets
    params: HierarchyParams

    @staticmethod
    def of(
        names: Int32,
        tallies: Sequence[Tally],
        stuff: Bool,
        contact: Float32,
        edges: Bool,
        mounds: Mounds,
        sheets: Sheets,
        params: HierarchyParams,
    ) -> _Pieces:
        """Each label on its own."""
        seen, held, quality = [], [], []
        for tally in {_content(tally): tally for tally in tallies}.values():  # a second copy of a view says nothing
            column = np.searchsorted(names, tally.label)
            seen.append(np.zeros(len(names), np.float32))  # counts are exact in it, and take half the memory
            seen[-1][column] = tally.seen
            held.append(np.zeros((len(tally.held), len(names)), np.float32))
            held[-1][:, column] = tally.held
            quality.append(tally.quality.astype(np.float64))
        own: list[tuple[int, ...]] = [(row,) for row in range(len(names))]
        return _Pieces(seen, held, quality, stuff, contact, edges, own, mounds, sheets, params)

    @functools.cached_property
    def views(self) -> list[_View]:
        """What counts of each view."""
        most = np.max(self.seen, axis=0, initial=0)
        views = []
        for of_view, under, sure in zip(self.seen, self.held, self.quality, strict=True):
            enough = (of_view >= self.params.min_points) & (of_view >= self.params.min_visible * most)
            count, inside = of_view * enough, under * enough
            iou = inside / np.maximum(inside.sum(axis=1, keepdims=True) + count - inside, 1)
            own = np.where(iou >= _OWN, sure[:, None], 0).max(axis=0, initial=0)
            views.append(_View(count, inside, sure, own))
        return views

    def united(self, unions: list[tuple[int, ...]]) -> _Pieces:
        """What is left when each of these sets has become one piece: the others first, then the unions."""
        count = len(self.stuff)
        gone = {piece for members in unions for piece in members}
        groups: list[tuple[int, ...]] = [*((piece,) for piece in range(count) if piece not in gone), *unions]
        joined = np.zeros((count, len(groups)), np.float32)
        for column, members in enumerate(groups):
            joined[list(members), column] = 1
        return replace(
            self,
            seen=[seen @ joined for seen in self.seen],
            held=[held @ joined for held in self.held],
            stuff=self.stuff[[members[0] for members in groups]],
            contact=(joined.T @ self.contact @ joined * ~np.eye(len(groups), dtype=bool)).astype(np.float32),
            edges=joined.T @ self.edges @ joined * ~np.eye(len(groups), dtype=bool) > 0,
            labels=[tuple(row for piece in members for row in self.labels[piece]) for members in groups],
        )

    def best_unions(self) -> list[tuple[tuple[int, ...], float]]:
        """The sets of pieces to unite now, each with its agreement: of sets that share a piece, the best alone."""
        sets, group = self._sets()
        faces = self._faces()
        unshown = sorted(faces - set(sets))
        sets, group = sets + unshown, group + [False] * len(unshown)
        if not sets:
            return []
        member = np.zeros((len(sets), len(self.stuff)), np.float32)
        for row, members in enumerate(sets):
            member[row, list(members)] = 1
        agreement = self._agreement(member)
        agreement += (1 - agreement) * self.params.alone * self._alone(member)
        least = np.where([members in faces for members in sets], self.params.convex, 0)
        agreement = np.maximum(agreement * np.where(group, _ON_TOP, 1.0), least).astype(np.float64).round(6)
        taken: set[int] = set()
        chosen = []
        for row in sorted(range(len(sets)), key=lambda row: (-agreement[row], len(sets[row]), sets[row])):
            if agreement[row] < max(self.params.min_agreement, 1e-6):
                break
            if not taken & set(sets[row]):
                chosen.append((sets[row], float(agreement[row])))
            taken |= set(sets[row])
        return chosen

    def _sets(self) -> tuple[list[tuple[int, ...]], list[bool]]:
        """The sets of pieces that masks show: those of which a mask holds at least half; and these without what stands
        on the others. With each, whether something still does."""
        shown: Counter[tuple[int, ...]] = Counter()
        for view in self.views:
            for held in (view.held >= 0.5 * view.seen) & (view.seen > 0):
                members = tuple(np.flatnonzero(held).tolist())
                if len(members) > 1 and len(set(self.stuff[list(members)].tolist())) == 1:
                    shown[members] += 1
        on_top = {members: self._standing(members) for members in shown}
        for members, times in list(shown.items()):
            below = tuple(piece for piece in members if piece not in on_top[members])
            if 1 < len(below) < len(members):
                shown[below] += times
                on_top.setdefault(below, self._standing(below))
        sets = [members for members, _ in sorted(shown.items(), key=lambda item: (-item[1], item[0]))[:_MOST_SETS]]
        return sets, [bool(on_top[members]) for members in sets]

    def _faces(self) -> set[tuple[int, ...]]:
        """The pairs of things that meet in a convex edge, and that the views do not deny to be one."""
        a, b = np.nonzero(np.triu(self.edges) & ~self.stuff & ~self.stuff[:, None])
        both, together = np.zeros((2, len(a)))
        for view in self.views:
            seen = view.seen > 0
            holds = (view.held >= 0.5 * view.seen) & seen
            both += seen[a] & seen[b]
            together += (holds[:, a] & holds[:, b]).any(axis=0)
        one = (together > 0) & (together >= _TOGETHER * both)
        return set(zip(a[one].tolist(), b[one].tolist(), strict=True))

    def _standing(self, members: tuple[int, ...]) -> set[int]:
        """Which of these pieces stand on the others."""
        labels = [row for piece in members for row in self.labels[piece]]
        on_top = dict(zip(labels, self.mounds.standing(labels).tolist(), strict=True))
        on_sheet = self.sheets.standing([self.labels[piece] for piece in members])
        risen = zip(members, on_sheet.tolist(), strict=True)
        return {piece for piece, rises in risen if rises or all(on_top[row] for row in self.labels[piece])}

    def _alone(self, member: Float32) -> Float64:
        """[S] how far each set of pieces [S, G] stands alone, 0..1: whether it touches nothing but itself and stuff."""
        inside = np.einsum("sg,gh,sh->s", member, self.contact, member, optimize=True) / 2
        outside = np.einsum("sg,gh,sh->s", member, self.contact, (1 - member) * ~self.stuff, optimize=True)
        things = (member @ self.stuff) == 0
        return things * _ramp(inside / (inside + outside + _TOUCH), _ALONE, 1.0)

    def _agreement(self, member: Float32) -> Float64:
        """[S] share of the views that show each set of pieces [S, G] as one, of those that see at least two of them:
        the mean of the share's posterior, as a beta distribution with the prior."""
        agreed, asked = np.zeros(len(member)), np.zeros(len(member))
        for view in self.views:
            seen = member * view.seen
            total, largest = seen.sum(axis=1), seen.max(axis=1)
            weight = np.minimum((1 - largest / np.maximum(total, 1)) / _BALANCED, 1)
            rows = np.flatnonzero((total > 0) & (weight > 0))
            asked[rows] += weight[rows]
            if not rows.size or not len(view.held):
                continue
            total, largest, seen = total[rows, None], largest[rows, None], seen[rows]
            inside = member[rows] @ view.held.T
            iou = inside / np.maximum(view.held.sum(axis=1) + total - inside, 1)
            rest = (inside - view.held[:, seen.argmax(axis=1)].T) / (total - largest)
            surest_piece = np.where(seen > 0, view.own, 0).max(axis=1)
            doubt = (surest_piece[:, None] - view.quality) / max(self.params.doubt, 1e-9)
            fit = _ramp(iou, *_IOU) * _ramp(rest, *_REST) * np.clip(1 - doubt, 0, 1)
            agreed[rows] += weight[rows] * fit.max(axis=1)
        prior = self.params.prior
        return (agreed + prior * self.params.prior_agreement) / np.maximum(asked + prior, 1e-9)


def _content(tally: Tally) -> tuple[object, ...]:
    """What a tally says, whatever the order of its masks."""
    masks = sorted((float(quality), held.tobytes()) for quality, held in zip(tally.quality, tally.held, strict=True))
    return tally.label.tobytes(), tally.seen.tobytes(), tuple(masks)


def _ramp(value: Float64, low: float, high: float) -> Float64:
    return np.clip((value - low) / (high - low), 0, 1)
