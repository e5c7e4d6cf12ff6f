"""Cameras by where they stand and look."""

from __future__ import annotations

import numpy as np
import pytest

from ss_flow.tasks.geometry.cameras import looking, up_of


@pytest.mark.parametrize("forward", [(1, 0, 0), (0.6, 0, -0.8), (0, 0, 1), (0, 0, -1)])
def test_a_camera_stands_upright_and_looks_ahead(forward):
    eye, ahead, up = np.array([1.0, 2.0, 3.0]), np.array(forward, float), np.array([0.0, 0.0, 2.0])
    pose = looking(eye, ahead, up)
    np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-12)
    assert np.linalg.det(pose[:3, :3]) == pytest.approx(1)
    np.testing.assert_allclose(pose @ [*eye, 1], [0, 0, 0, 1], atol=1e-12)
    np.testing.assert_allclose(pose @ [*(eye + ahead), 1], [0, 0, 1, 1], atol=1e-12)
    right, down = pose[0, :3], pose[1, :3]
    if abs(forward[2]) < 1:  # straight up or down, no direction is upright
        assert right @ up == pytest.approx(0) and down @ up < 0


def posed(*turns: tuple[tuple[float, ...], tuple[float, ...]]) -> np.ndarray:
    """World to camera by where each looks and what is up in its picture."""
    return np.array([looking(np.zeros(3), np.array(forward, float), np.array(up, float)) for forward, up in turns])


AHEAD, BACK, UP, DOWN, LEFT, RIGHT = (1, 0, 0), (-1, 0, 0), (0, 0, 1), (0, 0, -1), (0, 1, 0), (0, -1, 0)


@pytest.mark.parametrize(
    ("poses", "up"),
    [
        (posed((AHEAD, UP), (LEFT, UP), (BACK, UP)), UP),
        (posed((DOWN, AHEAD), (DOWN, LEFT), (DOWN, BACK), (DOWN, RIGHT)), UP),
        (posed((AHEAD, UP), (AHEAD, DOWN)), BACK),
        (posed((AHEAD, LEFT), (BACK, RIGHT)), LEFT),
        (posed(*[(DOWN, AHEAD), (DOWN, BACK)] * 9, (DOWN, AHEAD)), UP),
    ],
    ids=[
        "upright",
        "straight down from all sides",
        "opposite",
        "opposite and facing each other",
        "straight down, from one side once more",
    ],
)
def test_up_is_what_photos_agree_on_else_where_they_look_away_from_else_the_first_ones(poses, up):
    np.testing.assert_allclose(up_of(poses), up, atol=1e-12)
