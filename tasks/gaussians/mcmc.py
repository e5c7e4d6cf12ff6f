"""The number of Gaussians under control: training as sampling (Kheradmand et al. 2024, "3DGS as MCMC").

Faint Gaussians move to where opaque ones are, in a way that keeps the picture; their number grows by 5 % at a time up
to a cap; noise lets faint ones explore, and a small price on opacity and size makes what is not needed fade. Unlike in
the paper, lengths are in units of the extent, so that the scale of the world does not matter.
"""

from __future__ import annotations

from collections.abc import Mapping
from math import comb
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ss_flow.tasks.artifacts import Float32, Float64
from ss_flow.tasks.gaussians.densification import Schedule, Seen, rotations
from ss_flow.tasks.gaussians.optimizer import Parameters

DEAD_OPACITY = 0.005
GROWTH = 1.05
OPACITY_PRICE = 0.001
"""lambda_o of Eq. 13: on the mean opacity. The paper's 0.01 asks for hundreds of views: with some twenty, what little
is opaque grows huge."""
SCALE_PRICE = 0.05
"""lambda_Sigma of Eq. 13: on the mean standard deviation; the paper's 0.01 where the extent is 5 units."""
NOISE = 5e5
"""lambda_noise of Eq. 8."""
NOISE_SHARPNESS = 100.0
"""k of the sigmoid that keeps opaque Gaussians where they are."""
MOST_COPIES = 51
"""Shares that one Gaussian is divided into, at most; the sums below lose their digits beyond."""


class MarkovChain:
    """Relocates, adds, and shakes; `most` Gaussians at most."""

    def __init__(self, iterations: int, *, extent: float, most: int) -> None:
        # 3DGS-MCMC acts until 25,000 of 30,000 iterations.
        schedule = Schedule().of(iterations)
        self._start, self._every, self.last_step = schedule.start, schedule.every, round(iterations * 5 / 6)
        self._extent, self._most = extent, most

    def regularise(self, parameters: Parameters, gradients: Mapping[str, Float32]) -> None:
        n = max(len(parameters), 1)
        opacity = parameters.opacities()
        gradients["opacity_logits"][:] += (OPACITY_PRICE / n * opacity * (1 - opacity)).astype(np.float32)
        scales = np.exp(parameters.values["log_scales"])
        gradients["log_scales"][:] += np.float32(SCALE_PRICE / (3 * n * self._extent)) * scales

    def after(self, step: int, parameters: Parameters, seen: Seen, generator: np.random.Generator) -> None:
        if self._start < step <= self.last_step and step % self._every == 0:
            self._relocate(parameters, generator)
            self._add(parameters, generator)
        self._shake(parameters, seen.means_rate, generator)

    def _relocate(self, parameters: Parameters, generator: np.random.Generator) -> None:
        opacity = parameters.opacities()
        dead = np.flatnonzero(opacity <= DEAD_OPACITY)
        alive = np.flatnonzero(opacity > DEAD_OPACITY)
        if len(dead) and len(alive):
            rows = np.arange(len(parameters))
            rows[dead] = _drawn(alive, opacity, len(dead), generator)
            self._share(parameters, rows, dead)

    def _add(self, parameters: Parameters, generator: np.random.Generator) -> None:
        n = len(parameters)
        more = min(self._most, int(GROWTH * n)) - n
        opacity = parameters.opacities()
        alive = np.flatnonzero(opacity > DEAD_OPACITY)
        if more > 0 and len(alive):
            rows = np.concatenate([np.arange(n), _drawn(alive, opacity, more, generator)])
            self._share(parameters, rows, np.arange(n, n + more))

    def _share(self, parameters: Parameters, rows: NDArray[np.integer], copies: NDArray[np.integer]) -> None:
        """Row i becomes what `rows[i]` was; those that are copied share what they were with their copies."""
        shares = np.bincount(rows[copies], minlength=len(parameters))[rows] + 1
        divided = shares > 1
        opacity, shrink = divide(parameters.opacities()[rows], np.minimum(shares, MOST_COPIES))
        values = {name: array[rows] for name, array in parameters.values.items()}
        opacity = np.clip(opacity, DEAD_OPACITY, 1 - 1e-6)
        logits = np.log(opacity / (1 - opacity)).astype(np.float32)
        values["opacity_logits"][divided] = logits[divided]
        values["log_scales"][divided] += np.log(shrink[divided, None]).astype(np.float32)
        # Adam's state goes along: started anew, its first steps are several times too long, a hundred at a time.
        parameters.rearrange(values, rows, np.zeros(len(rows), bool))

    def _shake(self, parameters: Parameters, rate: float, generator: np.random.Generator) -> None:
        """Eq. 8: noise of the Gaussian's own shape, where it is hardly opaque; of its own size at most."""
        faint = 1 / (1 + np.exp(NOISE_SHARPNESS * (parameters.opacities() - DEAD_OPACITY)))
        rows = np.flatnonzero(faint > 1e-3)
        axes = rotations(parameters.values["quaternions"][rows])
        size = np.exp(parameters.values["log_scales"][rows].astype(np.float64))
        reach = np.minimum(NOISE * rate * np.square(size / self._extent), size) * faint[rows, None]
        noise = reach * generator.normal(size=(len(rows), 3))
        parameters.values["means"][rows] += np.einsum("nij,nj->ni", axes, noise).astype(np.float32)

    def state(self) -> dict[str, NDArray[Any]]:
        return {}

    def restore(self, state: Mapping[str, NDArray[Any]]) -> None:
        pass


def _drawn(
    alive: NDArray[np.integer], opacity: Float64, count: int, generator: np.random.Generator
) -> NDArray[np.integer]:
    """So many of the living, with replacement, each in proportion to its opacity."""
    weight = opacity[alive]
    return generator.choice(alive, size=count, p=weight / weight.sum())


def divide(opacity: Float64, shares: NDArray[np.integer]) -> tuple[Float64, Float64]:
    """Opacity of each share of a Gaussian, and the factor on its scale, so that together they look the same (Eq. 9).

    opacity: [N]. shares: [N], 1 = whole. With o' = 1 - (1 - o)^(1/n), the scale shrinks by
    o / sum_{i=1..n} sum_{k=0..i-1} C(i-1, k) (-1)^k o'^(k+1) / sqrt(k+1).
    """
    each = 1 - (1 - opacity) ** (1 / shares)
    factor = np.ones_like(opacity)
    for n in np.unique(shares[shares > 1]).tolist():
        rows = shares == n
        # Summed over i first: sum_{i=1..n} C(i-1, k) = C(n, k+1).
        k = np.arange(n)
        signed = np.array([comb(n, int(j) + 1) * (-1.0) ** int(j) for j in k]) / np.sqrt(k + 1)
        factor[rows] = opacity[rows] / (signed * each[rows, None] ** (k + 1)).sum(axis=1)
    return each, factor
