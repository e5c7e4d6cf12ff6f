import numpy as np
from labelled_points import labels_of

from ss_flow.tasks.artifacts import Visibility
from ss_flow.tasks.masks.pool import mask_set
from ss_flow.tasks.split.tally import tally


def test_a_point_counts_under_every_mask_that_holds_it():
    # A row of six pixels, a point on each; points 1 and 5 are not seen, point 4 has no label.
    labels = labels_of([3, 3, 3, 8, 0, 8, 8])
    seen = np.array([0, 2, 3, 4, 6], np.int32)
    view = Visibility("a", seen, np.array([0, 1, 2, 3, 4], np.int32), np.ones(5, np.float32), 1, 6)
    masks = np.array([[[1, 1, 1, 1, 1, 0]], [[0, 1, 0, 0, 0, 0]]], bool)
    counted = tally(view, mask_set("a", masks, np.array([0.9, 1.2], np.float32), "test"), labels)
    assert counted.label.tolist() == [3, 8] and counted.seen.tolist() == [2, 2]
    assert counted.held.tolist() == [[2, 2], [1, 0]]
    assert np.allclose(counted.quality, [0.9, 1.0])


def test_a_view_without_masks_still_says_what_it_sees():
    view = Visibility("a", np.array([0], np.int32), np.array([0], np.int32), np.ones(1, np.float32), 1, 2)
    counted = tally(view, mask_set("a", np.zeros((0, 1, 2), bool), np.zeros(0, np.float32), "test"), labels_of([1]))
    assert counted.seen.tolist() == [1] and counted.held.shape == (0, 1)


def test_borders_are_counted_where_areas_meet():
    # Points one a pixel: labels 1 1 2 / 1 2 2 / 2 2 2; two pairs of neighbours in a row differ, and two in a column.
    pixels = np.arange(9, dtype=np.int32)
    view = Visibility("a", pixels, pixels, np.ones(9, np.float32), 3, 3)
    masks = mask_set("a", np.zeros((0, 3, 3), bool), np.zeros(0, np.float32), "test")
    assert tally(view, masks, labels_of([1, 1, 2, 1, 2, 2, 2, 2, 2])).beside.tolist() == [[0, 4], [4, 0]]
