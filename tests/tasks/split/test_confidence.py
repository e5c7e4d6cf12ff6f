import numpy as np
import pytest

from ss_flow.tasks.artifacts import DRAWN, FOUND, PROMPTED, Hierarchy
from ss_flow.tasks.packed import Masks
from ss_flow.tasks.split.confidence import confidence, evidence, pieces

INSIDE, AT_THE_BORDER = np.zeros((2, 6, 8), bool)
INSIDE[2:4, 2:5] = True
AT_THE_BORDER[2:4, 2:] = True


def told(masks, origin, *, piece=False):
    return evidence(Masks.of(masks), np.array(origin, np.uint8), piece=piece)


def test_what_the_views_tell_of_an_instance():
    found = told([INSIDE, AT_THE_BORDER, AT_THE_BORDER, INSIDE], [FOUND, FOUND, DRAWN, PROMPTED], piece=True)
    np.testing.assert_allclose(found, [np.log(3), 0.5, 0.25, 1])


@pytest.mark.parametrize("side", range(4))
def test_each_border_of_a_photo_cuts_a_mask_off(side):
    mask = np.rot90(INSIDE, side).copy()
    assert told([mask], [FOUND])[1] == 0
    mask[0, 3] = True
    assert told([np.rot90(mask, -side)], [FOUND])[1] == 1


def test_from_eight_views_on_more_of_them_say_nothing_new():
    eight, twenty = (told([INSIDE] * n, [FOUND] * n) for n in (8, 20))
    assert eight.tolist() == twenty.tolist()
    assert told([INSIDE] * 7, [FOUND] * 7)[0] < eight[0]


def test_what_the_segmenter_finds_whole_in_many_views_is_likely_to_be_a_thing():
    assert 0.85 < confidence(told([INSIDE] * 10, [FOUND] * 10)) < 1
    assert 0 < confidence(told([AT_THE_BORDER] * 3, [DRAWN] * 3)) < 0.05


def test_each_doubt_lowers_the_confidence():
    sure = confidence(told([INSIDE] * 4, [FOUND] * 4))
    assert confidence(told([INSIDE] * 3, [FOUND] * 3)) < sure
    assert confidence(told([INSIDE] * 3 + [AT_THE_BORDER], [FOUND] * 4)) < sure
    assert confidence(told([INSIDE] * 5, [FOUND] * 4 + [DRAWN])) < sure
    assert confidence(told([INSIDE] * 4, [FOUND] * 4, piece=True)) < sure


def test_a_piece_is_a_leaf_of_the_tree_that_is_part_of_something():
    node, parent = np.array([[1, 2, 3, 4, 8, 9], [8, 8, 9, 0, 9, 0]], np.int32)
    tree = Hierarchy(node, parent, np.ones(6, np.float32), np.zeros(6, bool))
    assert pieces(tree) == {1, 2, 3}
