"""Fit a monocular network's inverse depth, known up to scale and shift, to depths that are known."""

from __future__ import annotations

import numpy as np

from ss_flow.tasks.artifacts import Float32, Float64

_TRIALS = 500
"""Pairs of points that are tried."""


def fit_scale_shift(
    relative: Float32 | Float64,
    inverse_depth: Float32 | Float64,
    max_relative: float = 0.05,
) -> tuple[float, float, float] | None:
    """Scale a > 0 and shift b such that a * relative + b = inverse depth, for most of the points.

    RANSAC over pairs of points (Fischler & Bolles 1981), where a point counts when it is met within `max_relative` of
    its inverse depth; then least squares with Huber's weights over all points (Huber 1964), with the scale of the
    residuals from their median.
    relative, inverse_depth: [N], the latter positive. Returns a, b and the share of points met, or None when no
    increasing line meets any two.
    """
    x, y = np.asarray(relative, np.float64), np.asarray(inverse_depth, np.float64)
    if len(x) < 2:
        return None
    pairs = np.random.default_rng(0).integers(0, len(x), (_TRIALS, 2))
    with np.errstate(divide="ignore", invalid="ignore"):
        scale = (y[pairs[:, 1]] - y[pairs[:, 0]]) / (x[pairs[:, 1]] - x[pairs[:, 0]])
    shift = y[pairs[:, 0]] - scale * x[pairs[:, 0]]
    possible = np.isfinite(scale) & (scale > 0)
    if not possible.any():
        return None
    scale, shift = scale[possible], shift[possible]
    met = np.array(
        [np.count_nonzero(np.abs(a * x + b - y) < max_relative * y) for a, b in zip(scale, shift, strict=True)]
    )
    a, b = float(scale[met.argmax()]), float(shift[met.argmax()])
    for _ in range(20):
        # Relative residuals: what counts is the depth's error as a share of the depth.
        residual = (a * x + b - y) / y
        spread = max(1.4826 * float(np.median(np.abs(residual))), 1e-6)
        bound = 1.345 * min(spread, max_relative)
        weight = np.minimum(1.0, bound / np.maximum(np.abs(residual), 1e-12)) / y**2
        # Points far off belong to other surfaces; they would pull even with Huber's loss.
        weight[np.abs(residual) > 3 * max_relative] = 0
        mean_x, mean_y = np.average(x, weights=weight), np.average(y, weights=weight)
        variance = np.average((x - mean_x) ** 2, weights=weight)
        if variance <= 0:
            break
        refined = float(np.average((x - mean_x) * (y - mean_y), weights=weight) / variance)
        if refined <= 0:
            break
        a, b = refined, float(mean_y - refined * mean_x)
    return a, b, float(np.mean(np.abs(a * x + b - y) < max_relative * y))
