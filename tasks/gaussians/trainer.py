"""Training of 3D Gaussians on posed views: of one instance, of a pair of groups, or of the whole scene."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from ss_flow.events import progress
from ss_flow.tasks.artifacts import Bool, Float32, Gaussians, Int32
from ss_flow.tasks.gaussians import densification
from ss_flow.tasks.gaussians.native_pass import NativePass, Settings
from ss_flow.tasks.gaussians.objective import Target, Weights, gradients_of
from ss_flow.tasks.gaussians.optimizer import Parameters
from ss_flow.tasks.gaussians.rasterize import NEAR_PLANE
from ss_flow.tasks.gaussians.render import channels_of
from ss_flow.tasks.geometry.cameras import Camera
from ss_flow.tasks.ranges import Count, Fraction, HarmonicsDegree, NonNegative, Positive


class TrainingDiverged(RuntimeError):
    """The loss or a parameter is no longer finite."""


@dataclass(frozen=True)
class TrainView:
    """One view to train on; every array has the camera's size."""

    camera: Camera
    """Already cropped to the view's box."""
    image: Float32
    """[h, w, 3] RGB, 0..1."""
    inside: Bool
    """[h, w] pixels of what is trained: colour loss, alpha towards 1."""
    free: Bool
    """[h, w] pixels where nothing is: alpha towards 0. Pixels of neither kind are ignored."""
    depth: Float32
    """[h, w] z-depth in world units, 0 = unknown; counts inside only."""
    ids: Int32 | None = None
    """[h, w] for the mask loss: index into `label_ids`, -1 = ignore, -2 = none of them. None = no mask loss."""


@dataclass(frozen=True)
class TrainParams:
    """How to train."""

    iterations: Count = 1000
    """Steps, one view each."""
    sh_degree: HarmonicsDegree = 3
    """Highest degree of the colours; 0 is used below 2,000 iterations, otherwise one more every 1,000 steps."""
    position_lr: NonNegative = 1.6e-4
    """Learning rate of the means at the start, times the extent."""
    position_lr_final: NonNegative = 1.6e-6
    """Learning rate of the means at the last step, times the extent; the decay is exponential."""
    color_lr: NonNegative = 1e-2
    """Learning rate of the colours (four times that of 3DGS, which trains longer); a twentieth above degree 0."""
    opacity_lr: NonNegative = 0.05
    """Learning rate of the opacity logits."""
    scale_lr: NonNegative = 5e-3
    """Learning rate of the logarithmic scales."""
    rotation_lr: NonNegative = 1e-3
    """Learning rate of the quaternions."""
    ssim_weight: Fraction = 0.2
    """Share of 1 - SSIM in the colour loss; the rest is L1."""
    alpha_weight: NonNegative = 0.5
    """Weight of the mean absolute error of alpha."""
    depth_weight_start: NonNegative = 1.0
    """Weight of the relative depth error at the first step."""
    depth_weight_final: NonNegative = 0.01
    """Weight of the relative depth error at the last step; the decay is exponential."""
    mask_weight: NonNegative = 0.0
    """Weight of the mask loss of merging (spec A25)."""
    background: Literal["random", "black", "white"] = "random"
    """What lies behind: "random" (a colour for each step), "black" or "white"."""
    densify: bool = True
    """Whether to clone and split."""
    densify_grad: Positive = 2e-4
    """Mean screen gradient from which a Gaussian is cloned or split, in 3DGS's units for images 512 pixels high."""
    max_gaussians: Count = 30_000
    """Densification ends at this number."""
    reset_opacity: bool = False
    """Whether to start with no opacity above 0.01 (spec A23)."""
    prune_opacity: Fraction = 0.005
    """Fainter Gaussians are dropped at every densification and at the end."""
    prune_contribution: Fraction = 1 / 255
    """Gaussians with no larger weight in any view are dropped at the end; 0 keeps them."""
    antialias: bool = False
    """Whether to lower the opacity of Gaussians smaller than a pixel."""


@dataclass(frozen=True)
class TrainResult:
    """What training gives."""

    gaussians: Gaussians
    psnr: float
    """dB over the inside pixels of all views, before a black background; 100 at most."""
    iterations: int
    loss: Float32
    """[iterations]."""


def auto_iterations(num_views: int) -> int:
    """Iterations for an instance seen in so many views (spec row 22)."""
    return int(np.clip(40 * num_views, 600, 10_000))


