import numpy as np
import pytest
from depth_sensor import sensed, structured_light

from ss_flow.flows.generated.room import Views
from ss_flow.tasks.artifacts import Cameras


def measured(distance, size=(120, 160)):
    return structured_light(np.full(size, distance, np.float32), np.random.default_rng(0))


@pytest.mark.parametrize("distance", [1.0, 2.0, 4.0])
def test_noise_and_steps_grow_with_the_square_of_the_distance(distance):
    depth = measured(distance)
    known = depth[depth > 0].astype(float)
    # Noise and, evenly distributed over a step, rounding.
    expected = distance**2 * np.hypot(1.425e-3, 2.85e-3 / np.sqrt(12))
    assert known.std() == pytest.approx(expected, rel=0.15)
    assert known.mean() == pytest.approx(distance, abs=expected)
    levels = np.unique(known)
    np.testing.assert_allclose(np.diff(levels), 2.85e-3 * distance**2, rtol=0.1)


def test_depth_out_of_range_at_edges_and_here_and_there_is_unknown():
    assert not measured(0.4).any() and not measured(5.5).any()
    assert (measured(2.0) == 0).mean() == pytest.approx(0.015, abs=0.005)
    depth = np.full((40, 40), 2.0, np.float32)
    depth[:, 20:] = 3.0
    found = structured_light(depth, np.random.default_rng(0))
    assert (found[:, 19:21] == 0).mean() > 0.4 > 0.1 > (found[:, :18] == 0).mean()


def test_each_view_is_measured_with_noise_of_its_own_and_nothing_else_of_it_changes():
    nothing = np.zeros(0)
    cameras = Cameras(("0", "1"), nothing, nothing, nothing, metric=True)
    depth = np.full((2, 40, 40), 2.0, np.float32)
    views = Views(nothing, depth, nothing, nothing, nothing, cameras)
    found = sensed(views, 3)
    assert not np.array_equal(*found.depth)
    np.testing.assert_array_equal(found.depth, sensed(views, 3).depth)
    assert (found.depth != sensed(views, 4).depth).any()
    assert found.cameras is cameras and found.rgb is nothing and (views.depth == 2).all()
