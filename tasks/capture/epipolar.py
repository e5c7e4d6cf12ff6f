"""Epipolar geometry of two views: where a point of one may lie in the other."""

from __future__ import annotations

import numpy as np

from ss_flow.tasks.artifacts import Cameras, Float64


def sampson_distance(fundamental: Float64, first: np.ndarray, second: np.ndarray) -> Float64:
    """[N] how far, in pixels, matched points lie from their epipolar lines (Hartley and Zisserman, Eq. 11.9, its root).

    fundamental: [3, 3] F in x_second^T F x_first = 0. first, second: [N, 2] pixels.
    """
    a, b = (np.column_stack([points, np.ones(len(points))]).astype(np.float64) for points in (first, second))
    lines_b, lines_a = a @ fundamental.T, b @ fundamental
    slope = (lines_b[:, :2] ** 2).sum(axis=1) + (lines_a[:, :2] ** 2).sum(axis=1)
    return np.asarray(np.abs((b * lines_b).sum(axis=1)) / np.sqrt(np.maximum(slope, 1e-300)))


def fundamental_matrix(cameras: Cameras, first: int, second: int) -> Float64:
    """[3, 3] of two views, from their poses and intrinsics (Hartley and Zisserman, Sec. 9.6.1)."""

    def to_rays(view: int) -> Float64:
        fx, fy, cx, cy = cameras.intrinsics[view]
        return np.linalg.inv(np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], np.float64))

    relative = cameras.world_to_camera[second] @ np.linalg.inv(cameras.world_to_camera[first])
    x, y, z = relative[:3, 3]
    across = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.asarray(to_rays(second).T @ across @ relative[:3, :3] @ to_rays(first))
