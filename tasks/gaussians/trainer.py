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

from ss_flow.running import cores, last_try, load_checkpoint, progress, save_checkpoint, warn
from ss_flow.tasks.artifacts import Float32, Gaussians
from ss_flow.tasks.gaussians.backends import AdamStep, Backend, backend_for
from ss_flow.tasks.gaussians.densification import AdaptiveControl, GradientRecord, Schedule, Seen
from ss_flow.tasks.gaussians.initialise import log_lengths
from ss_flow.tasks.gaussians.learning_rates import LearningRates
from ss_flow.tasks.gaussians.native_pass import Settings
from ss_flow.tasks.gaussians.objective import Objective, Target, Targets
from ss_flow.tasks.gaussians.optimizer import Parameters
from ss_flow.tasks.gaussians.rasterize import device_for
from ss_flow.tasks.gaussians.render import channels_of
from ss_flow.tasks.gaussians.views import TrainView
from ss_flow.tasks.ranges import Count, Fraction, HarmonicsDegree, Natural, NonNegative, Positive

CHECKPOINT_SECONDS = 60.0
"""How much work a kill may cost."""


class TrainingDiverged(RuntimeError):
    """The loss or a parameter is no longer finite."""


@dataclass(frozen=True)
class TrainParams:
    """How to train."""

    iterations: Count = 1000
    """Steps, one view each."""
    sh_degree: HarmonicsDegree = 3
    """Highest degree of the colours, which begin with 0."""
    sh_every: Count = 1000
    """Steps from one degree to the next; a training of less than two such spans keeps to 0."""
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
    part_weight: NonNegative = 0.0
    """Weight of the mean absolute error of alpha in the views of parts."""
    parts_per_step: Count = 1
    """How many views of parts each step sees."""
    prune_opacity: Fraction = 0.005
    """Fainter Gaussians are dropped at every densification and at the end."""
    prune_contribution: Fraction = 1 / 255
    """Gaussians with no larger weight in any view are dropped at the end; 0 keeps them."""
    prune_hidden: Fraction = 0.0
    """Gaussians whose largest weight in any view is less than this share of their opacity are dropped at the end: so
    little of them is left to see by what stands before them."""
    max_length: NonNegative = 0.0
    """No standard deviation of an instance's Gaussians exceeds so many times the median of the longest with which they
    start; those of the background (id 0) may. 0 = no limit."""


@dataclass(frozen=True)
class PartView:
    """What some of the Gaussians alone, without the others, should cover; only the target's alpha counts."""

    start: int
    """The first row of these Gaussians."""
    stop: int
    """The row behind the last."""
    target: Target


