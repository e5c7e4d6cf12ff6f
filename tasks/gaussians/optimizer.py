"""The parameters under training and Adam's state, kept row by row together."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ss_flow.tasks.artifacts import Bool, Float32, Gaussians
from ss_flow.tasks.gaussians.initialise import with_sh_degree
from ss_flow.tasks.gaussians.library import address, library

EPSILON = 1e-15


class Parameters:
    """Float32 arrays by name: the rasterizer's, with the colours as sh_base [N, 1, 3] and sh_rest [N, K - 1, 3]."""

    def __init__(self, initial: Gaussians, sh_degree: int) -> None:
        filled = with_sh_degree(initial, sh_degree)
        self.values: dict[str, Float32] = {
            "means": np.array(filled.means, np.float32, order="C"),
            "quaternions": np.array(filled.quaternions, np.float32, order="C"),
            "log_scales": np.array(filled.log_scales, np.float32, order="C"),
            "opacity_logits": np.array(filled.opacity_logits, np.float32, order="C"),
            "sh_base": np.array(filled.sh[:, :1], np.float32, order="C"),
            "sh_rest": np.array(filled.sh[:, 1:], np.float32, order="C"),
        }
        self._first = {name: np.zeros_like(a) for name, a in self.values.items()}
        self._second = {name: np.zeros_like(a) for name, a in self.values.items()}
        self.origin = np.arange(len(initial))
        """[N] the row of the initial Gaussians that each descends from."""

    def __len__(self) -> int:
        return len(self.values["means"])

    def for_rendering(self, sh_degree: int) -> tuple[Float32, Float32, Float32, Float32, Float32]:
        """The five arrays of the rasterizer, the colours with no more coefficients than the degree needs."""
        v, rest = self.values, (sh_degree + 1) ** 2 - 1
        sh = np.concatenate([v["sh_base"], v["sh_rest"][:, :rest]], axis=1) if rest else v["sh_base"]
        return v["means"], v["quaternions"], v["log_scales"], v["opacity_logits"], sh

    def step(self, gradients: dict[str, Float32], rates: dict[str, float], number: int) -> None:
        """One step of Adam; number: 1 for the first. `gradients` as the rasterizer gives them."""
        sh = gradients["sh"]
        parts = {**gradients, "sh_base": sh[:, :1]}
        if sh.shape[1] > 1:
            parts["sh_rest"] = np.zeros_like(self.values["sh_rest"])
            parts["sh_rest"][:, : sh.shape[1] - 1] = sh[:, 1:]
        for name, value in self.values.items():
            if name in parts and value.size:
                gradient = np.ascontiguousarray(parts[name])
                library().ss_adam(
                    value.size, address(value), address(gradient), address(self._first[name]),
                    address(self._second[name]), rates[name], number, EPSILON,
                )  # fmt: skip

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
        source = np.flatnonzero(rows)
        self.rearrange({n: a[source] for n, a in self.values.items()}, source, np.zeros(len(source), bool))

    def limit_opacity(self, opacity: float) -> None:
        """No opacity above this one, and no momentum in the opacities (spec A23)."""
        logits = self.values["opacity_logits"]
        np.minimum(logits, np.float32(np.log(opacity / (1 - opacity))), out=logits)
        self._first["opacity_logits"][:] = 0
        self._second["opacity_logits"][:] = 0

    def finite(self) -> bool:
        return all(bool(np.isfinite(a).all()) for a in self.values.values())

    def to_gaussians(self, initial: Gaussians) -> Gaussians:
        """The artifact; labels come from the initial Gaussian that each descends from."""
        means, quaternions, log_scales, opacity_logits, _ = self.for_rendering(0)
        length = np.maximum(np.linalg.norm(quaternions, axis=1, keepdims=True), 1e-12)
        return Gaussians(
            means.copy(),
            (quaternions / length).astype(np.float32),
            log_scales.copy(),
            opacity_logits.copy(),
            np.concatenate([self.values["sh_base"], self.values["sh_rest"]], axis=1),
            initial.instance_id[self.origin],
            initial.instance_conf[self.origin],
            initial.part_id[self.origin],
        )
