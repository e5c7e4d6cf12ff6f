"""Training of 3D Gaussians on posed views: of one instance, of a pair of groups, or of the whole scene."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from ss_flow.running import cores, load_checkpoint, progress, save_checkpoint
from ss_flow.tasks.artifacts import Float32, Gaussians
from ss_flow.tasks.gaussians.backends import backend_for
from ss_flow.tasks.gaussians.densification import AdaptiveControl, Schedule, Seen
from ss_flow.tasks.gaussians.native_pass import NativePass, Settings
from ss_flow.tasks.gaussians.objective import Objective, Target, decayed
from ss_flow.tasks.gaussians.optimizer import Parameters
from ss_flow.tasks.gaussians.rasterize import training_device
from ss_flow.tasks.gaussians.render import channels_of
from ss_flow.tasks.gaussians.views import TrainView
from ss_flow.tasks.ranges import Count, Fraction, HarmonicsDegree, Natural, NonNegative, Positive

CHECKPOINT_SECONDS = 60.0
"""How much work a kill may cost."""


class TrainingDiverged(RuntimeError):
    """The loss or a parameter is no longer finite."""


@dataclass(frozen=True)
class LearningRates:
    """Adam's learning rates, for trainings of hundreds of steps; those of 3DGS, for 30,000, are several times lower."""

    position: NonNegative = 3.2e-4
    """Of the means at the first step, times the extent of what is trained."""
    position_final: NonNegative = 3.2e-6
    """Of the means at the last step, times the extent; the decay is exponential."""
    color: NonNegative = 1e-2
    """Of the colours; a twentieth above degree 0."""
    opacity: NonNegative = 0.05
    """Of the opacity logits."""
    scale: NonNegative = 2e-2
    """Of the logarithmic scales."""
    rotation: NonNegative = 3e-3
    """Of the quaternions."""


SLOW_RATES = LearningRates(position=1.6e-4, position_final=1.6e-6, scale=5e-3, rotation=1e-3)
"""For trainings of thousands of steps, and where centres must not leave a surface without texture: 3DGS's but for the
colours."""


@dataclass(frozen=True)
class TrainParams:
    """How to train."""

    iterations: Count = 1000
    """Steps, one view each."""
    sh_degree: HarmonicsDegree = 3
    """Highest degree of the colours; 0 is used below 2,000 iterations, otherwise one more every 1,000 steps."""
    rates: LearningRates = LearningRates()
    """How fast each parameter is learnt."""
    objective: Objective = Objective()
    """What is made small."""
    mask_weight: NonNegative = 0.0
    """Weight of the mask loss of merging, w_mask (spec A25)."""
    densify: Literal["classic", "none"] = "classic"
    """How the number of Gaussians grows: "classic" clones and splits as in 3DGS, "none" leaves it."""
    densify_grad: Positive = 2e-4
    """Mean screen gradient from which a Gaussian is cloned or split, in 3DGS's units for images 512 pixels high."""
    schedule: Schedule = Schedule()
    """When "classic" clones and splits."""
    max_gaussians: Natural = 30_000
    """Densification ends at this number; 0 = never."""
    prune_opacity: Fraction = 0.005
    """Fainter Gaussians are dropped at every densification and at the end."""
    prune_contribution: Fraction = 1 / 255
    """Gaussians with no larger weight in any view are dropped at the end; 0 keeps them."""
    max_scale: NonNegative = 0.0
    """No standard deviation exceeds this share of the extent, or the largest it starts with where that is more; 0 = no
    limit."""


@dataclass(frozen=True)
class TrainResult:
    """What training gives."""

    gaussians: Gaussians
    psnr: float
    """dB over the inside pixels of all views, before a black background; 100 at most."""
    iterations: int
    loss: Float32
    """[iterations] of each step."""


