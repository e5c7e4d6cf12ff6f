import tracemalloc

import numpy as np
import pytest
from box_scene import mask_set

MASKS = np.random.default_rng(0).random((5, 299, 301)) < 0.5


@pytest.mark.parametrize("unpacked", [lambda masks: masks.dense(), lambda masks: masks.mask(3)], ids=["all", "one"])
def test_unpacking_masks_takes_no_more_memory_than_they_have_pixels(unpacked):
    masks = mask_set(MASKS)
    tracemalloc.start()
    dense = unpacked(masks)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert dense.dtype == bool
    assert peak < 1.5 * dense.nbytes


def test_unpacked_masks_are_those_that_were_packed():
    np.testing.assert_array_equal(mask_set(MASKS).dense(), MASKS)
    np.testing.assert_array_equal(mask_set(MASKS).mask(3), MASKS[3])
