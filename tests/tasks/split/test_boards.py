import threading
from unittest.mock import patch

import numpy as np
import pytest
from clouds import even_cloud
from labelled_points import one_camera

from ss_flow.running import Surroundings, running
from ss_flow.tasks.artifacts import Hierarchy, PointLabels
from ss_flow.tasks.split import boards
from ss_flow.tasks.split.boards import BoardParams, board_of, part_boards

STEP = 0.02
WOOD, FUR = (90, 60, 30), (230, 140, 60)
EYE = np.array([0.3, -0.2, 3.0])


def sheet(width: float, depth: float, at=(0.0, 0.0, 0.0)) -> np.ndarray:
    x, y = np.meshgrid(np.arange(-width / 2, width / 2, STEP), np.arange(-depth / 2, depth / 2, STEP))
    return np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1) + at


def ball(radius: float, at=(0.0, 0.0)) -> np.ndarray:
    """The upper three quarters of a ball that lies on z = 0, its points STEP apart."""
    count = int(4 * np.pi * (radius / STEP) ** 2)
    z = np.linspace(-0.5, 1, count)
    turn = np.arange(count) * np.pi * (3 - np.sqrt(5))
    ring = np.sqrt(1 - z**2)
    unit = np.stack([ring * np.cos(turn), ring * np.sin(turn), z], axis=1)
    return radius * unit + (*at, radius)


def without(board: np.ndarray, radius: float, at=(0.0, 0.0)) -> np.ndarray:
    """What of a board no camera sees: none of the points under a ball."""
    return board[np.hypot(*(board[:, :2] - at).T) > 0.8 * radius]


BOARD, HEAD = without(sheet(1.1, 1.0), 0.3), ball(0.3)


def board(*places: np.ndarray, spacing=STEP, rises=0.15, around=0.85):
    """Which points are of a board: a list for each of some sets of points; None without one."""
    found = board_of(np.concatenate(places), spacing, EYE, rises=rises, around=around)
    return None if found is None else np.split(found, np.cumsum([len(part) for part in places])[:-1])


def test_a_ball_rises_from_the_middle_of_a_board():
    of_board, of_head = board(BOARD, HEAD)
    assert of_board.mean() > 0.9 and of_head.mean() < 0.05


@pytest.mark.parametrize("scale", [1 / 50, 50])
def test_lengths_have_no_unit(scale):
    found = board_of(scale * np.concatenate([BOARD, HEAD]), scale * STEP, scale * EYE, rises=0.15, around=0.85)
    assert (found == np.concatenate(board(BOARD, HEAD))).all()


def test_a_board_may_hang_on_a_wall_at_a_slant():
    turn = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0]
    found = board_of(np.concatenate([BOARD, HEAD]) @ turn + 5, STEP, EYE @ turn + 5, rises=0.15, around=0.85)
    assert (found == np.concatenate(board(BOARD, HEAD))).mean() > 0.98


def test_the_board_need_not_be_seen_all_round():
    overhung = BOARD[np.abs(np.arctan2(*BOARD[:, :2].T)) > np.radians(20)]
    assert board(overhung, HEAD)[1].mean() < 0.05
    assert board(overhung, HEAD, around=1.0) is None


def test_a_back_at_the_edge_of_a_seat_is_no_thing_of_its_own():
    back = sheet(1.1, 0.9)[:, [0, 2, 1]] + (0, 0.5, 0.45)
    assert board(sheet(1.1, 1.0), back) is None
    assert board(sheet(1.1, 1.0), back - (0, 0.5, 0)) is not None, "the same, in the middle"


def test_a_seat_has_legs():
    legs = np.concatenate([sheet(0.06, 0.8)[:, [0, 2, 1]] + (x, y, -0.4) for x in (-0.5, 0.5) for y in (-0.45, 0.45)])
    assert len(legs) > 0.06 * len(np.concatenate([BOARD, HEAD, legs]))
    assert board(BOARD, HEAD, legs) is None


