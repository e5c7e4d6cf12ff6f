"""Planes through points."""

from __future__ import annotations

import numpy as np
import pytest

from ss_flow.tasks.geometry.shape import plane_of_most, plane_through, sector_of


@pytest.mark.parametrize("away", [5, -5])
@pytest.mark.parametrize("normal", [(0.0, 0.0, 1.0), (1.0, 2.0, -2.0)])
def test_points_beside_a_plane_do_not_draw_away_the_plane_of_most(normal, away):
    rng = np.random.default_rng(0)
    normal = np.array(normal) / np.linalg.norm(normal)
    rows, _ = np.linalg.qr(np.column_stack([normal, rng.normal(size=(3, 2))]))
    flat = rng.uniform(-1, 1, (700, 2)) @ rows[:, 1:].T + away
    pole = away + rows[:, 1] + rng.uniform(0, 1, (300, 1)) * normal  # at an edge, where it tilts a fit to all most
    points = np.concatenate([flat, pole])
    centre, found = plane_of_most(points, 0.02, rounds=8)
    assert abs(found @ normal) > 0.9999 and abs((centre - away) @ normal) < 0.01
    assert abs(plane_through(points)[1] @ normal) < 0.99


@pytest.mark.parametrize("count", [1, 2, 3, 4])
def test_few_points_lie_on_the_plane_through_them(count):
    points = np.array([(0.0, 0, 2), (1, 0, 2), (0, 3, 2), (5, 1, 2)])[:count]
    centre, normal = plane_through(points)
    assert np.allclose((points - centre) @ normal, 0) and np.isclose(np.linalg.norm(normal), 1)


def test_directions_are_told_from_the_first_axis_on_all_round():
    angle = np.radians([0, 44, 46, 134, 136, 179, 181, 226, 314, 316, 359, -1, -179])
    places = np.stack([np.cos(angle), np.sin(angle)], axis=1) * np.linspace(0.1, 9, len(angle))[:, None]
    assert sector_of(places, 4).tolist() == [0, 0, 0, 1, 1, 1, 2, 2, 3, 3, 3, 3, 2]
    assert sector_of(np.array([[1.0, -1e-300]]), 24).tolist() == [0]  # a turn short of a whole one by nothing
