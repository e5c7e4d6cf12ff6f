"""Which instances of one result are which of another, by the pixels that they share. No ground truth is involved."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from ss_flow.tasks.artifacts import Float64
from ss_flow.tasks.evaluate.contingency import Labels, added_up, contingency

_PIECE = 0.1
"""Share of an instance that a piece of it must cover to count as one."""


@dataclass(frozen=True)
class Correspondence:
    """How the instances of two results go together; 0, the background, is none of them."""

    pairs: dict[tuple[int, int], float]
    """IoU over all views of those that are one another's: one-to-one, with the largest sum of IoU, each above 0."""
    in_pieces: dict[int, tuple[int, ...]]
    """Instances of the first that are several of the second: each of these lies mostly in it and covers a tenth of
    it or more."""
    joined: dict[int, tuple[int, ...]]
    """The same with the results exchanged: instances of the second that are several of the first."""
    only_first: tuple[int, ...]
    """Instances of the first without a partner in the second, neither in pieces nor joined there."""
    only_second: tuple[int, ...]

    num_first: int
    num_second: int

    @property
    def agreement(self) -> float:
        """Mean IoU over all instances of both: a pair counts once, what has no partner counts 0; 1 without any."""
        count = self.num_first + self.num_second - len(self.pairs)
        return sum(self.pairs.values()) / count if count else 1.0


def correspondence(views: Iterable[tuple[Labels, Labels]]) -> Correspondence:
    """Match the instances of two results over the views that both have.

    views: the two id images [H, W] of each view. Raises ValueError when two of a view differ in size.
    """
    from scipy.optimize import linear_sum_assignment

    table = added_up(contingency(*view) for view in views).without(truth=0, predicted=0)
    iou = table.iou
    rows, columns = linear_sum_assignment(-iou)
    first, second = table.truth_ids.tolist(), table.predicted_ids.tolist()
    pairs = {(first[i], second[j]): float(iou[i, j]) for i, j in zip(rows, columns, strict=True) if iou[i, j] > 0}
    shared = table.intersection
    in_pieces = _pieces(shared / table.truth_area[:, None], shared / table.predicted_area, first, second)
    joined = _pieces((shared / table.predicted_area).T, (shared / table.truth_area[:, None]).T, second, first)
    told_first = {a for a, _ in pairs} | in_pieces.keys() | {a for of in joined.values() for a in of}
    told_second = {b for _, b in pairs} | joined.keys() | {b for into in in_pieces.values() for b in into}
    return Correspondence(
        pairs,
        in_pieces,
        joined,
        tuple(a for a in first if a not in told_first),
        tuple(b for b in second if b not in told_second),
        len(first),
        len(second),
    )


def _pieces(of_whole: Float64, of_piece: Float64, wholes: list[int], pieces: list[int]) -> dict[int, tuple[int, ...]]:
    """The wholes that have two pieces or more: [W, P] the share of the whole, and of the piece, that the two share."""
    found = (of_whole >= _PIECE) & (of_piece > 0.5)
    rows = np.flatnonzero(found.sum(axis=1) > 1)
    return {wholes[i]: tuple(pieces[j] for j in np.flatnonzero(found[i])) for i in rows}
