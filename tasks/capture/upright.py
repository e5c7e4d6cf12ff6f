"""Photos that a phone stores lying on their side: its sensor's long side is always the picture's width."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ss_flow.tasks.capture.lens import Lens
from ss_flow.tasks.capture.scene_files import Pose

_UP = np.array([0.0, 1.0, 0.0])
"""In the world of ARKit, by gravity."""
_QUARTER = np.array([[0.0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
"""From a camera's axes to those of the camera whose picture is turned by a quarter, counterclockwise."""


def upright(lenses: Sequence[Lens], poses: Sequence[Pose]) -> tuple[tuple[Lens, ...], tuple[Pose, ...]]:
    """Lenses and poses of a phone's photos once these are turned so that most stand upright, all by the same quarters.

    lenses: with their sizes. poses: in a world whose y axis points up.
    """
    across, down = np.array(poses).reshape(-1, 4, 4)[:, :2, :3].mean(axis=0) @ _UP
    # Where the world's up points in the photos as they are stored: up, right, down, left.
    turns = int(np.argmax([-down, across, down, -across]))
    pairs = [_turned(lens, pose, turns) for lens, pose in zip(lenses, poses, strict=True)]
    return tuple(lens for lens, _ in pairs), tuple(pose for _, pose in pairs)


def _turned(lens: Lens, pose: Pose, turns: int) -> tuple[Lens, Pose]:
    """After so many quarter turns, counterclockwise. Each makes a pixel's row its column, and its column, counted from
    the right, its row."""
    matrix = np.array(pose).reshape(4, 4)
    for _ in range(turns):
        lens = replace(
            lens, width=lens.height, height=lens.width, fx=lens.fy, fy=lens.fx, cx=lens.cy, cy=lens.width - lens.cx
        )
        matrix = _QUARTER @ matrix
    return replace(lens, turns=turns), tuple(matrix.ravel().tolist())
