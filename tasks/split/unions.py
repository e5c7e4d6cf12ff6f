"""The sets of pieces that are united to one: what the views, and the places of the pieces, say about each.

Masks tell which sets there are. How far the views agree on one is for `agreement` to say; what the pieces touch, what
stands on what, and which edges are convex adds to it, or takes from it. Beyond Split&Splat.
"""

from __future__ import annotations

import functools
from collections import Counter
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ss_flow.tasks.artifacts import Bool, Float32, Float64
from ss_flow.tasks.split.agreement import ONE_THING, View, agreement_of
from ss_flow.tasks.split.contact import Contact
from ss_flow.tasks.split.inlays import Inlays
from ss_flow.tasks.split.mounds import Mounds
from ss_flow.tasks.split.supports import Supports

if TYPE_CHECKING:
    from ss_flow.tasks.split.hierarchy import HierarchyParams

Members = tuple[int, ...]
"""Some pieces, or labels, by their rows, ascending."""

_ON_TOP = ONE_THING
"""What is left of an agreement when one piece stands on the others: the views show a group, and above that no such set
is then. Of a stool alone on a floor all views have one mask with what is on it."""
_TOGETHER = 0.5
"""Share of the views which see two pieces that must hold them under one mask, whatever else it holds, so that a convex
edge between them makes them faces of one thing."""
_MOST_SETS = 2000
"""Sets of pieces that are weighed in a round: those that the most masks show."""


