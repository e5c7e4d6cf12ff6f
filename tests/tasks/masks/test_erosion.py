import numpy as np
import pytest
from box_scene import mask_set
from hypothesis import given, settings
from hypothesis import strategies as st

from ss_flow.tasks.masks.dilation import grown
from ss_flow.tasks.masks.erosion import ErosionParams, erode, interiors


def square(size, low, high):
    mask = np.zeros((size, size), bool)
    mask[low:high, low:high] = True
    return mask


def test_a_mask_loses_a_border_of_the_radius():
    eroded = erode(square(100, 20, 60), ErosionParams(radius=3, radius_large=4, diagonal=0))
    # 1600 of 10000 pixels is a large mask: radius 4.
    assert (eroded == square(100, 24, 56)).all()
    assert (erode(square(100, 20, 40), ErosionParams(diagonal=0)) == square(100, 23, 37)).all()


def test_the_radius_follows_the_diagonal():
    # The image's diagonal is 141, so 4 pixels at 800 are 0.7 here.
    assert (erode(square(100, 20, 60), ErosionParams()) == square(100, 21, 59)).all()


def test_the_border_of_the_image_takes_nothing_off():
    whole = np.ones((50, 50), bool)
    assert erode(whole, ErosionParams(diagonal=0)).all()


@pytest.mark.parametrize(("side", "left"), [(5, 5), (8, 6), (10, 6), (40, 34)])
def test_the_radius_shrinks_until_enough_of_a_small_mask_survives(side, left):
    # Side 8: radius 1 leaves 36 >= 30 pixels; side 10: radius 2 leaves 36; side 5: even radius 1 leaves only 9.
    mask = square(400, 100, 100 + side)
    assert erode(mask, ErosionParams(diagonal=0)).sum() == left**2


@pytest.mark.parametrize("params", [{"radius": 1e9, "radius_large": 1e9}, {"diagonal": 1e-9}, {"diagonal": 5e-324}])
def test_a_radius_beyond_the_picture_is_as_good_as_its_longer_side(params):
    most = ErosionParams(radius=60, radius_large=60, diagonal=0)
    for mask in (square(60, 5, 55), np.ones((60, 60), bool)):
        assert (erode(mask, ErosionParams(**params)) == erode(mask, most)).all()


@pytest.mark.parametrize("pixels", [1, 9, 20, 10**9])
def test_a_mask_grows_by_so_many_pixels_and_no_farther_than_the_picture(pixels):
    mask = np.zeros((12, 20), bool)
    mask[3, 0] = True
    rows, columns = np.indices(mask.shape)
    assert (grown(mask, pixels) == (np.maximum(abs(rows - 3), columns) <= pixels)).all()


@settings(deadline=None, max_examples=40)
@given(st.integers(0, 1000), st.integers(1, 4))
def test_erosion_agrees_with_the_minimum_over_a_window(seed, radius):
    mask = np.random.default_rng(seed).random((24, 30)) < 0.95
    padded = np.pad(mask, radius, constant_values=True)
    windows = np.lib.stride_tricks.sliding_window_view(padded, (2 * radius + 1, 2 * radius + 1))
    params = ErosionParams(radius=radius, radius_large=radius, diagonal=0, keep_share=0, keep_pixels=0)
    assert (erode(mask, params) == windows.all(axis=(2, 3))).all()


def test_without_nesting_each_pixel_belongs_to_the_smallest_mask_on_it():
    masks = mask_set(np.stack([square(60, 20, 40), square(60, 10, 50)]))
    params = ErosionParams(diagonal=0)
    large, small = interiors(masks, params, nested=False)
    assert (large.mask, small.mask) == (1, 0)
    # 1200 pixels are large, but radius 4 would leave only 240 of them: radius 3.
    ring = square(60, 13, 47) & ~square(60, 17, 43)
    assert set(large.pixels) == set(np.flatnonzero(ring))
    assert set(interiors(masks, params, nested=True)[0].pixels) == set(np.flatnonzero(square(60, 14, 46)))
