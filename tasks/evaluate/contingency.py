"""Overlaps of two labellings of the same pixels or points, from one pass over them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ss_flow.tasks.artifacts import Bool, Float64

Labels = NDArray[np.integer]
Counts = NDArray[np.int64]

_LARGEST_TABLE = 1 << 24
_AT_ONCE = 1 << 20
"""So many elements are counted at once, which takes 32 bytes of each."""


@dataclass(frozen=True)
class Contingency:
    """How often each true label meets each predicted one."""

    truth_ids: Counts
    """[G] the true labels that occur, ascending."""
    predicted_ids: Counts
    """[P] the predicted labels that occur, ascending."""
    intersection: Counts
    """[G, P] elements that carry both labels."""
    truth_area: Counts
    """[G] elements with each true label."""
    predicted_area: Counts
    """[P] elements with each predicted label."""

    @property
    def iou(self) -> Float64:
        """[G, P] intersection over union."""
        union = self.truth_area[:, None] + self.predicted_area[None, :] - self.intersection
        return self.intersection / np.maximum(union, 1)

    def best_iou(self) -> Float64:
        """[G] the largest IoU of each true label with any predicted one (several may share one); 0 without any."""
        return self.iou.max(axis=1, initial=0.0)

    def without(self, *, truth: int | None = None, predicted: int | None = None) -> Contingency:
        """The table without one true and one predicted label; the elements still count in the areas of the others."""
        rows = self.truth_ids != truth if truth is not None else np.ones(len(self.truth_ids), bool)
        columns = self.predicted_ids != predicted if predicted is not None else np.ones(len(self.predicted_ids), bool)
        return Contingency(
            self.truth_ids[rows],
            self.predicted_ids[columns],
            self.intersection[np.ix_(rows, columns)],
            self.truth_area[rows],
            self.predicted_area[columns],
        )

    def of_truth(self, kept: Bool) -> Contingency:
        """The table of some true labels. kept: [G]. The elements of the others still count in the predicted areas."""
        return Contingency(
            self.truth_ids[kept],
            self.predicted_ids,
            self.intersection[kept],
            self.truth_area[kept],
            self.predicted_area,
        )

    def elements_of(self, kept: Bool) -> Contingency:
        """The table of the elements with some true labels alone. kept: [G]."""
        shared = self.intersection[kept]
        met = shared.any(axis=0)
        return Contingency(
            self.truth_ids[kept],
            self.predicted_ids[met],
            shared[:, met],
            self.truth_area[kept],
            shared[:, met].sum(axis=0),
        )


def contingency(truth: Labels, predicted: Labels) -> Contingency:
    """Count label pairs with `bincount`: O(N) time, no mask per label.

    truth, predicted: integer labels of the same shape, any values. Raises ValueError when the shapes differ.
    """
    if truth.shape != predicted.shape:
        raise ValueError(f"labellings of different shapes: {truth.shape} and {predicted.shape}")
    truth_ids, place = _indexed(truth)
    predicted_ids, predicted_place = _indexed(predicted)
    shape = len(truth_ids), len(predicted_ids)
    pairs = np.zeros(shape[0] * shape[1], np.int64)
    for some in _pieces(truth.size):
        pairs += np.bincount(place(some) * shape[1] + predicted_place(some), minlength=len(pairs))
    pairs = pairs.reshape(shape)
    return Contingency(truth_ids, predicted_ids, pairs, pairs.sum(axis=1), pairs.sum(axis=0))


def added_up(tables: Iterable[Contingency]) -> Contingency:
    """One table of the elements of several; of an iterator, the labellings of one are held at a time."""
    held = list(tables)
    truth_ids, predicted_ids = (
        np.unique(np.concatenate([np.zeros(0, np.int64), *(getattr(one, ids) for one in held)]))
        for ids in ("truth_ids", "predicted_ids")
    )
    shared = np.zeros((len(truth_ids), len(predicted_ids)), np.int64)
    for one in held:
        rows, columns = np.searchsorted(truth_ids, one.truth_ids), np.searchsorted(predicted_ids, one.predicted_ids)
        shared[np.ix_(rows, columns)] += one.intersection
    return Contingency(truth_ids, predicted_ids, shared, shared.sum(axis=1), shared.sum(axis=0))


def _indexed(labels: Labels) -> tuple[Counts, Callable[[slice], Counts]]:
    """The distinct labels, ascending: [L]; and what tells the places of some elements among them."""
    flat = labels.ravel()
    low, high = (int(flat.min()), int(flat.max())) if flat.size else (0, -1)
    if high - low >= _LARGEST_TABLE:
        ids, index = np.unique(flat.astype(np.int64), return_inverse=True)
        return ids, lambda some: index[some]
    table = np.zeros(high - low + 1, np.int64)
    for some in _pieces(flat.size):
        table[flat[some].astype(np.int64) - low] = 1
    present = np.flatnonzero(table)
    table[present] = np.arange(len(present))
    return present + low, lambda some: table[flat[some].astype(np.int64) - low]


def _pieces(count: int) -> Iterator[slice]:
    """All elements, some at a time."""
    return (slice(start, start + _AT_ONCE) for start in range(0, count, _AT_ONCE))
