"""Gaussians of chance, within the ranges that real ones have."""

from __future__ import annotations

import numpy as np

from ss_flow.tasks.artifacts import Cameras, Gaussians


def made_gaussians(count: int, degree: int, seed: int = 0) -> Gaussians:
    """A cloud 2 units across at the origin, of instances 0..3."""
    rng = np.random.default_rng(seed)
    q = rng.normal(size=(count, 4))
    return Gaussians(
        means=rng.uniform(-1, 1, (count, 3)).astype(np.float32),
        quaternions=(q / np.linalg.norm(q, axis=1, keepdims=True)).astype(np.float32),
        log_scales=rng.uniform(-4.5, -2, (count, 3)).astype(np.float32),
        opacity_logits=rng.uniform(-3, 5, count).astype(np.float32),
        sh=rng.uniform(-0.9, 0.9, (count, (degree + 1) ** 2, 3)).astype(np.float32),
        instance_id=rng.integers(0, 4, count).astype(np.int32),
        instance_conf=rng.random(count).astype(np.float32),
        part_id=rng.integers(0, 3, count).astype(np.int32),
    )


def made_cameras(
    eyes: tuple[tuple[float, float, float], ...] = ((0, -3.2, 0), (0, 0, -3.2)), size: int = 96
) -> Cameras:
    """Cameras that look at the origin, with the world's z upwards in their pictures."""
    poses = []
    for eye in eyes:
        forward = -np.array(eye, float) / np.linalg.norm(eye)
        right = np.cross(forward, (0.0, 0.0, 1.0)) if abs(forward[2]) < 0.99 else np.array([1.0, 0.0, 0.0])
        right /= np.linalg.norm(right)
        pose = np.eye(4)
        pose[:3, :3] = np.stack([right, np.cross(forward, right), forward])
        pose[:3, 3] = -pose[:3, :3] @ np.array(eye, float)
        poses.append(pose)
    return Cameras(
        names=tuple(f"{i:04d}" for i in range(len(eyes))),
        sizes=np.full((len(eyes), 2), size, np.int32),
        intrinsics=np.tile([1.2 * size, 1.2 * size, size / 2, size / 2], (len(eyes), 1)),
        world_to_camera=np.stack(poses),
        metric=True,
    )
