"""How fast a training learns each parameter of the Gaussians, from its first step to its last."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, Literal

from ss_flow.tasks.gaussians.backends import Array
from ss_flow.tasks.gaussians.objective import decayed
from ss_flow.tasks.ranges import Fraction, NonNegative


@dataclass(frozen=True)
class LearningRates:
    """Adam's learning rates, for trainings of hundreds of steps; those of 3DGS, for 30,000, are several times lower."""

    position: NonNegative = 3.2e-4
    """Of the means at the first step, times the extent of what is trained."""
    position_final: NonNegative = 3.2e-6
    """Of the means at the last step, times the extent."""
    color: NonNegative = 1e-2
    """Of the colours; a twentieth above degree 0."""
    opacity: NonNegative = 0.05
    """Of the opacity logits."""
    scale: NonNegative = 2e-2
    """Of the logarithmic scales."""
    rotation: NonNegative = 3e-3
    """Of the quaternions."""
    final_share: Fraction = 1.0
    """What is left at the last step of the rates of colours, opacities, scales and quaternions; 1 = they stay, as in
    3DGS."""
    fall: Literal["exponential", "cosine"] = "exponential"
    """How rates get from the first step's to the last one's: "exponential", as in 3DGS; or along half a "cosine", which
    stays high for longer (Loshchilov and Hutter 2017)."""

    def at(self, done_share: float) -> LearningRates:
        """The rates of a step. done_share: 0 for the first, 1 for the last."""
        fallen = decayed if self.fall == "exponential" else _along_cosine
        rest = fallen(1.0, self.final_share, done_share)
        return replace(
            self,
            position=fallen(self.position, self.position_final, done_share),
            color=rest * self.color,
            opacity=rest * self.opacity,
            scale=rest * self.scale,
            rotation=rest * self.rotation,
        )

    def by_parameter(self, extent: float | Array) -> dict[str, Any]:
        """The rates by the names of the parameters. extent: one, or [N] of what each Gaussian is part of."""
        return {
            "means": self.position * extent,
            "quaternions": self.rotation,
            "log_scales": self.scale,
            "opacity_logits": self.opacity,
            "sh": self.color,
            "sh_rest": self.color / 20,
        }


SLOW_RATES = LearningRates(position=1.6e-4, position_final=1.6e-6, scale=5e-3, rotation=1e-3)
"""For trainings of thousands of steps, and where centres must not leave a surface without texture: 3DGS's but for the
colours."""


def _along_cosine(start: float, final: float, share: float) -> float:
    """From `start` to `final` along half a cosine."""
    return final + (start - final) * (1 + math.cos(math.pi * share)) / 2