@dataclass(frozen=True)
class Pieces:
    """G pieces that may be united, and what the K views say about sets of them."""

    views: list[View]
    """K."""
    stuff: Bool
    """[G]."""
    contact: Contact
    edges: Bool
    """[G, G] which meet in a convex edge."""
    labels: list[Members]
    """G x the labels (rows) that each is made of."""
    mounds: Mounds
    supports: Supports
    inlays: Inlays
    params: HierarchyParams

    @functools.cached_property
    def counted(self) -> list[View]:
        """What counts of each view: the pieces of which it sees enough."""
        most = np.max([view.seen for view in self.views], axis=0, initial=0)
        least, share = self.params.min_points, self.params.min_visible
        return [view.only((view.seen >= least) & (view.seen >= share * most)) for view in self.views]

    def united(self, unions: list[Members]) -> Pieces:
        """What is left when each of these sets has become one piece: the others first, then the unions."""
        count = len(self.stuff)
        gone = {piece for members in unions for piece in members}
        left = [piece for piece in range(count) if piece not in gone]
        groups: list[Members] = [*((piece,) for piece in left), *unions]
        joined = np.zeros((count, len(groups)), np.float32)
        for column, members in enumerate(groups):
            joined[list(members), column] = 1
        return replace(
            self,
            views=[view.joined(joined) for view in self.views],
            stuff=self.stuff[[members[0] for members in groups]],
            contact=self.contact.joined(joined),
            edges=joined.T @ self.edges @ joined * ~np.eye(len(groups), dtype=bool) > 0,
            labels=[self._labels_of(members) for members in groups],
        )

    def best_unions(self) -> list[tuple[Members, float]]:
        """The sets of pieces to unite now, each with its agreement: of sets that share a piece, the best alone."""
        sets, groups = self._sets()
        presumed = self._presumed()
        sets += sorted(presumed.keys() - set(sets))
        if not sets:
            return []
        least = [presumed.get(members, 0.0) for members in sets]
        member = np.zeros((len(sets), len(self.stuff)), np.float32)
        for row, members in enumerate(sets):
            member[row, list(members)] = 1
        agreement = np.maximum(self._agreements(sets, member, groups), least).round(6)
        taken: set[int] = set()
        chosen = []
        for row in sorted(range(len(sets)), key=lambda row: (-agreement[row], len(sets[row]), sets[row])):
            if agreement[row] < max(self.params.min_agreement, 1e-6):
                break
            if not taken & set(sets[row]):
                chosen.append((sets[row], float(agreement[row])))
            taken |= set(sets[row])
        return chosen

    def _agreements(self, sets: list[Members], member: Float32, groups: dict[Members, tuple[Members, ...]]) -> Float64:
        """How far the views agree on each set, less or more by what its places tell: [S]. member: [S, G] 1 for the
        pieces of each, else 0; groups: as of `_sets`."""
        params = self.params
        agreement = agreement_of(
            self.counted,
            member,
            doubt=params.doubt,
            silent=params.silent,
            prior=params.prior,
            prior_agreement=params.prior_agreement,
        )
        agreement += (1 - agreement) * params.alone * self.contact.alone(member, self.stuff)
        agreement = np.minimum(agreement * (1 + params.contact * (2 * self.contact.own(member) - 1)), 1)
        is_group = np.array([members in groups for members in sets])
        row_of = {members: row for row, members in enumerate(sets)}
        # A mask that holds a page and the mug on it holds each of the two as one, unless the views deny it: what stands
        # on nothing else here may be several things.
        for members in groups.keys() & row_of.keys():
            for row in (row_of[part] for part in groups[members] if part in row_of):
                if not is_group[row] and agreement[row] >= params.min_agreement:
                    agreement[row] = max(agreement[row], agreement[row_of[members]])
        agreement *= np.where(is_group, _ON_TOP, np.where(self.contact.hang_together(member), 1, 1 - params.apart))
        return agreement

    def _sets(self) -> tuple[list[Members], dict[Members, tuple[Members, ...]]]:
        """The sets of pieces that masks show: those of which a mask holds at least half, but of stuff and things the
        stuff alone; and these without what stands on the others. For each set in which something does, what is below,
        and each thing that stands on that."""
        shown: Counter[Members] = Counter()
        for view in self.counted:
            for shows in view.shows:
                stuff = shows & self.stuff
                members = tuple(np.flatnonzero(stuff if stuff.any() else shows).tolist())
                if len(members) > 1:
                    shown[members] += 1
        left = {members: self._below(members) for members in shown}
        for members, times in list(shown.items()):
            if 1 < len(left[members]) < len(members):
                shown[left[members]] += times
                left.setdefault(left[members], self._below(left[members]))
        sets = [members for members, _ in sorted(shown.items(), key=lambda item: (-item[1], item[0]))[:_MOST_SETS]]
        return sets, {
            members: (below, *self.contact.parted(tuple(piece for piece in members if piece not in below)))
            for members, below in left.items()
            if below != members
        }

    def _presumed(self) -> dict[Members, float]:
        """The pairs of things that are faces of one, or of which one lies in the other, unless the views deny it; with
        the agreement that each has at least."""
        lying = [(min(pair), max(pair)) for pair in self.inlays.pairs(self.labels)]
        faces = self._together(self.counted, np.argwhere(np.triu(self.edges)))
        inlaid = self._together(self.views, np.array(lying, np.intp).reshape(-1, 2))
        least = dict.fromkeys(inlaid, self.params.inlaid)
        return least | {pair: max(self.params.convex, least.get(pair, 0)) for pair in faces}

    def _together(self, views: list[View], pairs: NDArray[np.intp]) -> list[Members]:
        """Those of some pairs [P, 2] that are things, and that half of the views which see both hold under one mask."""
        a, b = pairs[~self.stuff[pairs].any(axis=1)].T
        both, together = np.zeros((2, len(a)))
        for view in views:
            both += (view.seen[a] > 0) & (view.seen[b] > 0)
            together += (view.shows[:, a] & view.shows[:, b]).any(axis=0)
        one = (together > 0) & (together >= _TOGETHER * both)
        return list(zip(a[one].tolist(), b[one].tolist(), strict=True))

    def _below(self, members: Members) -> Members:
        """Those of these pieces that do not stand on the others."""
        labels = [row for piece in members for row in self.labels[piece]]
        on_top = dict(zip(labels, self.mounds.standing(labels).tolist(), strict=True))
        on_level = self._on_level(members)
        return tuple(
            piece for piece in members if not (piece in on_level or all(on_top[row] for row in self.labels[piece]))
        )

    def _on_level(self, members: Members) -> set[int]:
        """Those of these pieces that, alone or with those they touch, stand on a level one: a mug may be in pieces, and
        a carton touch the book beside it."""
        found: set[int] = set()
        for base in members:
            others = tuple(piece for piece in members if piece != base)
            levels = self.supports.levels(self.labels[base])
            parts = {*self.contact.parted(others), *((piece,) for piece in others)} if levels else ()
            for level in levels:
                for part in parts:
                    found.update(self._standing(level, part))
        return found

    def _standing(self, level: Members, part: Members) -> set[int]:
        """All pieces of a part that stands on a level surface; or those that stand on it and on what goes on in its
        plane, as the other pieces of a rug do."""
        if self.supports.hold(level, self._labels_of(part)):
            return set(part)
        ground = tuple(piece for piece in part if self.supports.goes_on(level, self.labels[piece]))
        rests = self.contact.parted(tuple(piece for piece in part if piece not in ground)) if ground else []
        return {
            piece
            for rest in rests
            if self.supports.hold(level, self._labels_of(rest), self._labels_of(ground))
            for piece in rest
        }

    def _labels_of(self, pieces: Members) -> Members:
        return tuple(row for piece in pieces for row in self.labels[piece])