def train(
    initial: Gaussians,
    views: Sequence[TrainView],
    *,
    params: TrainParams,
    extent: float,
    seed: int,
    label_ids: Sequence[int] = (),
    on_progress: Callable[[int, int, str], None] = progress,
) -> TrainResult:
    """Fit Gaussians to views with Adam (Kerbl et al. 2023, Sec. 5; spec P1, P4).

    extent: size of what is trained, world units: scales the learning rate of the means and tells large Gaussians from
    small. label_ids: instance ids of the mask loss's channels. Single-threaded, and the same bytes whatever else runs.
    Raises ValueError when there are no views or Gaussians or an array does not fit its camera, TrainingDiverged when
    numbers blow up. The result has no Gaussians when all were pruned.
    """
    if len(initial) == 0 or len(views) == 0:
        raise ValueError(f"training needs Gaussians and views, but got {len(initial)} and {len(views)}")
    if not extent > 0:
        raise ValueError(f"the extent must be positive, not {extent}")
    if params.background not in ("random", "black", "white"):
        raise ValueError(f'background must be "random", "black" or "white", not {params.background!r}')
    targets = [
        Target.of(v.camera, v.image, v.inside, v.free, v.depth, v.ids, len(label_ids) if params.mask_weight else 0)
        for v in views
    ]
    generator = np.random.default_rng(seed)
    given_degree = round(initial.sh.shape[1] ** 0.5) - 1
    last_degree = min(params.sh_degree, params.iterations // 1000) if params.iterations >= 2000 else 0
    parameters = Parameters(initial, max(given_degree, last_degree))
    if not parameters.finite():
        raise ValueError("the initial Gaussians hold values that are not finite")
    if params.reset_opacity:
        parameters.limit_opacity(0.01)
    channels = channels_of(initial.instance_id, label_ids)
    schedule = densification.Schedule.of(params.iterations)
    record = densification.GradientRecord(len(parameters))
    losses = np.zeros(params.iterations, np.float32)
    order: list[int] = []
    for step in range(1, params.iterations + 1):
        if not order:
            order = generator.permutation(len(targets)).tolist()
        target = targets[order.pop()]
        done_share = (step - 1) / max(params.iterations - 1, 1)
        degree = max(given_degree, min(last_degree, step // 1000))
        settings = Settings(
            _background(params.background, generator),
            target.num_labels, degree, NEAR_PLANE, params.antialias, winners=False,
        )  # fmt: skip
        labels = target.channel_of_label[channels[parameters.origin]] if target.num_labels else None
        rendered = NativePass(parameters.for_rendering(degree), labels, target.camera, settings)
        weights = Weights(
            params.ssim_weight,
            params.alpha_weight,
            _decay(params.depth_weight_start, params.depth_weight_final, done_share),
            params.mask_weight,
        )
        losses[step - 1], towards = gradients_of(rendered, target, weights)
        gradients = rendered.backward(*towards)
        parameters.step(gradients, _rates(params, extent, done_share), step)
        if not np.isfinite(losses[step - 1]) or (step % 50 == 0 and not parameters.finite()):
            raise TrainingDiverged(f"training of {len(parameters)} Gaussians diverged at step {step}")
        if params.densify:
            if step <= schedule.stop:
                record.add(gradients["centers"], rendered.radii, target.pixels)
            if schedule.densifies(step):
                _control(parameters, record, params, extent, step > schedule.reset_every, generator)
                record = densification.GradientRecord(len(parameters))
                if len(parameters) == 0:
                    return TrainResult(parameters.to_gaussians(initial), 0.0, step, losses[:step])
            if schedule.resets(step):
                parameters.limit_opacity(0.01)
        if step % 50 == 0 or step == params.iterations:
            on_progress(step, params.iterations, f"{len(parameters)} Gaussians, loss {losses[step - 1]:.4f}")
    if not parameters.finite():
        raise TrainingDiverged(f"training of {len(parameters)} Gaussians diverged")
    psnr = _finish(parameters, targets, params, max(given_degree, last_degree))
    return TrainResult(parameters.to_gaussians(initial), psnr, params.iterations, losses)


def _background(kind: str, generator: np.random.Generator) -> tuple[float, float, float]:
    if kind == "random":
        red, green, blue = generator.random(3).tolist()
        return red, green, blue
    return (0.0, 0.0, 0.0) if kind == "black" else (1.0, 1.0, 1.0)


def _decay(start: float, final: float, share: float) -> float:
    if start <= 0 or final <= 0:
        return start + (final - start) * share
    return float(start * (final / start) ** share)


def _rates(params: TrainParams, extent: float, share: float) -> dict[str, float]:
    return {
        "means": extent * _decay(params.position_lr, params.position_lr_final, share),
        "quaternions": params.rotation_lr,
        "log_scales": params.scale_lr,
        "opacity_logits": params.opacity_lr,
        "sh_base": params.color_lr,
        "sh_rest": params.color_lr / 20,
    }


def _opaque_enough(parameters: Parameters, opacity: float) -> Bool:
    return 1 / (1 + np.exp(-parameters.values["opacity_logits"].astype(np.float64))) >= opacity


def _control(
    parameters: Parameters,
    record: densification.GradientRecord,
    params: TrainParams,
    extent: float,
    prune_large: bool,
    generator: np.random.Generator,
) -> None:
    parameters.rearrange(
        *densification.densify(
            parameters.values,
            record.mean(),
            threshold=params.densify_grad,
            extent=extent,
            most=params.max_gaussians,
            generator=generator,
        )
    )
    keep = _opaque_enough(parameters, params.prune_opacity)
    if prune_large:
        keep &= np.exp(parameters.values["log_scales"]).max(axis=1) <= 0.1 * extent
    parameters.keep(keep)


def _finish(parameters: Parameters, targets: Sequence[Target], params: TrainParams, degree: int) -> float:
    """Drop what shows nowhere; the PSNR of what stays."""
    settings = Settings((0.0, 0.0, 0.0), 0, degree, NEAR_PLANE, params.antialias, winners=True)
    parameters.keep(_opaque_enough(parameters, params.prune_opacity))
    strongest = np.zeros(len(parameters), np.float32)
    error, count = 0.0, 0
    for target in targets:
        rendered = NativePass(parameters.for_rendering(degree), None, target.camera, settings)
        np.maximum(strongest, rendered.strongest, out=strongest)
        inside = target.inside > 0
        error += float(np.square(np.clip(rendered.rgb[inside], 0, 1) - target.image[inside], dtype=np.float64).sum())
        count += 3 * int(inside.sum())
    if params.prune_contribution > 0:
        parameters.keep(strongest >= params.prune_contribution)
    return float(-10 * np.log10(max(error / max(count, 1), 1e-10))) if count else 0.0
