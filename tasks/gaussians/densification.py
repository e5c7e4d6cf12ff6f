"""Adaptive control of the number of Gaussians (Kerbl et al. 2023, Sec. 5), on rows of NumPy arrays."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ss_flow.tasks.artifacts import Bool, Float32, Float64

CLONE_SHARE = 0.01
"""Gaussians larger than this share of the extent are split, smaller ones cloned."""
SPLIT_SHRINK = 1.6
"""What the two halves of a split Gaussian are smaller by."""
REFERENCE_ROWS = 512
"""The image height at which 3DGS's gradient threshold, in units of half an image, is taken."""


@dataclass(frozen=True)
class Schedule:
    """When to densify; 3DGS's numbers for 30,000 iterations, and shares of the whole for shorter trainings."""

    start: int
    stop: int
    every: int
    reset_every: int

    @classmethod
    def of(cls, iterations: int) -> Schedule:
        """From 1/5 (at most 500) to the half (at most 15,000), every 100, opacity reset every 3,000."""
        return cls(min(500, iterations // 5), min(15_000, iterations // 2), 100, 3_000)

    def densifies(self, step: int) -> bool:
        return self.start < step <= self.stop and step % self.every == 0

    def resets(self, step: int) -> bool:
        return step < self.stop and step % self.reset_every == 0


class GradientRecord:
    """The mean gradient of each Gaussian's screen position over the views that showed it."""

    def __init__(self, count: int) -> None:
        self._sum, self._seen = np.zeros(count, np.float64), np.zeros(count, np.int64)

    def add(self, centers: Float32, radii: Float32, pixels: int) -> None:
        """centers: [N, 2] gradient of a loss that is a mean over `pixels`. radii: [N], 0 where not in view."""
        norm = np.hypot(centers[:, 0], centers[:, 1]) * (pixels / (2 * REFERENCE_ROWS))
        seen = radii > 0
        self._sum[seen] += norm[seen]
        self._seen[seen] += 1

    def mean(self) -> Float64:
        return self._sum / np.maximum(self._seen, 1)


def densify(
    parameters: dict[str, Float32],
    gradient: Float64,
    *,
    threshold: float,
    extent: float,
    most: int,
    generator: np.random.Generator,
) -> tuple[dict[str, Float32], np.ndarray, Bool]:
    """Clone small and split large Gaussians whose screen gradient is above the threshold.

    Returns the new parameters, the row each came from, and which rows are new (their optimiser state starts at 0).
    When the result would exceed `most`, those with the largest gradients go first.
    """
    n = len(gradient)
    chosen = np.flatnonzero(gradient >= threshold)
    room = max(most - n, 0)
    if len(chosen) > room:
        chosen = np.sort(chosen[np.argsort(-gradient[chosen], kind="stable")[:room]])
    large = np.exp(parameters["log_scales"][chosen]).max(axis=1) > CLONE_SHARE * extent
    clones, parents = chosen[~large], chosen[large]
    kept = np.setdiff1d(np.arange(n), parents)
    source = np.concatenate([kept, clones, parents, parents])
    fresh = np.arange(len(source)) >= len(kept)
    out = {name: array[source].copy() for name, array in parameters.items()}
    if len(parents):
        halves = slice(len(kept) + len(clones), None)
        both = source[halves]
        offset = generator.normal(size=(len(both), 3)) * np.exp(parameters["log_scales"][both].astype(np.float64))
        turned = np.einsum("nij,nj->ni", rotations(parameters["quaternions"][both]), offset)
        out["means"][halves] += turned.astype(np.float32)
        out["log_scales"][halves] -= np.float32(np.log(SPLIT_SHRINK))
    return out, source, fresh


def rotations(quaternions: Float32) -> Float64:
    """[N, 4] w x y z of any length -> [N, 3, 3]."""
    w, x, y, z = (quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)).astype(np.float64).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), 2, 0)
