"""The parameters under training and Adam's state, kept row by row together."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ss_flow.tasks.artifacts import Bool, Float32, Gaussians
from ss_flow.tasks.gaussians.initialise import with_sh_degree
from ss_flow.tasks.gaussians.library import address, library
from ss_flow.tasks.gaussians.native_pass import PARAMETERS

EPSILON = 1e-15


class Parameters:
    """The rasterizer's five float32 arrays by name, the colours with all the coefficients they will ever need."""

    def __init__(self, initial: Gaussians, sh_degree: int) -> None:
        filled = with_sh_degree(initial, sh_degree)
        self.values: dict[str, Float32] = {
            name: np.array(getattr(filled, name), np.float32, order="C") for name in PARAMETERS
        }
        self._first = {name: np.zeros_like(a) for name, a in self.values.items()}
        self._second = {name: np.zeros_like(a) for name, a in self.values.items()}
        self.origin = np.arange(len(initial))
        """[N] the row of the initial Gaussians that each descends from."""

    def __len__(self) -> int:
        return len(self.values["means"])

    def arrays(self) -> tuple[Float32, Float32, Float32, Float32, Float32]:
        """As the rasterizer takes them."""
        v = self.values
        return v["means"], v["quaternions"], v["log_scales"], v["opacity_logits"], v["sh"]

    def opacities(self) -> NDArray[np.float64]:
        """[N] between 0 and 1."""
        return 1 / (1 + np.exp(-self.values["opacity_logits"].astype(np.float64)))

    def step(
        self,
        gradients: Mapping[str, Float32],
        rates: Mapping[str, float],
        number: int,
        sh_degree: int,
        means_rates: Float32,
    ) -> None:
        """One step of Adam; number: 1 for the first. rates: by name, "sh_rest" for the colours above degree 0.

        means_rates: [N] the learning rate of each mean, world units.
        """
        before = self.values["means"].copy()
        for name, value in self.values.items():
            rows, width, head = len(value), value[:1].size, 0
            active = width
            if name == "sh":
                active, head = 3 * (sh_degree + 1) ** 2, 3
            library().ss_adam(
                rows, width, active, head, address(value), address(gradients[name]), address(self._first[name]),
                address(self._second[name]), rates[name], rates["sh_rest"] if name == "sh" else rates[name], number,
                EPSILON,
            )  # fmt: skip
        # A step of Adam is as long as its rate: those of the means, taken with rate 1, are cut to size here.
        means = self.values["means"]
        means[:] = before + means_rates[:, None] * (means - before)

    def rearrange(self, values: dict[str, Float32], source: NDArray[np.integer], fresh: Bool) -> None:
        """Replace the rows by new ones that descend from `source`; those that are fresh start without momentum."""
        self.values = values
        for state in (self._first, self._second):
            for name in state:
                state[name] = state[name][source]
                state[name][fresh] = 0
        self.origin = self.origin[source]

    def keep(self, rows: Bool) -> None:
        """Drop the other rows."""
        if rows.all():
            return
        source = np.flatnonzero(rows)
        self.rearrange({n: a[source] for n, a in self.values.items()}, source, np.zeros(len(source), bool))

    def limit_opacity(self, opacity: float) -> None:
        """No opacity above this one, and no momentum in the opacities (spec A23)."""
        logits = self.values["opacity_logits"]
        np.minimum(logits, np.float32(np.log(opacity / (1 - opacity))), out=logits)
        self._first["opacity_logits"][:] = 0
        self._second["opacity_logits"][:] = 0

    def limit_scale(self, longest: Float32) -> None:
        """No standard deviation above these: [N] world units."""
        np.minimum(self.values["log_scales"], np.log(longest)[:, None], out=self.values["log_scales"])

    def finite(self) -> bool:
        return all(bool(np.isfinite(a).all()) for a in self.values.values())

    def state(self) -> dict[str, NDArray[Any]]:
        """Everything, to go on from later."""
        groups = {"value": self.values, "first": self._first, "second": self._second}
        arrays = {f"{group}.{name}": a for group, named in groups.items() for name, a in named.items()}
        return {**arrays, "origin": self.origin}

    def restore(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Go on from what `state` gave."""
        for group, named in (("value", self.values), ("first", self._first), ("second", self._second)):
            for name in named:
                named[name] = np.ascontiguousarray(state[f"{group}.{name}"])
        self.origin = state["origin"]

    def to_gaussians(self, initial: Gaussians) -> Gaussians:
        """The artifact; labels come from the initial Gaussian that each descends from."""
        means, quaternions, log_scales, opacity_logits, sh = self.arrays()
        length = np.maximum(np.linalg.norm(quaternions, axis=1, keepdims=True), 1e-12)
        return Gaussians(
            means.copy(),
            (quaternions / length).astype(np.float32),
            log_scales.copy(),
            opacity_logits.copy(),
            sh.copy(),
            initial.instance_id[self.origin],
            initial.instance_conf[self.origin],
            initial.part_id[self.origin],
        )
