import numpy as np
import pytest
from flat_patches import BROWN, GREY, RED, WHITE, Patch, patch, scene, views_of

from ss_flow.tasks.split.inlays import Inlays, find_inlays
from ss_flow.tasks.split.looks import Looks
from ss_flow.tasks.split.votes.touching import TouchingParams, borders

EYES = [(0.5, 0.4, 2.7), (0.2, -0.6, 2.4), (0.8, 1.1, 2.4)]
HIGH = 0.7


def rectangle(color: np.ndarray, low: tuple[float, float], high: tuple[float, float], z: float = HIGH) -> Patch:
    """A part of a board of one square metre."""
    places, colors = (
        np.concatenate(both) for both in zip(*(patch(color, 0, y, z, 1.0) for y in (0, 0.5)), strict=True)
    )
    part = ((places[:, :2] > np.array(low) - 1e-6) & (places[:, :2] < np.array(high) - 1e-6)).all(axis=1)
    return places[part], colors[part]


def without(board: Patch, *holes: Patch) -> Patch:
    """A board, but for what is over or under others."""
    taken = {tuple(p) for places, _ in holes for p in places[:, :2].round(3).tolist()}
    kept = np.array([tuple(p) not in taken for p in board[0][:, :2].round(3).tolist()])
    return board[0][kept], board[1][kept]


def found(*patches: Patch, unlabelled: int = 0, asked: list[bool] | None = None, eyes=EYES) -> Inlays:
    cloud, _, label = scene(*patches, unlabelled=unlabelled)
    of = len(patches) - unlabelled
    ends = borders(label, cloud, TouchingParams())
    return find_inlays(Looks(cloud, *views_of(cloud, *eyes)), label, ends, np.array(asked or [True] * of))


def lies_in(*patches: Patch, **how) -> list[list[int]]:
    """Which patches, 1.. in their order, lie in which other ones."""
    inlays = found(*patches, **how)
    return [[inner + 1, outer + 1] for inner, outer in inlays.pairs([(row,) for row in range(len(inlays.size))])]


BOARD = rectangle(BROWN, (0, 0), (1, 1))
PICTURE = rectangle(WHITE, (0.3, 0.3), (0.7, 0.7))
MOUNT = without(BOARD, PICTURE)


def test_a_picture_lies_in_its_mount():
    assert lies_in(MOUNT, PICTURE) == [[2, 1]] and lies_in(PICTURE, MOUNT) == [[1, 2]]
    inlays = found(MOUNT, PICTURE)
    assert inlays.size.tolist() == [len(MOUNT[0]), len(PICTURE[0])]
    assert inlays.shown[1, 0] == inlays.places[1] >= 100


@pytest.mark.parametrize(("smooth", "lies"), [(59, False), (60, True)])
def test_it_must_go_on_into_the_other_without_an_edge_along_most_of_where_they_touch(smooth, lies):
    around, touch = np.array([[0.0, 0], [20, 0]]), np.array([[0.0, 100], [100, 0]])
    inlays = Inlays(np.full(2, 100.0), np.array([0.0, 20]), around, touch, smooth / 100 * touch)
    assert inlays.pairs([(0,), (1,)]) == [(1, 0)] * lies


def test_what_is_small_in_it_does_not():
    label = rectangle(WHITE, (0.4, 0.4), (0.6, 0.6))
    assert lies_in(without(BOARD, label), label) == []  # a hundred of 2,500 points


def test_what_rises_from_it_does_not():
    assert lies_in(MOUNT, (PICTURE[0] + np.array([0, 0, 0.15]), PICTURE[1])) == []


@pytest.mark.parametrize("unlabelled", [0, 1])
def test_all_round_it_must_be_the_other(unlabelled):
    beside = rectangle(GREY, (0.7, 0), (1, 1))
    assert lies_in(without(MOUNT, beside), PICTURE, beside, unlabelled=unlabelled) == []
    # Nothing is seen there, though the views look.
    assert lies_in(without(MOUNT, beside), PICTURE) == []


def test_what_the_pictures_do_not_show_is_not_asked_for():
    beside = rectangle(GREY, (0.7, 0), (1, 1))
    low = [(0.5, 0.25, 1.0)]  # from near, the picture's right end lies at the rim
    aside = np.array([0.3, 0, 0])
    board, picture = without(MOUNT, beside), PICTURE
    assert lies_in((board[0] + aside, board[1]), (picture[0] + aside, picture[1]), eyes=low) == [[2, 1]]


def test_what_hides_the_rim_tells_nothing():
    beside = rectangle(RED, (0.7, 0), (1, 1))
    over = beside[0] + np.array([0, 0, 0.1]), beside[1]
    assert lies_in(without(MOUNT, beside), PICTURE, over) == [[2, 1]]


def test_what_one_view_hides_another_one_tells():
    beside = rectangle(RED, (0.7, 0), (1, 1), HIGH + 0.5)  # as lamps hang over a table
    inlays = found(MOUNT, PICTURE, beside)
    assert inlays.places[1] == 100 and inlays.shown[1, 0] == 100


def test_a_place_shows_what_most_views_see_there():
    crumbs = np.random.default_rng(0).random(len(MOUNT[0])) < 0.08
    lift = np.array([0, 0, 0.05])  # so that views see them elsewhere
    parts = [(MOUNT[0][rows] + by, MOUNT[1][rows]) for rows, by in ((~crumbs, 0 * lift), (crumbs, lift))]
    turns = np.linspace(0, 2 * np.pi, 9, endpoint=False)
    eyes = [(0.5 + np.cos(turn), 0.3 + np.sin(turn), 2.4) for turn in turns]
    shown = found(parts[0], PICTURE, parts[1], asked=[False, True, False], eyes=eyes).shown[1]
    assert shown[0] > 75 and shown.sum() == 100


def test_a_mount_of_two_pieces_is_around_it_as_one():
    left, right = (rectangle(BROWN, (x, 0), (x + 0.5, 1)) for x in (0, 0.5))
    inlays = found(without(left, PICTURE), without(right, PICTURE), PICTURE)
    assert inlays.pairs([(0,), (1,), (2,)]) == []
    assert inlays.pairs([(0, 1), (2,)]) == [(1, 0)]
    halves = [rectangle(WHITE, (x, 0.3), (x + 0.2, 0.7)) for x in (0.3, 0.5)]
    inlays = found(MOUNT, *halves)
    assert inlays.pairs([(0,), (1,), (2,)]) == []
    assert inlays.pairs([(0,), (1, 2)]) == [(1, 0)]


def test_one_asks_of_flat_labels_alone_and_of_those_that_one_wants_to_know():
    assert lies_in(MOUNT, PICTURE, asked=[True, False]) == []
    bent = PICTURE[0].copy()
    bent[:, 2] += 0.5 * (bent[:, 0] - 0.5) ** 2 * 10
    assert found(MOUNT, (bent, PICTURE[1])).places[1] == 0
    few = rectangle(WHITE, (0.4, 0.4), (0.56, 0.6))
    assert found(without(BOARD, few), few).places.tolist()[1] == 0


def test_a_stray_point_far_off_makes_squares_larger_but_not_more():
    stray = np.append(PICTURE[0], [[1e6, 1e6, HIGH]], axis=0), np.append(PICTURE[1], WHITE[None], axis=0)
    assert found(MOUNT, stray).places[1] <= 300
