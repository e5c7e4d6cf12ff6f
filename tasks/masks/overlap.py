"""How far masks agree, and which of those that nearly agree stays."""

from __future__ import annotations

import numpy as np

from ss_flow.tasks.artifacts import Bool, Float32, Float64, Int32

_AT_ONCE = 1 << 18
"""Pixels that are multiplied at once: floats of whole masks would take many times their memory."""


def iou(a: Bool, b: Bool) -> float:
    """Intersection over union of two masks of one shape; 0 when both are empty."""
    union = int(np.count_nonzero(a | b))
    return int(np.count_nonzero(a & b)) / union if union else 0.0


def weighted_iou(a: Bool, b: Bool, weight: Float32) -> float:
    """The same of two sets [P] whose elements weigh differently: [P]."""
    union = float(weight[a | b].sum(dtype=np.float64))
    return float(weight[a & b].sum(dtype=np.float64)) / union if union else 0.0


def intersections(masks: Bool) -> Float32:
    """Pixels that masks [N, H, W] share, two by two: [N, N], exact below 2^24."""
    flat = masks.reshape(len(masks), masks.shape[1] * masks.shape[2])
    shared = np.zeros((len(flat), len(flat)), np.float32)
    for start in range(0, flat.shape[1], _AT_ONCE):
        part = flat[:, start : start + _AT_ONCE].astype(np.float32)
        shared += part @ part.T
    return shared


def mask_iou(masks: Bool) -> Float32:
    """IoU of masks [N, H, W], none empty, two by two: [N, N]."""
    shared = intersections(masks)
    areas = np.diag(shared)
    return shared / (areas[:, None] + areas[None] - shared)


def suppress(overlap: Float32 | Float64, scores: Float32, threshold: float) -> Int32:
    """Greedy non-maximum suppression on a matrix of overlaps.

    overlap: [N, N]. scores: [N]; of equal scores the first row is taken first. Returns the rows that stay, ascending.
    """
    alive = np.ones(len(scores), bool)
    kept: list[int] = []
    for index in np.argsort(-scores, kind="stable"):
        if alive[index]:
            kept.append(int(index))
            alive &= overlap[index] <= threshold
    return np.array(sorted(kept), np.int32)


def drop_duplicates(masks: Bool, scores: Float32, max_iou: float) -> Int32:
    """Non-maximum suppression over masks: of two with an IoU above `max_iou` the one with the better score stays.

    masks: [N, H, W], none empty. scores: [N]. Returns the rows that stay, ascending.
    """
    return suppress(mask_iou(masks), scores, max_iou)
