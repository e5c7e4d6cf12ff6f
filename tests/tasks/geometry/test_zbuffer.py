import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from ss_flow.tasks.geometry.zbuffer import nearest_per_pixel, paint


def test_the_nearest_point_wins_its_pixel_and_the_first_wins_a_tie():
    pixel = np.array([2, 2, 0, 2, 0], np.int32)
    depth = np.array([3.0, 1.0, 5.0, 1.0, 5.0], np.float32)
    assert nearest_per_pixel(pixel, depth, 4).tolist() == [2, -1, 1, -1]
    assert paint(np.array([7, 8, 9, 10, 11], np.int32), pixel, depth, 4).tolist() == [9, 0, 8, 0]


def test_no_points_paint_nothing():
    empty = np.zeros(0, np.int32)
    assert nearest_per_pixel(empty, np.zeros(0, np.float32), 3).tolist() == [-1, -1, -1]


@given(st.lists(st.tuples(st.integers(0, 5), st.integers(1, 4)), max_size=40))
def test_it_agrees_with_a_loop_over_the_points(points):
    expected = [-1] * 6
    for i, (pixel, depth) in enumerate(points):
        if expected[pixel] < 0 or depth < points[expected[pixel]][1]:
            expected[pixel] = i
    pixels = np.array([p for p, _ in points], np.int32)
    assert nearest_per_pixel(pixels, np.array([d for _, d in points], np.float32), 6).tolist() == expected