def train(
    initial: Gaussians,
    views: Sequence[TrainView],
    *,
    params: TrainParams,
    extent: float | Float32,
    seed: int,
    label_ids: Sequence[int] = (),
) -> TrainResult:
    """Fit Gaussians to views with Adam (Kerbl et al. 2023, Sec. 5; spec P1, P4).

    extent: size of what is trained, world units, or [N] of what each Gaussian is part of: scales the learning rate of
    the means and tells large Gaussians from small. label_ids: instance ids of the mask loss. On the CPU the number of
    threads changes no byte, and neither does a kill: a later try goes on from the last checkpoint.
    Raises ValueError when there are no views or Gaussians or an array does not fit its camera, TrainingDiverged when
    numbers blow up. The result has no Gaussians when all were pruned.
    """
    if len(initial) == 0 or len(views) == 0:
        raise ValueError(f"training needs Gaussians and views, but got {len(initial)} and {len(views)}")
    extents = np.broadcast_to(np.asarray(extent, np.float32), len(initial))
    if not (extents > 0).all():
        raise ValueError(f"the extent must be positive, not {extents.min()}")
    for name, value, allowed in (
        ("densify", params.densify, ("classic", "none")),
        ("background", params.objective.background, ("random", "black")),
        ("depth_error", params.objective.depth_error, ("relative", "inverse")),
    ):
        if value not in allowed:
            raise ValueError(f"{name} must be one of {', '.join(allowed)}, not {value!r}")
    training = _Training(initial, views, params, extents, seed, label_ids)
    training.resume()
    saved = time.monotonic()
    while training.step < params.iterations and len(training.parameters):
        training.advance()
        if training.step % 50 and training.step < params.iterations:
            continue
        training.check()
        try:
            note = f"{len(training.parameters)} Gaussians, loss {training.losses[training.step - 1]:.4f}"
            progress(training.step, params.iterations, note)
        except BaseException:  # the run is being cancelled
            training.save()
            raise
        if time.monotonic() - saved > CHECKPOINT_SECONDS:
            training.save()
            saved = time.monotonic()
    return training.finish()


