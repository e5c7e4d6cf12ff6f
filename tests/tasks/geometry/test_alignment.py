import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ss_flow.tasks.geometry.alignment import fit_scale_shift


def test_three_points_on_a_line_give_the_line():
    scale, shift, met = fit_scale_shift(np.array([1.0, 2.0, 3.0]), np.array([0.5, 0.7, 0.9]))
    assert scale == pytest.approx(0.2)
    assert shift == pytest.approx(0.3)
    assert met == 1.0


@settings(max_examples=25, deadline=None)
@given(scale=st.floats(0.3, 3), shift=st.floats(-0.2, 0.5), seed=st.integers(0, 10**6))
def test_scale_and_shift_are_recovered_within_a_percent_despite_noise_and_wrong_points(scale, shift, seed):
    random = np.random.default_rng(seed)
    inverse_depth = random.uniform(0.1, 1.0, 800)
    relative = (inverse_depth - shift) / scale
    observed = inverse_depth * (1 + random.normal(0, 0.01, 800))
    observed[:240] = random.uniform(0.1, 1.0, 240)
    found_scale, found_shift, met = fit_scale_shift(relative, observed)
    depth = 1 / (found_scale * relative + found_shift)
    assert np.median(np.abs(depth * inverse_depth - 1)) < 0.01
    assert found_scale == pytest.approx(scale, rel=0.01)
    assert met > 0.65


def test_the_same_points_give_the_same_line_every_time():
    random = np.random.default_rng(1)
    x, y = random.random(100), random.uniform(0.1, 1, 100)
    assert fit_scale_shift(x, y) == fit_scale_shift(x, y)


@pytest.mark.parametrize("relative", [[1.0], [1.0, 1.0, 1.0], [3.0, 2.0, 1.0]])
def test_too_few_equal_or_decreasing_points_give_no_line(relative):
    inverse_depth = np.linspace(0.2, 0.6, len(relative))
    assert fit_scale_shift(np.array(relative), inverse_depth) is None
