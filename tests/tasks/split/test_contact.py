import numpy as np
import pytest
from clouds import even_cloud

from ss_flow.tasks.split.contact import Contact, find_contact
from ss_flow.tasks.split.votes.touching import TouchingParams, borders

STEP = 0.02


def strip() -> np.ndarray:
    """A strip of points, 0.2 wide along x and 1.0 along y."""
    x, y = np.meshgrid(np.arange(-0.1, 0.1, STEP), np.arange(-0.5, 0.5, STEP))
    return np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)


def test_labels_touch_where_their_points_lie_side_by_side():
    one = strip()
    places = np.concatenate([one, *(one + np.array(at) for at in ((0.2, 0, 0), (0.6, 0, 0), (0.4, 0, 0.5)))])
    label = np.repeat(np.array([1, 3, 0, 4], np.int32), len(one))
    cloud = even_cloud(places.astype(np.float32), np.zeros((len(places), 3), np.uint8), 1.0, STEP)
    contact = find_contact(borders(label, cloud, TouchingParams()), label).points
    assert contact.tolist() == contact.T.tolist()
    assert contact[0, 1] >= 2 * 50  # a row of points on either side
    assert not contact[[0, 1, 2, 0, 1], [0, 1, 2, 2, 2]].any()


def test_where_labels_touch_the_points_of_both_sides_count():
    one = strip()
    coarse = one[np.rint(one[:, 1] / STEP).astype(int) % 2 == 0] + np.array([0.2, 0, 0])  # every second row
    label = np.repeat(np.array([1, 2], np.int32), [len(one), len(coarse)])
    places = np.concatenate([one, coarse]).astype(np.float32)
    cloud = even_cloud(places, np.zeros((len(label), 3), np.uint8), 1.0, STEP)
    contact = find_contact(borders(label, cloud, TouchingParams()), label).points
    assert contact[0, 1] == contact[1, 0] > 0


def test_of_no_labels_none_touch():
    cloud = even_cloud(np.zeros((1, 3), np.float32), np.zeros((1, 3), np.uint8), 1.0, STEP)
    nothing = np.zeros(1, np.int32)
    assert find_contact(borders(nothing, cloud, TouchingParams()), nothing).points.shape == (0, 0)


def a_row() -> Contact:
    """Four pieces in a row, which touch at 50 points of each."""
    return Contact(50 * (np.eye(4, k=1) + np.eye(4, k=-1)).astype(np.float32), np.array([100, 30, 3, 100], np.float32))


def of(*sets: tuple[int, ...]) -> np.ndarray:
    return np.array([[piece in members for piece in range(4)] for members in sets], np.float32)


def test_what_a_set_touches_is_its_own_or_not():
    # 20 points of other things are presumed.
    assert a_row().own(of((0, 1), (1, 2), (0, 2), (0, 1, 2, 3))) == pytest.approx([10 / 17, 10 / 22, 0, 30 / 32])


def test_what_touches_stuff_besides_stands_alone():
    stuff = np.array([False, False, True, False])
    # 50 points are of the set, and 10 of other things are presumed: two thirds of the way from a half to all.
    assert a_row().alone(of((0, 1), (1, 2)), stuff) == pytest.approx([2 / 3, 0])
    assert a_row().alone(of((0, 1)), ~stuff & False) == pytest.approx([0])


def test_a_set_hangs_together_over_its_own_pieces_but_for_crumbs():
    sets = of((0, 1), (0, 1, 2, 3), (0, 3), (0, 2), (1, 3))
    assert a_row().hang_together(sets).tolist() == [True, True, False, True, False]


@pytest.mark.parametrize(("touching", "hang"), [(0, False), (5, False), (7, True), (50, True)])
def test_a_sliver_holds_nothing_together(touching, hang):
    # Each of the two touches others at 100 points besides: from 5.3 on it is a twentieth of what one touches.
    points = np.array([[0, touching, 100, 0], [touching, 0, 0, 200], [100, 0, 0, 0], [0, 200, 0, 0]], np.float32)
    assert Contact(points, np.full(4, 50, np.float32)).hang_together(of((0, 1))).tolist() == [hang]


def test_pieces_that_become_one_touch_what_they_touched():
    member = np.array([[1, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], np.float32)
    joined = a_row().joined(member)
    assert joined.points.tolist() == [[0, 50, 0], [50, 0, 50], [0, 50, 0]] and joined.size.tolist() == [130, 3, 100]


def test_pieces_that_touch_by_others_of_the_same_set_are_together():
    points = np.zeros((6, 6), np.float32)
    for a, b in ((0, 3), (3, 5), (1, 2), (2, 4)):
        points[a, b] = points[b, a] = 7
    contact = Contact(points, np.ones(6, np.float32))
    assert contact.parted((0, 1, 3, 4, 5)) == [(0, 3, 5), (1,), (4,)]
    assert contact.parted((4, 2, 1)) == [(4, 2, 1)]
