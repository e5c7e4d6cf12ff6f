"""Fewer Gaussians that look much like all of them, for browsers that draw without a GPU."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ss_flow.tasks.artifacts import Gaussians
from ss_flow.tasks.gaussians.initialise import select


def thinned(gaussians: Gaussians, share: float) -> Gaussians:
    """Some of the Gaussians, in their order, enlarged so that they cover together what all of them did.

    share: of how many, above 0; at least one stays, and with 1 or more all do, unchanged. Which ones is drawn by lot,
    the same at every call, with chances that grow as opacity times the area of the ellipse of the two largest axes.
    """
    count = int(np.ceil(share * len(gaussians)))
    if count >= len(gaussians):
        return gaussians
    scales = np.sort(np.exp(gaussians.log_scales.astype(np.float64)), axis=1)
    cover = np.maximum(gaussians.opacities * scales[:, 1] * scales[:, 2], 1e-30)
    # Without replacement: the least of exponential waiting times at these rates.
    waiting = np.random.default_rng(0).exponential(size=len(cover)) / cover
    kept = np.sort(np.argpartition(waiting, count - 1)[:count])
    some = select(gaussians, kept)
    enlarged = 0.5 * np.log(cover.sum() / cover[kept].sum())
    return replace(some, log_scales=some.log_scales + np.float32(enlarged))
