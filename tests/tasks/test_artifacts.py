import tracemalloc

import numpy as np
import pytest
from box_scene import mask_set

from ss_flow.tasks.packed import Masks

RNG = np.random.default_rng(0)
MASKS = RNG.random((5, 299, 301)) < 0.5


def corners(size: tuple[int, int]) -> np.ndarray:
    """A mask that fills some box of its view, and not by whole bytes."""
    mask = np.zeros(size, bool)
    mask[1:-2, 2:-1] = RNG.random((size[0] - 3, size[1] - 3)) < 0.3
    return mask


VARIED = [corners((40, 31)), np.zeros((7, 9), bool), np.ones((5, 3), bool), corners((9, 60)), np.zeros((0, 4), bool)]


def each(masks: Masks) -> list[np.ndarray]:
    return [masks.mask(row) for row in range(len(masks.boxes))]


def equal(found: list[np.ndarray], expected: list[np.ndarray]) -> bool:
    return len(found) == len(expected) and all(map(np.array_equal, found, expected))


@pytest.mark.parametrize("unpacked", [lambda masks: masks.dense(), lambda masks: masks.mask(3)], ids=["all", "one"])
def test_unpacking_masks_takes_no_more_memory_than_they_have_pixels(unpacked):
    masks = mask_set(MASKS)
    tracemalloc.start()
    dense = unpacked(masks)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert dense.dtype == bool
    # One mask alone is unpacked beside the picture that it is drawn into.
    assert peak < 1.5 * max(dense.nbytes, 2 * MASKS[0].nbytes)


def test_unpacked_masks_are_those_that_were_packed():
    np.testing.assert_array_equal(mask_set(MASKS).dense(), MASKS)
    assert equal(each(Masks.of(VARIED)), VARIED) and equal(each(Masks.of(iter(VARIED))), VARIED)
    assert mask_set(MASKS[:0]).dense().shape == (0, 299, 301)


def test_masks_of_small_things_take_little():
    far = np.zeros((1000, 1000), bool)
    far[700:710, 400:420] = True
    assert Masks.of([far]).packed.nbytes == 25 and Masks.of([far]).boxes.tolist() == [[400, 700, 420, 710]]


def test_some_masks_and_several_together():
    masks = Masks.of(VARIED)
    assert equal(each(masks.rows([3, 1, 0])), [VARIED[3], VARIED[1], VARIED[0]]) and not each(masks.rows([]))
    both = Masks.joined([masks.rows([3]), masks, Masks.of([])])
    assert equal(each(both), [VARIED[3], *VARIED])
    assert masks.areas().tolist() == [mask.sum() for mask in VARIED]


def test_masks_are_the_same_only_where_their_places_are():
    one, moved = np.zeros((6, 8), bool), np.zeros((6, 8), bool)
    one[1:3, 1:3] = moved[2:4, 1:3] = True
    assert Masks.of([one]).same(Masks.of([one.copy()])) and not Masks.of([one]).same(Masks.of([moved]))
    assert not Masks.of([one]).same(Masks.of([one, one]))
