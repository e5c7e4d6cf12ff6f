"""The parameters under training and Adam's state, kept row by row together."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ss_flow.tasks.artifacts import Gaussians
from ss_flow.tasks.gaussians.backends import AdamStep, Array, Backend, Values
from ss_flow.tasks.gaussians.initialise import with_sh_degree
from ss_flow.tasks.gaussians.native_pass import PARAMETERS


class Parameters:
    """The rasterizer's five float32 arrays by name, the colours with all the coefficients they will ever need."""

    def __init__(self, initial: Gaussians, sh_degree: int, backend: Backend) -> None:
        filled = with_sh_degree(initial, sh_degree)
        self.backend = backend
        self.values: Values = {name: backend.put(np.asarray(getattr(filled, name), np.float32)) for name in PARAMETERS}
        self._first = {name: backend.xp.zeros_like(a) for name, a in self.values.items()}
        self._second = {name: backend.xp.zeros_like(a) for name, a in self.values.items()}
        self.origin = backend.put(np.arange(len(initial)))
        """[N] the row of the initial Gaussians that each descends from."""

    def __len__(self) -> int:
        return len(self.values["means"])

    def opacities(self) -> Array:
        """[N] float64 between 0 and 1."""
        xp = self.backend.xp
        return 1 / (1 + xp.exp(-xp.asarray(self.values["opacity_logits"], dtype=xp.float64)))

    def longest(self) -> Array:
        """[N] the largest standard deviation of each, world units."""
        xp = self.backend.xp
        return xp.amax(xp.exp(self.values["log_scales"]), 1)

    def step(self, gradients: Values, step: AdamStep) -> None:
        """One step of Adam."""
        self.backend.adam(self.values, gradients, self._first, self._second, step)

    def rearrange(self, values: Values, source: Array, fresh: Array) -> None:
        """Replace the rows by new ones that descend from `source`; those that are fresh start without momentum."""
        self.values = values
        for state in (self._first, self._second):
            for name in state:
                state[name] = state[name][source]
                state[name][fresh] = 0
        self.origin = self.origin[source]

    def keep(self, rows: Array) -> None:
        """Drop the other rows."""
        if rows.all():
            return
        xp = self.backend.xp
        source = xp.where(rows)[0]
        self.rearrange({n: a[source] for n, a in self.values.items()}, source, xp.zeros_like(source, dtype=xp.bool))

    def limit_opacity(self, opacity: float) -> None:
        """No opacity above this one, and no momentum in the opacities (spec A23)."""
        logits = self.values["opacity_logits"]
        self.backend.xp.clip(logits, None, float(np.log(opacity / (1 - opacity))), out=logits)
        self._first["opacity_logits"][:] = 0
        self._second["opacity_logits"][:] = 0

    def limit_scale(self, log_longest: Array) -> None:
        """No standard deviation above these: [N, 3] their logarithms, of world units."""
        log_scales = self.values["log_scales"]
        self.backend.xp.minimum(log_scales, log_longest, out=log_scales)

    def finite(self) -> bool:
        return all(bool(self.backend.xp.isfinite(a).all()) for a in self.values.values())

    def state(self) -> dict[str, NDArray[Any]]:
        """Everything, to go on from later."""
        groups = {"value": self.values, "first": self._first, "second": self._second}
        arrays = {f"{group}.{name}": a for group, named in groups.items() for name, a in named.items()}
        return {name: self.backend.host(a) for name, a in {**arrays, "origin": self.origin}.items()}

    def restore(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Go on from what `state` gave."""
        for group, named in (("value", self.values), ("first", self._first), ("second", self._second)):
            for name in named:
                named[name] = self.backend.put(state[f"{group}.{name}"])
        self.origin = self.backend.put(state["origin"])

    def to_gaussians(self, initial: Gaussians) -> Gaussians:
        """The artifact; labels come from the initial Gaussian that each descends from."""
        arrays = (np.array(self.backend.host(self.values[name])) for name in PARAMETERS)
        means, quaternions, log_scales, opacity_logits, sh = arrays
        length = np.maximum(np.linalg.norm(quaternions, axis=1, keepdims=True), 1e-12)
        origin = self.backend.host(self.origin)
        return Gaussians(
            means,
            (quaternions / length).astype(np.float32),
            log_scales,
            opacity_logits,
            sh,
            initial.instance_id[origin],
            initial.instance_conf[origin],
            initial.part_id[origin],
        )