@dataclass(frozen=True)
class TrainResult:
    """What training gives."""

    gaussians: Gaussians
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
    parts: Sequence[PartView] = (),
    backend: Backend | None = None,
) -> TrainResult:
    """Fit Gaussians to views with Adam (Kerbl et al. 2023, Sec. 5; spec P1, P4).

    extent: size of what is trained, world units, or [N] of what each Gaussian is part of: scales the learning rate of
    the means and tells large Gaussians from small. label_ids: instance ids of the mask loss. parts: what some rows of
    `initial` should look like alone, with `part_weight`, where nothing is cloned or split. backend: where it happens;
    by default on `device_for` views of their mean size, and on the CPU in a last try where a device has not enough
    memory. On the CPU the number of threads changes no byte, and neither does a kill: a later try goes on from the last
    checkpoint.
    Raises ValueError when there are no views or Gaussians, an array does not fit its camera, or rows of parts would
    move, TrainingDiverged when numbers blow up. The result has no Gaussians when all were pruned.
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
        ("fall", params.rates.fall, ("exponential", "cosine")),
    ):
        if value not in allowed:
            raise ValueError(f"{name} must be one of {', '.join(allowed)}, not {value!r}")
    if parts and params.densify != "none":
        raise ValueError("views of parts need Gaussians whose rows stay, so densify must be none")

    def run_on(backend: Backend) -> TrainResult:
        with backend.stream():
            return _Training(initial, views, params, extents, seed, label_ids, parts, backend).run()

    if backend is not None:
        return run_on(backend)
    device = device_for(sum(view.camera.width * view.camera.height for view in views) / len(views))
    try:
        return run_on(backend_for(device, cores()))
    except MemoryError:
        if device == "cpu" or not last_try():
            raise
    warn(f"{device} has not enough memory for a training of {len(views)} views: it ran on the CPU.")
    return run_on(backend_for("cpu", cores()))


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
        parts: Sequence[PartView],
        backend: Backend,
    ) -> None:
        num_labels = len(label_ids) if params.mask_weight else 0
        self._initial, self._params, self._num_labels, self._backend = initial, params, num_labels, backend
        self._there = backend.targets(Targets(views, params.objective, num_labels))
        self._parts = (
            [(slice(p.start, p.stop), backend.target(p.target, 0)) for p in parts] if params.part_weight else []
        )
        # An order of its own that every step can look up: it moves no other draw, and a later try need not know it.
        self._turns = np.random.default_rng(seed).permutation(len(self._parts))
        self._generator = np.random.default_rng(seed)
        self._given_degree = initial.sh_degree
        spans = params.iterations // params.sh_every
        last = min(params.sh_degree, spans) if spans >= 2 else 0
        self._last_degree = max(self._given_degree, last)
        self.parameters = Parameters(initial, self._last_degree, backend)
        if not self.parameters.finite():
            raise ValueError("the initial Gaussians hold values that are not finite")
        self._extents = backend.put(extents)
        self._channels = backend.put(channels_of(initial.instance_id, label_ids)) if num_labels else None
        self._log_longest = backend.put(_log_longest(initial, params.max_length)) if params.max_length else None
        self._limits: tuple[Any, Any] | None = None
        """`origin` of the parameters, and what of that holds for each: laid out anew when Gaussians came or went."""
        self._control = _control(params, GradientRecord(len(initial), backend), float(extents.max()))
        self.step = 0
        # Of each view, those whose colour counts.
        self._pixels = [int(np.count_nonzero(params.objective.counted(view))) for view in views]
        self._losses = backend.put(np.zeros(params.iterations, np.float32))
        self._order: list[int] = []

    def run(self) -> TrainResult:
        """All steps that are still to be done."""
        self.resume()
        saved = time.monotonic()
        while self.step < self._params.iterations and len(self.parameters):
            self.advance()
            if self.step % 50 and self.step < self._params.iterations:
                continue
            note = f"{len(self.parameters)} Gaussians, loss {self.losses()[-1]:.4f}"
            try:
                progress(self.step, self._params.iterations, note)
            except BaseException:  # the run is being cancelled
                self.save()
                raise
            if time.monotonic() - saved > CHECKPOINT_SECONDS:
                self.save()
                saved = time.monotonic()
        return self.finish()

    def advance(self) -> None:
        """One step: render a view, compare, go down the gradient, mind the number of Gaussians."""
        params, parameters = self._params, self.parameters
        if not self._order:
            self._order = self._generator.permutation(len(self._pixels)).tolist()
        view = self._order.pop()
        done_share = self.step / max(params.iterations - 1, 1)
        self.step += 1
        degree = max(self._given_degree, min(self._last_degree, self.step // params.sh_every))
        behind = params.objective.behind(self._generator)
        settings = Settings(behind, self._num_labels, degree, winners=False)
        weights = params.objective.at(done_share, params.mask_weight)
        labels = None if self._channels is None else self._channels[parameters.origin]
        towards_parts = self._backend.towards_parts(parameters.values, self._seen_alone(), params.part_weight)
        found = self._backend.descent(parameters.values, labels, self._there[view], settings, weights)
        for rows, towards in towards_parts:
            for name, gradient in towards.items():
                found.gradients[name][rows] += gradient
        self._losses[self.step - 1] = found.loss
        rates = params.rates.at(done_share).by_parameter(self._extents[parameters.origin])
        parameters.step(found.gradients, AdamStep(self.step, rates, degree))
        if self._log_longest is not None:
            if self._limits is None or self._limits[0] is not parameters.origin:
                self._limits = parameters.origin, self._log_longest[parameters.origin]
            parameters.limit_scale(self._limits[1])
        if self._control is not None:
            seen = Seen(found.gradients["centers"], found.radii, self._pixels[view])
            self._control.after(self.step, parameters, seen, self._generator)

    def _seen_alone(self) -> list[tuple[slice, Any]]:
        """The parts whose turn it is."""
        most = self._params.parts_per_step if self._parts else 0
        turns = range(most * self.step, most * (self.step + 1))
        return [self._parts[self._turns[turn % len(self._turns)]] for turn in turns]

    def losses(self) -> Float32:
        """Of the steps so far. Raises TrainingDiverged when one of them or a parameter is not finite.

        A step does not wait to know that: it is found out when somebody looks.
        """
        losses = self._backend.host(self._losses[: self.step])
        wrong = np.flatnonzero(~np.isfinite(losses))
        if len(wrong) or not self.parameters.finite():
            step = int(wrong[0]) + 1 if len(wrong) else self.step
            raise TrainingDiverged(f"training of {len(self.parameters)} Gaussians diverged at step {step}")
        return losses

    def save(self) -> None:
        """Keep everything for a later try."""
        state: dict[str, NDArray[Any]] = {
            "step": np.array(self.step),
            "losses": self._backend.host(self._losses),
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
        self._losses = self._backend.put(state["losses"])
        self._generator.bit_generator.state = json.loads(state["generator"].tobytes())
        self.parameters.restore(state)
        if self._control is not None:
            self._control.restore(state)

    def finish(self) -> TrainResult:
        """Drop what is faint and what shows nowhere."""
        parameters, params, xp = self.parameters, self._params, self._backend.xp
        losses = self.losses()
        parameters.keep(parameters.opacities() >= params.prune_opacity)
        if params.prune_contribution > 0 or params.prune_hidden > 0:
            strongest = xp.zeros_like(parameters.values["opacity_logits"])
            for there in self._there:
                strongest = xp.maximum(strongest, self._backend.strongest(parameters.values, there))
            seen = strongest >= params.prune_hidden * parameters.opacities()
            parameters.keep(seen & (strongest >= params.prune_contribution))
        return TrainResult(parameters.to_gaussians(self._initial), self.step, losses)


def _log_longest(initial: Gaussians, max_length: float) -> Float32:
    """[N, 3] the logarithm of the longest standard deviation that each Gaussian may have, along each axis."""
    longest = np.log(np.float32(max_length)) + log_lengths(initial)
    return np.repeat(np.where(initial.instance_id == 0, np.float32(np.inf), longest)[:, None], 3, axis=1)


def _control(params: TrainParams, record: GradientRecord, extent: float) -> AdaptiveControl | None:
    if params.densify == "none":
        return None
    return AdaptiveControl(
        record,
        params.schedule.of(params.iterations),
        threshold=params.densify_grad,
        extent=extent,
        most=params.max_gaussians or sys.maxsize,
        prune_opacity=params.prune_opacity,
    )
