"""Votes of the views for the labels of points: the sparse weight vectors w_p (Split&Splat, Sec. 3.1.3)."""

from __future__ import annotations

import numpy as np

from ss_flow.tasks.artifacts import Float64, Int32


class Votes:
    """Sparse weights W [points, labels]: each point keeps a slot for every label that it ever got a vote for.

    Points see few labels, so a handful of slots holds what a dense matrix would need a column a label for.
    """

    def __init__(self, num_points: int) -> None:
        self._label = np.zeros((num_points, 2), np.int32)
        self._weight = np.zeros((num_points, 2))

    def fresh(self, points: Int32) -> np.ndarray:
        """[M] which of the points have no vote yet."""
        return self._label[points, 0] == 0

    def add(self, points: Int32, label: int, weight: Float64) -> None:
        """Add votes for one label: points [M] without repetition, weight [M] positive."""
        while points.size:
            # The first slot that holds the label or nothing; slots fill from the left.
            usable = (self._label[points] == label) | (self._label[points] == 0)
            found = usable.any(axis=1)
            slot = usable.argmax(axis=1)[found]
            self._label[points[found], slot] = label
            self._weight[points[found], slot] += weight[found]
            points, weight = points[~found], weight[~found]
            if points.size:
                self._label = np.pad(self._label, ((0, 0), (0, self._label.shape[1])))
                self._weight = np.pad(self._weight, ((0, 0), (0, self._weight.shape[1])))

    def leaders(self, points: Int32 | slice = slice(None)) -> tuple[Int32, Float64]:
        """Label with the most weight and its share of the point's weight, for [M] points; 0 and 0.0 without votes.

        Ties go to the lowest label.
        """
        label, weight = self._label[points], self._weight[points]
        best = weight.max(axis=1)
        ties = np.where((weight == best[:, None]) & (label > 0), label, np.iinfo(np.int32).max)
        leader = np.where(best > 0, ties.min(axis=1), 0).astype(np.int32)
        total = weight.sum(axis=1)
        return leader, np.divide(best, total, out=np.zeros_like(best), where=total > 0)

    def weight(self) -> Float64:
        """[N] what the votes of each point weigh together."""
        return self._weight.sum(axis=1)
