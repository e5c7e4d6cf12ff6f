"""The number of Gaussians under control: clone, split and prune (Kerbl et al. 2023, Sec. 5)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ss_flow.tasks.gaussians.backends import Array, Backend, Values
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

    centers: Array
    """[N, 2] gradient towards the projected means."""
    radii: Array
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
    """Whether a short training begins after a fifth of its steps and stops at the half of them at the latest, so that
    one of less than twice `every` steps clones nothing; if not, as in 3DGS, it merely ends before `stop`, and nothing
    comes with its last step, which no step follows."""

    def of(self, iterations: int) -> Schedule:
        """The same for a training of so many steps."""
        if not self.shorten:
            return replace(self, stop=min(self.stop, iterations) - 1)
        return replace(self, start=min(self.start, iterations // 5), stop=min(self.stop, iterations // 2))

    def reached(self, most: int) -> bool:
        """Whether a training of at most so many steps can be long enough for anything of this to happen."""
        return self.of(most).stop >= min(self.every, self.reset_every)

    def densifies(self, step: int) -> bool:
        return self.start < step <= self.stop and step % self.every == 0

    def resets(self, step: int) -> bool:
        return step < self.stop and step % self.reset_every == 0


class GradientRecord:
    """The mean gradient of each Gaussian's screen position over the views that showed it."""

    def __init__(self, count: int, backend: Backend) -> None:
        self.backend = backend
        self.sum, self.seen = (backend.put(np.zeros(count, kind)) for kind in (np.float64, np.int64))

    def add(self, centers: Array, radii: Array, pixels: int) -> None:
        """centers: [N, 2] gradient of a loss that is a mean over `pixels`. radii: [N], 0 where not in view."""
        xp = self.backend.xp
        norm = xp.hypot(centers[:, 0], centers[:, 1]) * (pixels / (2 * REFERENCE_ROWS))
        seen = radii > 0
        self.sum += xp.where(seen, norm, 0)
        self.seen += seen

    def mean(self) -> Array:
        return self.sum / self.backend.xp.clip(self.seen, 1, None)


class AdaptiveControl:
    """Clones and splits where the picture is still wrong, drops what is faint or far too large."""

    def __init__(
        self,
        record: GradientRecord,
        schedule: Schedule,
        *,
        threshold: float,
        extent: float,
        most: int,
        prune_opacity: float,
    ) -> None:
        self.last_step = schedule.stop
        self._schedule = schedule
        self._threshold, self._extent, self._most, self._prune_opacity = threshold, extent, most, prune_opacity
        self._record = record

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
                backend=parameters.backend,
            )
            parameters.rearrange(*rows)
            keep = parameters.opacities() >= self._prune_opacity
            if step > self._schedule.reset_every:
                keep &= parameters.longest() <= LARGE_SHARE * self._extent
            parameters.keep(keep)
            self._record = GradientRecord(len(parameters), parameters.backend)
        if self._schedule.resets(step):
            parameters.limit_opacity(0.01)

    def state(self) -> dict[str, NDArray[Any]]:
        """What it remembers, to go on from later."""
        host = self._record.backend.host
        return {"record.sum": host(self._record.sum), "record.seen": host(self._record.seen)}

    def restore(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Go on from what `state` gave."""
        put = self._record.backend.put
        self._record.sum, self._record.seen = put(state["record.sum"]), put(state["record.seen"])


def densify(
    values: Values,
    gradient: Array,
    *,
    threshold: float,
    extent: float,
    most: int,
    generator: np.random.Generator,
    backend: Backend,
) -> tuple[Values, Array, Array]:
    """Clone small and split large Gaussians whose screen gradient ([N] float64) is above the threshold.

    Returns the new parameters, the row each came from, and which rows are new (their optimiser state starts at 0).
    When the result would exceed `most`, those with the largest gradients go first. The halves of a split one lie where
    `generator` says, on the host, so that every device splits alike.
    """
    xp = backend.xp
    chosen = gradient >= threshold
    rows, room = xp.where(chosen)[0], max(most - len(gradient), 0)
    if len(rows) > room:
        chosen[rows[xp.argsort(-gradient[rows], stable=True)[room:]]] = False
    large = xp.amax(xp.exp(values["log_scales"]), 1) > CLONE_SHARE * extent
    kept, clones, parents = (xp.where(some)[0] for some in (~(chosen & large), chosen & ~large, chosen & large))
    source = xp.concatenate([kept, clones, parents, parents])
    fresh = xp.ones_like(source, dtype=xp.bool)
    fresh[: len(kept)] = False
    out = {name: array[source] for name, array in values.items()}
    if len(parents):
        halves = slice(len(kept) + len(clones), None)
        both = source[halves]
        scales = xp.exp(xp.asarray(values["log_scales"][both], dtype=xp.float64))
        offset = backend.put(generator.normal(size=(len(both), 3))) * scales
        # On CUDA an einsum would be one of cuBLAS: see `torch_backend`.
        turned = (rotations(values["quaternions"][both], xp) * offset[:, None, :]).sum(2)
        out["means"][halves] += xp.asarray(turned, dtype=xp.float32)
        out["log_scales"][halves] -= float(np.log(SPLIT_SHRINK))
    return out, source, fresh


def rotations(quaternions: Array, xp: ModuleType = np) -> Array:
    """[N, 4] w x y z of any length -> [N, 3, 3] float64. xp: the module of the array, NumPy or torch."""
    unit = quaternions / xp.sqrt((quaternions * quaternions).sum(axis=1, keepdims=True))
    w, x, y, z = xp.asarray(unit, dtype=xp.float64).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return xp.moveaxis(xp.stack([xp.stack(row) for row in rows]), 2, 0)