def test_what_hardly_rises_is_part_of_the_board():
    print_ = sheet(0.5, 0.5, (0, 0, 0.08))
    rim = np.concatenate([print_[(np.abs(print_[:, :2]) > 0.23).any(axis=1)] - (0, 0, z) for z in (0.02, 0.04, 0.06)])
    assert board(without(sheet(1.1, 1.0), 0.25), print_, rim) is None


def test_what_a_board_hardly_shows_beyond_is_no_thing_on_it():
    assert board(without(sheet(0.66, 0.66), 0.3), ball(0.35)) is None


def test_too_few_or_too_coarse_points_have_no_shape():
    assert board(BOARD[::20], HEAD[::20]) is None
    assert board(BOARD, HEAD, spacing=0.05) is None and board(BOARD, HEAD, spacing=0.035) is not None
    assert board_of(np.zeros((0, 3)), STEP, EYE, rises=0.15, around=0.85) is None
    assert board_of(np.zeros((800, 3)), STEP, EYE, rises=0.15, around=0.85) is None


def test_points_on_a_line_are_no_board():
    line = np.linspace(0, 1, 900)[:, None] * (1.0, 2.0, 0.5)
    assert board_of(line, 0.001, EYE, rises=0.15, around=0.85) is None


def parted(head_color=FUR, *, stuff=False, **params) -> tuple[PointLabels, PointLabels]:
    """Instances before and after: 3 is a ball, 7 a board with a ball on it, 0 nothing; ids go up to 9."""
    alone, nothing = ball(0.3, (3, 0)), sheet(0.4, 0.4, (-3, 0, 0))
    sets = [BOARD, HEAD, alone, nothing]
    label = np.repeat(np.array([7, 7, 3, 0], np.int32), [len(part) for part in sets])
    colors = np.repeat(np.array([WOOD, head_color, FUR, WOOD], np.uint8), [len(part) for part in sets], axis=0)
    cloud = even_cloud(np.concatenate(sets).astype(np.float32), colors, 1.0, STEP)
    pose = np.diag([1.0, -1, -1, 1])
    pose[:3, 3] = (-EYE[0], EYE[1], EYE[2])
    rows = np.arange(3, dtype=np.int32)
    before = PointLabels(label, np.ones(len(label)), 9, 0 * rows, rows, np.array([7, 3, 7], np.int32))
    node = np.array([3, 7], np.int32)
    tree = Hierarchy(node, 0 * node, np.ones(2, np.float32), np.array([False, stuff]))
    return before, part_boards(cloud, one_camera(pose), before, tree, params=BoardParams(**params))


def test_a_head_on_its_plaque_becomes_two_instances_with_new_ids_and_the_others_keep_theirs():
    before, after = parted()
    of_board, of_head, others = np.split(after.label, np.cumsum([len(BOARD), len(HEAD)]))
    assert set(of_board) | set(of_head) == {10, 11} and after.num_labels == 11
    assert (of_board == 10).mean() > 0.9 and (of_head == 11).mean() > 0.95
    assert (others == before.label[-len(others) :]).all()
    assert after.match_label.tolist() == [3] and after.match_mask.tolist() == [1], "masks that showed both show neither"


def test_both_of_one_colour_stay_one_thing_and_so_does_stuff():
    for before, after in (parted(WOOD), parted(stuff=True), parted(rises=0.9)):
        assert (after.label == before.label).all() and after.match_label.tolist() == before.match_label.tolist()
        assert after.num_labels == before.num_labels


def test_instances_that_are_looked_at_side_by_side_are_divided_as_one_after_the_other():
    threads = set[str]()
    looked = boards.board_of

    def noted(*given, **settings):
        threads.add(threading.current_thread().name)
        return looked(*given, **settings)

    with patch.object(boards, "board_of", noted), running(Surroundings(cores=3)):
        _, after = parted()
    assert threads and all(name.startswith("view") for name in threads)
    _, alone = parted()
    assert (after.label == alone.label).all() and after.num_labels == alone.num_labels
