from __future__ import annotations

import numpy as np
import pytest

from ss_flow.tasks.splat.photo_borders import settled_by_photo

BOX = (slice(10, 30), slice(10, 30))
REACH = 3


def photo_of(box: tuple[slice, slice]) -> np.ndarray:
    """A bright box before a dark wall."""
    rgb = np.full((40, 40, 3), 60, np.uint8)
    rgb[box] = 200
    return rgb


def ids_of(box: tuple[slice, slice], wall: int = 2) -> np.ndarray:
    ids = np.full((40, 40), wall, np.uint16)
    ids[box] = 1
    return ids


def test_a_strip_beside_a_mask_that_ends_with_the_photo_stays_what_it_was():
    masks, shown = ids_of(BOX), ids_of((slice(10, 30), slice(10, 34)))
    assert np.array_equal(settled_by_photo(photo_of(BOX), masks, shown, REACH), masks)


def test_a_mask_that_ends_beside_the_edge_is_mended_by_the_scene():
    masks, shown = ids_of((slice(10, 30), slice(10, 34))), ids_of(BOX)
    assert np.array_equal(settled_by_photo(photo_of(BOX), masks, shown, REACH), shown)


def test_a_hole_in_a_plain_surface_is_filled_and_none_is_made():
    whole, pierced = ids_of(BOX), ids_of(BOX)
    pierced[18:21, 18:21] = 2
    assert np.array_equal(settled_by_photo(photo_of(BOX), pierced, whole, REACH), whole)
    assert np.array_equal(settled_by_photo(photo_of(BOX), whole, pierced, REACH), whole)


def test_what_is_thick_is_the_scenes():
    masks, shown = ids_of(BOX), ids_of((slice(10, 30), slice(10, 38)))
    assert np.array_equal(settled_by_photo(photo_of(BOX), masks, shown, REACH), shown)


def test_what_no_mask_has_is_the_scenes():
    masks, shown = ids_of(BOX, wall=0), ids_of((slice(10, 30), slice(10, 34)), wall=0)
    assert np.array_equal(settled_by_photo(photo_of(BOX), masks, shown, REACH), shown)


def test_a_photo_without_an_edge_prefers_short_borders():
    masks, shown = ids_of(BOX), ids_of(BOX)
    shown[12, 29:32] = shown[20, 29:32] = 1
    assert np.array_equal(settled_by_photo(photo_of((slice(0), slice(0))), masks, shown, REACH), masks)


def test_where_the_borders_of_both_cost_the_same_the_scene_decides():
    masks, shown = ids_of((slice(40), slice(10, 30))), ids_of((slice(40), slice(10, 34)))
    assert np.array_equal(settled_by_photo(photo_of((slice(0), slice(0))), masks, shown, REACH), shown)


@pytest.mark.parametrize("turn", [1, 2, 3])
def test_a_turned_photo_is_settled_alike(turn):
    rng = np.random.default_rng(turn)
    rgb = rng.integers(0, 255, (40, 40, 3)).astype(np.uint8)
    masks, shown = (rng.integers(0, 3, (10, 10)).repeat(4, 0).repeat(4, 1).astype(np.uint16) for _ in range(2))
    settled = settled_by_photo(rgb, masks, shown, 2)
    assert not np.array_equal(settled, masks) and not np.array_equal(settled, shown)
    turned = settled_by_photo(*(np.rot90(a, turn).copy() for a in (rgb, masks, shown)), 2)
    assert np.array_equal(turned, np.rot90(settled, turn))


def test_where_scene_and_masks_agree_nothing_changes():
    masks = ids_of(BOX)
    assert np.array_equal(settled_by_photo(photo_of(BOX), masks, masks, REACH), masks)
