"""How often the views show several pieces as one thing: the measure by which `hierarchy` unites them."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ss_flow.tasks.artifacts import Bool, Float32, Float64, Int32, Tally

ONE_THING = 0.41
"""Agreement above which pieces are one thing, unless `split.granularity` says otherwise."""
_IOU = (0.5, 0.8)
"""IoU of a mask with the pieces from which on it begins to show them as one, and from which it does."""
_REST = (0.3, 0.7)
"""The same for the share that it holds of all but the largest piece, which alone may make up most of the IoU."""
_OWN = 0.75
"""IoU with a single piece from which a mask is the piece's own."""
_LARGEST = 0.5
"""How much it counts that the segmenter is surer of the largest piece than of all: a mask of the trunk says less of
whether the leaves are another thing than a mask of the leaves does."""
_BALANCED = 0.1
"""Share of the smaller pieces in what a view sees of all, from which on the view counts in full."""


@dataclass(frozen=True)
class View:
    """What one view says of G pieces by its M masks."""

    seen: Float32
    """[G] points of each piece that it sees."""
    held: Float32
    """[M, G] those under each mask."""
    quality: Float64
    """[M] how sure the segmenter is of each mask."""

    def joined(self, member: Float32) -> View:
        """The same of the pieces that these make up. member: [G, H] 1 where one is part of a new one, else 0."""
        return replace(self, seen=self.seen @ member, held=self.held @ member)

    def only(self, counted: Bool) -> View:
        """The same, as if it saw nothing of other pieces than these [G]."""
        return replace(self, seen=self.seen * counted, held=self.held * counted)

    @functools.cached_property
    def shows(self) -> Bool:
        """[M, G] which pieces each mask shows: those of which it holds at least half."""
        return np.asarray((self.held >= 0.5 * self.seen) & (self.seen > 0))

    @functools.cached_property
    def own(self) -> Float64:
        """[G] quality of the best mask that is a piece's own, 0 where there is none."""
        iou = self.held / np.maximum(self.held.sum(axis=1, keepdims=True) + self.seen - self.held, 1)
        return np.where(iou >= _OWN, self.quality[:, None], 0).max(axis=0, initial=0)


def views_of(names: Int32, tallies: Sequence[Tally]) -> list[View]:
    """The views of these tallies, of pieces called `names` [G], ascending."""
    views = []
    for tally in {_content(tally): tally for tally in tallies}.values():  # a second copy of a view says nothing
        column = np.searchsorted(names, tally.label)
        seen = np.zeros(len(names), np.float32)  # counts are exact in it, and take half the memory
        seen[column] = tally.seen
        held = np.zeros((len(tally.held), len(names)), np.float32)
        held[:, column] = tally.held
        views.append(View(seen, held, tally.quality.astype(np.float64)))
    return views


def _content(tally: Tally) -> tuple[object, ...]:
    """What a tally says, whatever the order of its masks."""
    masks = sorted((float(quality), held.tobytes()) for quality, held in zip(tally.quality, tally.held, strict=True))
    return tally.label.tobytes(), tally.seen.tobytes(), tuple(masks)


def agreement_of(
    views: Sequence[View], member: Float32, *, doubt: float, silent: float, prior: float, prior_agreement: float
) -> Float64:
    """[S] share of the views that show each set of pieces as one, of those that see at least two of them: the mean of
    the share's posterior, as a beta distribution with the prior.

    member: [S, G] 1 for the pieces of each set, else 0. doubt, silent, prior, prior_agreement: as in `HierarchyParams`.
    """
    agreed, asked = np.zeros(len(member)), np.zeros(len(member))
    for view in views:
        seen = member * view.seen
        total, largest = seen.sum(axis=1), seen.max(axis=1)
        weight = np.minimum((1 - largest / np.maximum(total, 1)) / _BALANCED, 1)
        rows = np.flatnonzero((total > 0) & (weight > 0))
        if not rows.size:
            continue
        size, inside = view.held.sum(axis=1), member[rows] @ view.held.T
        speaks = ((inside >= 0.5 * size) & (member[rows] @ view.shows.T > 0)).any(axis=1)
        weight[rows] *= np.where(speaks, 1, silent)
        asked[rows] += weight[rows]
        if not len(view.held):
            continue
        total, largest, seen = total[rows, None], largest[rows, None], seen[rows]
        iou = inside / np.maximum(size + total - inside, 1)
        main = seen.argmax(axis=1)
        rest = (inside - view.held[:, main].T) / (total - largest)
        own, is_main = np.where(seen > 0, view.own, 0), np.arange(seen.shape[1]) == main[:, None]
        own_main, own_rest = ((own * which).max(axis=1, keepdims=True) for which in (is_main, ~is_main))
        less_sure = np.maximum(own_rest - view.quality, _LARGEST * (own_main - view.quality)) / max(doubt, 1e-9)
        fit = ramp(iou, *_IOU) * ramp(rest, *_REST) * np.clip(1 - less_sure, 0, 1)
        agreed[rows] += weight[rows] * fit.max(axis=1)
    return (agreed + prior * prior_agreement) / np.maximum(asked + prior, 1e-9)


def ramp(value: Float64, low: float, high: float) -> Float64:
    """0 up to `low`, 1 from `high` on, and linear between."""
    return np.clip((value - low) / (high - low), 0, 1)
