"""Thin holes of a depth map are closed, everything else is left alone."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from ss_flow.tasks.geometry.holes import close_holes


def tilted(height=20, width=30):
    """A plane: its inverse depth is affine in the pixel."""
    v, u = np.mgrid[:height, :width]
    return (1 / (0.5 + 0.002 * u + 0.003 * v)).astype(np.float32)


@pytest.mark.parametrize("rows", [[8], [8, 9]], ids=["one pixel", "two pixels"])
def test_a_line_across_a_plane_is_closed_with_the_depth_of_the_plane(rows):
    depth = tilted()
    depth[rows], depth[3, 4] = 0, 0
    np.testing.assert_allclose(close_holes(depth), tilted(), rtol=0.01)


def test_three_of_four_pixels_unknown_as_after_doubling_are_closed():
    depth = np.zeros((20, 30), np.float32)
    depth[::2, ::2] = tilted()[::2, ::2]
    np.testing.assert_allclose(close_holes(depth)[:19, :29], tilted()[:19, :29], rtol=0.01)


@pytest.mark.parametrize("columns", [[14], [14, 15]], ids=["one pixel", "two pixels"])
def test_a_line_along_a_depth_edge_stays_unknown(columns):
    depth = np.full((20, 30), 2.0, np.float32)
    depth[:, 15:] = 2.2
    depth[:, columns] = 0
    np.testing.assert_array_equal(close_holes(depth), depth)


def test_a_hole_of_three_pixels_stays_unknown():
    depth = np.full((20, 30), 2.0, np.float32)
    depth[5:8, 5:8] = 0
    np.testing.assert_array_equal(close_holes(depth), depth)


def test_where_nothing_is_known_nothing_is_invented():
    assert not close_holes(np.zeros((20, 30), np.float32)).any()


@given(
    arrays.arrays(
        np.float32,
        arrays.array_shapes(min_dims=2, max_dims=2, min_side=1, max_side=9),
        elements=st.sampled_from([0, 2, 2.0625, 3]),
    )
)
def test_known_depth_is_kept_to_the_bit_and_new_depth_lies_between_its_neighbours(depth):
    closed = close_holes(depth)
    np.testing.assert_array_equal(closed[depth > 0], depth[depth > 0])
    new = closed[(depth == 0) & (closed > 0)]
    assert ((new > 1.999) & (new < 3.001)).all()
