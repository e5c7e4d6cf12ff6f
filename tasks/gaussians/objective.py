"""What a training makes small: the weights of its losses, what counts as empty, and what a view asks for."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from ss_flow.tasks.artifacts import Bool, Float32, Int32
from ss_flow.tasks.gaussians.views import TrainView
from ss_flow.tasks.geometry.cameras import Camera
from ss_flow.tasks.ranges import Fraction, NonNegative


@dataclass(frozen=True)
class Objective:
    """l_RGB and what is added to it (Split&Splat, Sec. 3.2; spec P1, P4); merges add their mask loss."""

    ssim_weight: Fraction = 0.2
    """Share of 1 - SSIM in the colour loss; the rest is L1."""
    background: Literal["random", "black"] = "random"
    """What lies behind the Gaussians: "random", a colour for each step, and colour counts inside the masks only; or
    "black", as in the paper: the photos are black where nothing may be seen, and colour counts there too."""
    alpha_weight: NonNegative = 0.5
    """Weight of the mean absolute error of alpha, which is to be 1 inside the masks and 0 where nothing may be seen; 0
    in the paper, where black pixels say it."""
    depth_error: Literal["relative", "inverse"] = "relative"
    """How depth is compared: "relative" to the depth that is known, a mean over the pixels where it is; or "inverse",
    |1 / depth - 1 / known depth| in world units, a mean over all pixels where colour counts, as in 3DGS."""
    depth_weight_start: NonNegative = 1.0
    """Weight of the depth error at the first step."""
    depth_weight_final: NonNegative = 0.01
    """Weight of the depth error at the last step; the decay is exponential."""

    def at(self, done_share: float, mask_weight: float) -> Weights:
        """The weights of a step. done_share: 0 for the first, 1 for the last."""
        depth = decayed(self.depth_weight_start, self.depth_weight_final, done_share)
        return Weights(self.ssim_weight, self.alpha_weight, depth, mask_weight, self.depth_error == "inverse")

    def counted(self, view: TrainView) -> Bool:
        """[h, w] the pixels whose colour counts."""
        return view.inside | view.free if self.background == "black" else view.inside

    def behind(self, generator: np.random.Generator) -> tuple[float, float, float]:
        """The colour behind the Gaussians in one step."""
        if self.background == "black":
            return 0.0, 0.0, 0.0
        red, green, blue = generator.random(3).tolist()
        return red, green, blue


@dataclass(frozen=True)
class Weights:
    """How much each part counts in one step."""

    ssim: float
    alpha: float
    depth: float
    mask: float
    inverse_depth: bool = False
    """Whether inverse depths are compared."""


def decayed(start: float, final: float, share: float) -> float:
    """From `start` to `final`, exponentially; linearly where one of them is 0."""
    if start <= 0 or final <= 0:
        return start + (final - start) * share
    return float(start * (final / start) ** share)


@dataclass(frozen=True)
class Target:
    """What one view should look like, laid out for the losses."""

    camera: Camera
    image: Float32
    """[h, w, 3]."""
    counted: Float32
    """[h, w] 1 where the colour counts."""
    inside: Float32
    """[h, w] 1 where alpha should be 1."""
    judged: Float32
    """[h, w] where alpha counts, 1 / number of the pixels that the mean of its error is over; 0 elsewhere."""
    depth: Float32
    """[h, w] 1 where unknown."""
    known: Float32
    """[h, w] 1 / number of pixels in the mean of the depth error, at inside pixels of known depth; 0 elsewhere."""
    ids: Int32 | None
    """[h, w] the label that each pixel should show, negative where none; None without mask loss."""
    labelled: Float32 | None
    """[h, w] 1 / (number of labels * number of pixels that are not ignored) there, 0 elsewhere."""

    @classmethod
    def of(cls, view: TrainView, objective: Objective, num_labels: int) -> Target:
        """Raises ValueError when an array does not have the camera's size or an id is out of range."""
        camera, image, ids = view.camera, view.image, view.ids
        size = (camera.height, camera.width)
        for name in ("inside", "free", "depth", "ids"):
            array = getattr(view, name)
            if array is not None and array.shape != size:
                raise ValueError(f"{name} must be {list(size)} like its camera, not {list(array.shape)}")
        if image.shape != (*size, 3) or image.dtype != np.float32:
            raise ValueError(f"image must be {[*size, 3]} float32, not {list(image.shape)} {image.dtype}")
        inside, free, counted = view.inside, view.free, objective.counted(view)
        if objective.background == "black":
            image = np.where(inside[..., None], image, np.float32(0))
        known = inside & (view.depth > 0) & np.isfinite(view.depth)
        labelled = None
        if ids is None or not num_labels:
            ids = None
        else:
            if ids.max(initial=-1) >= num_labels:
                raise ValueError(f"ids must be below the {num_labels} label ids, but one is {int(ids.max())}")
            labelled = _mean(ids != -1) / np.float32(num_labels)
            ids = np.ascontiguousarray(ids, np.int32)
        return cls(
            camera,
            np.ascontiguousarray(image),
            counted.astype(np.float32),
            inside.astype(np.float32),
            _mean(inside | free),
            np.where(known, view.depth, 1).astype(np.float32),
            _mean(known, counted if objective.depth_error == "inverse" else known),
            ids,
            labelled,
        )


@dataclass(frozen=True)
class Targets:
    """What some views should look like. Each is laid out when it is asked for: a layout takes a hundredth of the time
    of a step, but as much memory as the view itself."""

    views: Sequence[TrainView]
    objective: Objective
    num_labels: int

    def __getitem__(self, view: int) -> Target:
        return Target.of(self.views[view], self.objective, self.num_labels)

    def __iter__(self) -> Iterator[Target]:
        return (self[view] for view in range(len(self.views)))


def _mean(where: Bool, over: Bool | None = None) -> Float32:
    """Weights of a mean over some pixels, or of a sum of theirs over the number of others."""
    count = int(np.count_nonzero(where if over is None else over))
    return where * np.float32(1 / max(count, 1))
