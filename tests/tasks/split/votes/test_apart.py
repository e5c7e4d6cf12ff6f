import numpy as np
import pytest
from clouds import even_cloud

from ss_flow.tasks.artifacts import INSIDE, Observation
from ss_flow.tasks.split.votes.apart import part_labels

TABLE, FLOOR, CRUMB = range(20), range(20, 32), range(32, 34)
"""Points of one label: a piece of a table, one of the floor far below, and too few to ask about."""


def view(*masks: range | list[int]) -> Observation:
    """What a view sees, mask by mask."""
    seen = np.array(sorted({point for mask in masks for point in mask}), np.int32)
    rows = [np.searchsorted(seen, sorted(mask)) for mask in masks]
    first = np.cumsum([0, *map(len, rows)]).astype(np.int32)
    row = np.concatenate([np.zeros(0, np.int32), *rows]).astype(np.int32)
    number = np.arange(len(masks), dtype=np.int32)
    return Observation("", seen, number, first, row, np.full(len(row), INSIDE, np.uint8))


def parted(*views: Observation, label: int = 1) -> list[int]:
    """The labels of table, floor and crumb when they were one."""
    place = np.zeros((34, 3), np.float32)
    place[:, 0] = np.arange(34)
    for piece, height in ((FLOOR, 50.0), (CRUMB, 90.0)):
        place[list(piece), 2] = height
    cloud = even_cloud(place, np.zeros((34, 3), np.uint8), 1.0, 1.0)
    before = np.full(34, label, np.int32)
    found = part_labels(
        before, cloud, views, reach=np.full(34, 2.0, np.float32), share=0.05, min_points=5, rate=0.4, first=9
    )
    assert all(len(set(found[list(piece)].tolist())) == 1 for piece in (TABLE, FLOOR, CRUMB))
    return [int(found[piece[0]]) for piece in (TABLE, FLOOR, CRUMB)]


BOTH, APART = view([*TABLE, *FLOOR]), view(TABLE, FLOOR)


def test_pieces_that_most_views_hold_apart_are_labels_of_their_own():
    assert parted(BOTH, APART, APART) == [1, 9, 1]


def test_pieces_that_enough_views_show_as_one_stay_one():
    assert parted(BOTH, BOTH, APART) == [1, 1, 1]


def test_the_rate_is_the_share_of_views_that_must_show_them_as_one():
    assert parted(*[BOTH] * 3, *[APART] * 7) == [1, 9, 1]
    assert parted(*[BOTH] * 5, *[APART] * 5) == [1, 1, 1]


def test_pieces_that_no_view_sees_together_stay_one():
    assert parted(view(TABLE), view(FLOOR)) == [1, 1, 1]


def test_no_order_of_views_or_masks_matters_and_no_second_copy():
    views = [BOTH, APART, view(FLOOR, TABLE), view(TABLE)]
    assert parted(*views) == parted(*views[::-1]) == parted(*views, *views) == [1, 9, 1]


@pytest.mark.parametrize("views", [(), (APART,) * 3])
def test_points_without_label_stay_so(views):
    assert parted(*views, label=0) == [0, 0, 0]
