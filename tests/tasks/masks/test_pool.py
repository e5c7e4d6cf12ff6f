"""The pool of masks of one view."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ss_flow.tasks.masks.overlap import drop_duplicates, intersections, mask_iou, suppress
from ss_flow.tasks.masks.pool import (
    canonical_order,
    exclusive,
    large_pieces,
    mask_tree,
    merge_union,
    smoothed,
    whole_pictures,
    without_speckles,
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


@pytest.mark.parametrize(("grid", "count"), [([0, 0], 2), ([0, 1], 1), ([1, 1], 1), ([1, 2], 1)])
def test_masks_of_any_grid_but_the_coarsest_are_united_also_where_that_one_has_none(grid, count):
    dense = squares((0, 10, 0, 10), (0, 10, 6, 14))
    merged, _ = merge_union(dense, np.array(grid, np.int32), duplicate=0.95, overlap=0.3)
    assert len(merged) == count and np.array_equal(merged.any(axis=0), dense.any(axis=0))


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


def test_two_things_of_one_bounding_box_are_not_one():
    wall = np.ones((10, 10), bool)
    wall[1:9, 1:9] = False
    thing = np.zeros((10, 10), bool)
    thing[1:9, 1:9] = thing[0, 4] = thing[9, 4] = thing[4, 0] = thing[4, 9] = True
    overlap = mask_iou(np.stack([wall, thing]))
    assert overlap[0, 1] == 4 / 100 and overlap[0, 0] == overlap[1, 1] == 1


def test_most_of_the_picture_and_the_rest_of_it_round_a_thing_are_no_masks():
    thing = np.zeros((10, 10), bool)
    thing[2:8, 2:7] = True  # 30 pixels
    half = np.zeros((10, 10), bool)
    half[:, :6] = True
    nearly_all = np.ones((10, 10), bool)
    nearly_all[0] = False  # 90 pixels
    masks = np.stack([thing, ~thing, half, nearly_all])
    everything = np.ones((10, 10), bool)
    assert whole_pictures(masks, everything, 0.8).tolist() == [False, True, False, True]
    # Of the pixels that count, the half is all.
    assert whole_pictures(half[None], half, 0.8).tolist() == [True]


def test_speckles_go_and_small_holes_are_filled_but_not_bays_nor_large_holes():
    clean = np.zeros((40, 40), bool)
    clean[5:35, 5:35] = True
    clean[10:20, 10:20] = False  # a hole of 100 of 800 pixels
    clean[30:35, 18:20] = False  # a bay, open to the outside
    spoilt = clean.copy()
    spoilt[1, 1] = spoilt[38, 30:33] = True
    spoilt[25, 25] = spoilt[28, 10:12] = False
    np.testing.assert_array_equal(without_speckles(spoilt, 0.05), clean)
    np.testing.assert_array_equal(without_speckles(spoilt, 0.0), spoilt)
    assert without_speckles(clean, 0.2)[15, 15]
    assert not without_speckles(np.zeros((4, 4), bool), 0.05).any()


@given(st.integers(0, 2**16 - 1))
def test_taking_speckles_off_twice_is_taking_them_off_once_where_nothing_large_is_left_over(bits):
    mask = np.array([bits >> i & 1 for i in range(16)], bool).reshape(4, 4)
    once = without_speckles(mask, 1.0)
    assert not once.any() or np.array_equal(without_speckles(once, 1.0), once)


@given(st.integers(0, 2**32 - 1), st.integers(1, 3))
def test_a_smoothed_mask_is_where_most_of_the_square_around_belongs_to_it(seed, radius):
    """Also at the picture's border, which goes on as it ends."""
    rng = np.random.default_rng(seed)
    mask = np.zeros((16, 14), bool)
    y, x = rng.integers(0, 10), rng.integers(0, 8)
    mask[y : y + 6, x : x + 6] = rng.random((6, 6)) < 0.8
    wide = np.pad(mask, radius, mode="edge")
    square = np.lib.stride_tricks.sliding_window_view(wide, (2 * radius + 1, 2 * radius + 1))
    most = square.mean(axis=(2, 3)) > 0.5
    np.testing.assert_array_equal(smoothed(mask, radius), large_pieces(most, 0.1)[0])
