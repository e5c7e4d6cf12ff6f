import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from ss_flow.tasks.geometry.sampling import first_of_each_cube, greedy_farthest


def test_the_first_point_is_closest_to_the_mean_and_the_next_farthest_from_it():
    points = np.array([[0.0, 0], [11, 0], [4, 0], [5, 0.5]])
    # The mean is (5, 0.125).
    assert greedy_farthest(points, 3, alpha=0, drop_hull=False).tolist() == [3, 1, 0]


def test_alpha_keeps_prompts_to_the_middle():
    points = np.array([[0.0, 0], [3, 0], [-2, 0], [0.5, 0], [-1.5, 0]])
    assert greedy_farthest(points, 2, alpha=0, drop_hull=False).tolist() == [0, 1]
    # Point i lies |x_i| from the first point and from the mean alike: its score is -0.5 |x_i|.
    assert greedy_farthest(points, 2, alpha=1.5, drop_hull=False).tolist() == [0, 3]


def test_corners_of_the_hull_are_no_prompts_unless_too_few_points_remain():
    inner = [[4.0, 4], [6, 6], [4, 6]]
    points = np.array([[0.0, 0], [10, 0], [10, 10], [0, 10], *inner])
    assert set(greedy_farthest(points, 3)) == {4, 5, 6}
    assert set(greedy_farthest(points, 4)) & {0, 1, 2, 3}


def test_points_on_a_line_and_repeated_points_do_no_harm():
    line = np.stack([np.arange(20.0), np.zeros(20)], axis=-1)
    assert len(greedy_farthest(line, 5)) == 5
    assert len(greedy_farthest(np.ones((30, 2)), 5)) == 1
    assert greedy_farthest(np.zeros((0, 2)), 5).shape == (0,)


@settings(deadline=None)
@given(st.integers(0, 1000), st.integers(1, 40), st.integers(1, 12), st.booleans())
def test_prompts_are_distinct_and_as_many_as_asked_for(seed, count, asked, drop_hull):
    points = np.random.default_rng(seed).random((count, 2))
    chosen = greedy_farthest(points, asked, drop_hull=drop_hull)
    assert len(chosen) == len(set(chosen.tolist())) == min(asked, count)


@settings(deadline=None)
@given(st.integers(0, 1000), st.integers(1, 200), st.sampled_from((0.05, 0.3, 2.0)))
def test_one_point_stays_for_each_cube_the_first(seed, count, side):
    points = np.random.default_rng(seed).normal(size=(count, 3)).astype(np.float32)
    first: dict[tuple[int, ...], int] = {}
    for row, place in enumerate((points - points.min(axis=0)) / side):
        first.setdefault(tuple(np.floor(place).astype(int).tolist()), row)
    assert first_of_each_cube(points, side).tolist() == sorted(first.values())
