"""The number of Gaussians under control: clone, split and prune (Kerbl et al. 2023, Sec. 5)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ss_flow.tasks.artifacts import Bool, Float32, Float64
from ss_flow.tasks.gaussians.optimizer import Parameters
from ss_flow.tasks.ranges import Count, Natural

CLONE_SHARE = 0.01
"""Gaussians larger than this share of the extent are split, smaller ones cloned."""
LARGE_SHARE = 0.1
"""Gaussians larger than this share of the extent are dropped, once opacities have been reset."""
SPLIT_SHRINK = 1.6
"""What the two halves of a split Gaussian are smaller by."""
REFERENCE_ROWS = 512
"""The image height at which 3DGS's gradient threshold, in units of half an image, is taken."""


@dataclass(frozen=True)
class Seen:
    """What one step tells of the Gaussians."""

    centers: Float32
    """[N, 2] gradient towards the projected means."""
    radii: Float32
    """[N] pixels, 0 = not in view."""
    pixels: int
    """In the mean that the loss is."""


@dataclass(frozen=True)
class Schedule:
    """When Gaussians are cloned, split and pruned; the defaults are those of 3DGS, for 30,000 steps."""

    start: Natural = 500
    """No clones before this step."""
    stop: Count = 15_000
    """None after this one."""
    every: Count = 100
    """Steps from one time to the next."""
    reset_every: Count = 3_000
    """Steps from one reset of all opacities, to at most 0.01, to the next."""
    shorten: bool = True
    """Whether a short training begins after a fifth of its steps and stops at the half of them at the latest; if not,
    as in 3DGS, it merely ends before `stop`, and nothing comes with its last step, which no step follows."""

    def of(self, iterations: int) -> Schedule:
        """The same for a training of so many steps."""
        if not self.shorten:
            return replace(self, stop=min(self.stop, iterations) - 1)
        return replace(self, start=min(self.start, iterations // 5), stop=min(self.stop, iterations // 2))

    def densifies(self, step: int) -> bool:
        return self.start < step <= self.stop and step % self.every == 0

    def resets(self, step: int) -> bool:
        return step < self.stop and step % self.reset_every == 0


class GradientRecord:
    """The mean gradient of each Gaussian's screen position over the views that showed it."""

    def __init__(self, count: int) -> None:
        self.sum, self.seen = np.zeros(count, np.float64), np.zeros(count, np.int64)

    def add(self, centers: Float32, radii: Float32, pixels: int) -> None:
        """centers: [N, 2] gradient of a loss that is a mean over `pixels`. radii: [N], 0 where not in view."""
        norm = np.hypot(centers[:, 0], centers[:, 1]) * (pixels / (2 * REFERENCE_ROWS))
        seen = radii > 0
        self.sum[seen] += norm[seen]
        self.seen[seen] += 1

    def mean(self) -> Float64:
        return self.sum / np.maximum(self.seen, 1)


class AdaptiveControl:
    """Clones and splits where the picture is still wrong, drops what is faint or far too large."""

    def __init__(
        self, count: int, schedule: Schedule, *, threshold: float, extent: float, most: int, prune_opacity: float
    ) -> None:
        self.last_step = schedule.stop
        self._schedule = schedule
        self._threshold, self._extent, self._most, self._prune_opacity = threshold, extent, most, prune_opacity
        self._record = GradientRecord(count)

    def after(self, step: int, parameters: Parameters, seen: Seen, generator: np.random.Generator) -> None:
        """Act after a step (the first is 1); may rearrange the rows of the parameters."""
        if step > self.last_step:
            return
        self._record.add(seen.centers, seen.radii, seen.pixels)
        if self._schedule.densifies(step):
            rows = densify(
                parameters.values,
                self._record.mean(),
                threshold=self._threshold,
                extent=self._extent,
                most=self._most,
                generator=generator,
            )
            parameters.rearrange(*rows)
            keep = parameters.opacities() >= self._prune_opacity
            if step > self._schedule.reset_every:
                keep &= np.exp(parameters.values["log_scales"]).max(axis=1) <= LARGE_SHARE * self._extent
            parameters.keep(keep)
            self._record = GradientRecord(len(parameters))
        if self._schedule.resets(step):
            parameters.limit_opacity(0.01)

    def state(self) -> dict[str, NDArray[Any]]:
        """What it remembers, to go on from later."""
        return {"record.sum": self._record.sum, "record.seen": self._record.seen}

    def restore(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Go on from what `state` gave."""
        self._record.sum, self._record.seen = state["record.sum"], state["record.seen"]


def densify(
    parameters: dict[str, Float32],
    gradient: Float64,
    *,
    threshold: float,
    extent: float,
    most: int,
    generator: np.random.Generator,
) -> tuple[dict[str, Float32], NDArray[np.integer], Bool]:
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