class _Training:
    """The state of a training, from step to step."""

    def __init__(
        self,
        initial: Gaussians,
        views: Sequence[TrainView],
        params: TrainParams,
        extents: Float32,
        seed: int,
        label_ids: Sequence[int],
    ) -> None:
        num_labels = len(label_ids) if params.mask_weight else 0
        self._initial, self._params, self._extents, self._num_labels = initial, params, extents, num_labels
        self._targets = [Target.of(view, params.objective, num_labels) for view in views]
        self._generator = np.random.default_rng(seed)
        self._given_degree = round(initial.sh.shape[1] ** 0.5) - 1
        last = min(params.sh_degree, params.iterations // 1000) if params.iterations >= 2000 else 0
        self._last_degree = max(self._given_degree, last)
        self.parameters = Parameters(initial, self._last_degree)
        if not self.parameters.finite():
            raise ValueError("the initial Gaussians hold values that are not finite")
        self._channels = channels_of(initial.instance_id, label_ids)
        self._extent = float(extents.max())
        # A few sparse points of a small thing must be let fill the space between them.
        self._longest = np.maximum(np.float32(params.max_scale) * extents, np.exp(initial.log_scales.max(axis=1)))
        self._control = _control(params, len(initial), self._extent)
        self.step = 0
        self.losses = np.zeros(params.iterations, np.float32)
        self._order: list[int] = []
        self._backend = backend_for(training_device(), cores())

    def advance(self) -> None:
        """One step: render a view, compare, go down the gradient, mind the number of Gaussians."""
        params, parameters = self._params, self.parameters
        if not self._order:
            self._order = self._generator.permutation(len(self._targets)).tolist()
        target = self._targets[self._order.pop()]
        done_share = self.step / max(params.iterations - 1, 1)
        self.step += 1
        degree = max(self._given_degree, min(self._last_degree, self.step // 1000))
        behind = params.objective.behind(self._generator)
        settings = Settings(behind, self._num_labels, degree, winners=False)
        weights = params.objective.at(done_share, params.mask_weight)
        labels = self._channels[parameters.origin] if target.ids is not None else None
        found = self._backend.descent(parameters.arrays(), labels, target, settings, weights)
        self.losses[self.step - 1] = found.loss
        if not np.isfinite(found.loss):
            raise TrainingDiverged(f"training of {len(parameters)} Gaussians diverged at step {self.step}")
        extents = self._extents[parameters.origin]
        means_rate = decayed(params.rates.position, params.rates.position_final, done_share)
        parameters.step(found.gradients, _by_name(params.rates), self.step, degree, np.float32(means_rate) * extents)
        if params.max_scale:
            parameters.limit_scale(self._longest[parameters.origin])
        if self._control is not None:
            seen = Seen(found.gradients["centers"], found.radii, target.pixels)
            self._control.after(self.step, parameters, seen, self._generator)

    def check(self) -> None:
        """Raises TrainingDiverged when a parameter is no longer finite."""
        if not self.parameters.finite():
            raise TrainingDiverged(f"training of {len(self.parameters)} Gaussians diverged at step {self.step}")

    def save(self) -> None:
        """Keep everything for a later try."""
        state: dict[str, NDArray[Any]] = {
            "step": np.array(self.step),
            "losses": self.losses,
            "order": np.array(self._order, np.int64),
            "generator": np.frombuffer(json.dumps(self._generator.bit_generator.state).encode(), np.uint8),
        }
        control = {} if self._control is None else self._control.state()
        save_checkpoint({**state, **self.parameters.state(), **control})

    def resume(self) -> None:
        """Go on from what an earlier try kept, if there is any."""
        state = load_checkpoint()
        if state is None:
            return
        self.step, self._order = int(state["step"]), state["order"].tolist()
        self.losses[:] = state["losses"]
        self._generator.bit_generator.state = json.loads(state["generator"].tobytes())
        self.parameters.restore(state)
        if self._control is not None:
            self._control.restore(state)

    def finish(self) -> TrainResult:
        """Drop what shows nowhere; the PSNR of what stays."""
        parameters, params = self.parameters, self._params
        settings = Settings((0.0, 0.0, 0.0), 0, self._last_degree, winners=True)
        parameters.keep(parameters.opacities() >= params.prune_opacity)
        strongest = np.zeros(len(parameters), np.float32)
        error, count = 0.0, 0
        for target in self._targets:
            rendered = NativePass(parameters.arrays(), None, target.camera, settings, threads=cores())
            assert rendered.strongest is not None
            np.maximum(strongest, rendered.strongest, out=strongest)
            inside = target.inside > 0
            off = np.clip(rendered.rgb[inside], 0, 1) - target.image[inside]
            error += float(np.square(off, dtype=np.float64).sum())
            count += 3 * int(inside.sum())
        if params.prune_contribution > 0:
            parameters.keep(strongest >= params.prune_contribution)
        psnr = float(-10 * np.log10(max(error / max(count, 1), 1e-10))) if count else 0.0
        return TrainResult(parameters.to_gaussians(self._initial), psnr, self.step, self.losses[: self.step])


def _control(params: TrainParams, count: int, extent: float) -> AdaptiveControl | None:
    if params.densify == "none":
        return None
    return AdaptiveControl(
        count,
        params.schedule.of(params.iterations),
        threshold=params.densify_grad,
        extent=extent,
        most=params.max_gaussians or sys.maxsize,
        prune_opacity=params.prune_opacity,
    )


def _by_name(rates: LearningRates) -> dict[str, float]:
    return {
        "means": 1.0,
        "quaternions": rates.rotation,
        "log_scales": rates.scale,
        "opacity_logits": rates.opacity,
        "sh": rates.color,
        "sh_rest": rates.color / 20,
    }
