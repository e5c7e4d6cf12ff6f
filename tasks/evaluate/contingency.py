"""Overlaps of two labellings of the same pixels or points, from one pass over them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ss_flow.tasks.artifacts import Bool, Float64

Labels = NDArray[np.integer]
Counts = NDArray[np.int64]

_LARGEST_TABLE = 1 << 24


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


def contingency(truth: Labels, predicted: Labels) -> Contingency:
    """Count label pairs with one `bincount`: O(N) time, no mask per label.

    truth, predicted: integer labels of the same shape, any values. Raises ValueError when the shapes differ.
    """
    if truth.shape != predicted.shape:
        raise ValueError(f"labellings of different shapes: {truth.shape} and {predicted.shape}")
    truth_ids, g = _indexed(truth)
    predicted_ids, p = _indexed(predicted)
    shape = len(truth_ids), len(predicted_ids)
    pairs = np.bincount(g * shape[1] + p, minlength=shape[0] * shape[1]).reshape(shape).astype(np.int64)
    return Contingency(truth_ids, predicted_ids, pairs, pairs.sum(axis=1), pairs.sum(axis=0))


def _indexed(labels: Labels) -> tuple[Counts, Counts]:
    """The distinct labels, ascending, and each element's place among them: [L], [N]."""
    flat = labels.ravel().astype(np.int64)
    if not flat.size:
        return np.zeros(0, np.int64), flat
    low, high = int(flat.min()), int(flat.max())
    if high - low >= _LARGEST_TABLE:
        ids, index = np.unique(flat, return_inverse=True)
        return ids, index.ravel().astype(np.int64)
    present = np.flatnonzero(np.bincount(flat - low))
    table = np.zeros(high - low + 1, np.int64)
    table[present] = np.arange(len(present))
    return present + low, table[flat - low]
