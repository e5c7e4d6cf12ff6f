"""The pool of masks of one view."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from ss_flow.tasks.split.mask_pool import (
    canonical_order,
    drop_duplicates,
    exclusive,
    intersections,
    mask_tree,
    merge_union,
    suppress,
)


def on_top(dense: np.ndarray) -> np.ndarray:
    return exclusive(dense, canonical_order(dense))


def test_exclusive_map_puts_the_smaller_mask_on_top_whatever_the_order():
    dense = np.zeros((3, 4, 5), bool)
    dense[0, 1:3, 1:3] = True  # 4 pixels, inside mask 2
    dense[1, 3, 4] = True  # 1 pixel, outside
    dense[2, 0:3, 0:4] = True  # 12 pixels
    expected = np.array([[2, 2, 2, 2, -1], [2, 0, 0, 2, -1], [2, 0, 0, 2, -1], [-1, -1, -1, -1, 1]])
    np.testing.assert_array_equal(on_top(dense), expected)
    back = np.array([1, 2, 0])  # new position -> old index
    swapped = on_top(dense[back])
    np.testing.assert_array_equal(np.where(swapped < 0, -1, back[swapped]), expected)


def test_exclusive_map_of_no_masks_is_empty():
    np.testing.assert_array_equal(on_top(np.zeros((0, 2, 3), bool)), np.full((2, 3), -1))


def test_canonical_order_breaks_ties_of_area_by_row_then_column_of_the_centroid():
    dense = np.zeros((3, 3, 3), bool)
    dense[0, 2, 0] = dense[1, 0, 2] = dense[2, 0, 1] = True
    assert canonical_order(dense).tolist() == [2, 1, 0]


def squares(*spans: tuple[int, int, int, int]) -> np.ndarray:
    """Masks of 20 x 20 pixels, each one rectangle: top, bottom, left, right."""
    dense = np.zeros((len(spans), 20, 20), bool)
    for mask, (top, bottom, left, right) in zip(dense, spans, strict=True):
        mask[top:bottom, left:right] = True
    return dense


def test_tree_gives_each_mask_the_smallest_mask_that_holds_it():
    dense = squares((0, 20, 0, 20), (0, 10, 0, 20), (0, 10, 0, 10), (2, 4, 2, 4), (9, 11, 9, 11))
    # The last lies half in the second and a quarter in the third: only the first holds it.
    assert mask_tree(dense, 0.9).tolist() == [-1, 0, 1, 2, 0]


def test_of_two_masks_that_are_nearly_equal_the_better_one_stays():
    dense = squares((0, 10, 0, 10), (0, 10, 0, 11), (0, 10, 0, 5))
    assert drop_duplicates(dense, np.array([0.8, 0.9, 0.7], np.float32), 0.9).tolist() == [1, 2]
    assert drop_duplicates(dense, np.array([0.9, 0.8, 0.7], np.float32), 0.9).tolist() == [0, 2]


def test_suppressed_mask_suppresses_nothing():
    overlap = np.array([[1, 0.6, 0], [0.6, 1, 0.6], [0, 0.6, 1]])
    assert suppress(overlap, np.array([0.9, 0.8, 0.7], np.float32), 0.5).tolist() == [0, 2]


def test_union_rule_promotes_the_coarse_mask_and_keeps_what_stands_alone():
    dense = squares((0, 10, 0, 10), (0, 10, 6, 14), (15, 20, 15, 20), (15, 19, 15, 20))
    # The second shares 40 of its 80 pixels with the first; the last is a duplicate within its grid.
    merged, origin = merge_union(dense, np.array([0, 1, 1, 1], np.int32), duplicate=0.95, overlap=0.3)
    assert origin.tolist() == [0, 2]
    np.testing.assert_array_equal(merged[0], squares((0, 10, 0, 14))[0])
    np.testing.assert_array_equal(merged[1], dense[2])


@given(st.integers(0, 2**32 - 1), st.integers(1, 8))
def test_tree_and_exclusive_map_do_not_depend_on_the_order_of_the_masks(seed, count):
    rng = np.random.default_rng(seed)
    low, high = np.sort(rng.integers(0, 12, (2, count, 2)), axis=0)
    dense = np.zeros((count, 12, 12), bool)
    for mask, (top, left), (bottom, right) in zip(dense, low, high, strict=True):
        mask[top : bottom + 1, left : right + 1] = True
    shuffled = dense[rng.permutation(count)]
    first, second = dense[canonical_order(dense)], shuffled[canonical_order(shuffled)]
    np.testing.assert_array_equal(first, second)
    np.testing.assert_array_equal(mask_tree(first, 0.9), mask_tree(second, 0.9))
    np.testing.assert_array_equal(on_top(first), on_top(second))


@given(st.integers(0, 2**32 - 1))
def test_intersections_count_shared_pixels(seed):
    rng = np.random.default_rng(seed)
    dense = rng.random((4, 700, 500)) < 0.5
    expected = [[(a & b).sum() for b in dense] for a in dense]
    np.testing.assert_array_equal(intersections(dense), expected)
