"""The guard of refinement: what training made worse than is allowed is undone (spec P4). Beyond Split&Splat."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ss_flow.running import warn
from ss_flow.tasks.artifacts import Gaussians, Int32
from ss_flow.tasks.gaussians.render import render
from ss_flow.tasks.gaussians.views import TrainView
from ss_flow.tasks.masks.overlap import iou

if TYPE_CHECKING:
    from ss_flow.tasks.splat.merge import MergeParams


@dataclass(frozen=True)
class Quality:
    """How well Gaussians explain views."""

    iou: float
    """Mean over views and instances of the IoU of rendered mask and target; 1 where there is no target."""
    psnr: float
    """Over the pixels inside masks, dB."""


def guarded(before: Gaussians, after: Gaussians, views: list[TrainView], ids: Int32, params: MergeParams) -> Gaussians:
    """What a training made of Gaussians, or with a warning what they were, if views lose more by it than allowed.

    ids: [L] the instance of each channel of the views.
    """
    if not params.guard_views:
        return after
    step = max(1, -(-len(views) // params.guard_views))
    old, new = quality(before, views[::step], ids), quality(after, views[::step], ids)
    if acceptable(old, new, params):
        return after
    warn(
        f"Refining instances {', '.join(map(str, ids))} together was undone: it took the IoU of their masks from "
        f"{old.iou:.3f} to {new.iou:.3f} and the PSNR from {old.psnr:.1f} to {new.psnr:.1f} dB."
    )
    return before


def acceptable(old: Quality, new: Quality, params: MergeParams) -> bool:
    """Whether neither IoU nor PSNR is lost beyond its limit, or what the other one gains makes up for it."""
    of_iou, of_psnr = new.iou - old.iou, new.psnr - old.psnr

    def allowed(change: float, limit: float, other: float, others_limit: float) -> bool:
        price = params.guard_trade * -change * others_limit
        # A gain cannot be counted in limits of 0.
        paid = params.guard_trade > 0 and others_limit > 0 and other * limit > price
        return change >= -limit or paid

    return allowed(of_iou, params.guard_iou, of_psnr, params.guard_psnr) and allowed(
        of_psnr, params.guard_psnr, of_iou, params.guard_iou
    )


def quality(gaussians: Gaussians, views: Sequence[TrainView], ids: Int32) -> Quality:
    """Mean mask IoU and PSNR of Gaussians over views with mask targets; ids: [L] the instance of each channel."""
    overlaps: list[float] = []
    error, count = 0.0, 0
    for view in views:
        assert view.ids is not None
        channels = np.unique(view.ids[view.inside])
        rendering = render(gaussians, view.camera, label_ids=ids[channels].tolist(), winners=False)
        error += float(((rendering.rgb - view.image)[view.inside].astype(np.float64) ** 2).sum())
        count += 3 * int(view.inside.sum())
        counts = view.ids != -1  # IGNORED, which says nothing for a mask or against it
        for channel, weight in zip(channels, rendering.label_masks, strict=True):
            overlaps.append(iou((weight >= 0.5) & counts, view.ids == channel))
    mse = max(error / max(1, count), 1e-10)
    return Quality(float(np.mean(overlaps)) if overlaps else 1.0, -10 * float(np.log10(mse)))
