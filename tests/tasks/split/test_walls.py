"""Pieces of a wall or a floor become one with it; what hangs on it, lies on it or stands before it does not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from clouds import even_cloud
from labelled_points import labels_of, lying

from ss_flow.tasks.artifacts import Hierarchy
from ss_flow.tasks.split.correct import corrected_tree
from ss_flow.tasks.split.stuff import StuffParams
from ss_flow.tasks.split.walls import WallParams, join_walls

STEP = 0.04
GREY, DARK, RED = (150, 150, 150), (90, 90, 90), (180, 40, 40)
FLOOR = lying(4.0, 4.0, step=STEP)
UPRIGHT = np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]])


def piece(x=3.0, width=0.6, height=0.0):
    """A square in the plane of the floor, beside it, or so high above."""
    return lying(width, width, height, STEP) + np.array([x, 0, 0])


def joined(*parts, stuff=(1,), **params):
    """Instances 1.. of these places and colours before and since, and the tree that tells which are stuff."""
    places = [np.asarray(own) for own, _ in parts]
    label = np.repeat(np.arange(1, len(parts) + 1), [len(own) for own in places])
    colors = np.concatenate([np.broadcast_to(color, own.shape) for own, color in parts])
    cloud = even_cloud(np.concatenate(places).astype(np.float32), colors.astype(np.uint8), 1.0, STEP)
    node = np.arange(1, len(parts) + 1, dtype=np.int32)
    tree = Hierarchy(node, 0 * node, np.ones(len(node), np.float32), np.isin(node, stuff))
    rows = np.arange(len(parts), dtype=np.int32)
    before = replace(labels_of(label), match_view=0 * rows, match_mask=rows, match_label=rows + 1)  # a mask of each
    return before, join_walls(cloud, before, tree, params=WallParams(**params), stuff=StuffParams()), tree


def one_with_the_first(*parts, **told):
    """Which of the instances 2.. are one with instance 1 then."""
    before, after, _ = joined(*parts, **told)
    now = [np.unique(after.label[before.label == name]) for name in range(1, len(parts) + 1)]
    assert all(len(names) == 1 for names in now)
    return [name for name, names in enumerate(now[1:], 2) if names == now[0]]


def test_what_lies_far_off_in_the_plane_of_a_wall_and_has_its_colour_is_the_wall():
    assert one_with_the_first((FLOOR, GREY), (piece(3), GREY), (piece(9), GREY)) == [2, 3]


def test_a_poster_of_other_colours_is_none_nor_is_what_stands_before_the_wall():
    assert one_with_the_first((FLOOR, GREY), (piece(), RED), (piece(height=0.2), GREY)) == []


def test_what_is_as_much_out_of_the_plane_as_in_it_is_none():
    box = np.concatenate([piece(), piece() @ UPRIGHT + (3, 0, 3)])
    assert one_with_the_first((FLOOR, GREY), (box, GREY)) == []


def test_of_what_is_no_stuff_there_are_no_pieces():
    assert one_with_the_first((FLOOR, GREY), (piece(), GREY), stuff=()) == []


def test_a_table_of_more_points_is_no_piece_of_what_is_taken_for_stuff():
    assert one_with_the_first((piece(), GREY), (FLOOR, GREY)) == []


@pytest.mark.parametrize(("brighter", "found"), [(0, [2]), (8, [2]), (40, [])])
def test_a_sheet_of_paper_is_whiter_than_the_table(brighter, found):
    color = tuple(value + brighter for value in GREY)
    assert one_with_the_first((FLOOR, GREY), (piece(), color)) == found


def checkered(dark=0.5):
    """Colours of the floor in tiles, so many of them dark."""
    tile = (np.floor((FLOOR[:, 0] + 2) / 0.4) * 10 + np.floor((FLOOR[:, 1] + 2) / 0.4)) % 100
    shuffled = np.random.default_rng(0).permutation(100)[tile.astype(int)]
    return np.where((shuffled < 100 * dark)[:, None], DARK, GREY)


def test_tiles_of_each_colour_are_the_floors_and_a_mat_of_another_is_not():
    parts = (piece(3), GREY), (piece(4), DARK), (piece(5), RED), (piece(6, 1.8), GREY)
    assert one_with_the_first((FLOOR, checkered()), *parts) == [2, 3, 5]


@pytest.mark.parametrize(("dark", "found"), [(0.2, [2]), (0.04, [])])
def test_a_colour_that_the_floor_hardly_has_is_not_its_own(dark, found):
    assert one_with_the_first((FLOOR, checkered(dark)), (piece(), DARK)) == found


@pytest.mark.parametrize(("red", "found"), [(0.05, [2]), (0.2, [])])
def test_a_piece_has_hardly_a_colour_that_the_wall_has_not(red, found):
    places = piece()
    color = np.where((np.arange(len(places)) < red * len(places))[:, None], RED, GREY)
    assert one_with_the_first((FLOOR, GREY), (places, color)) == found


def test_a_piece_of_either_of_two_walls_that_are_one_label_is_one():
    corner = np.concatenate([FLOOR, FLOOR @ UPRIGHT + (-2, 0, 2)])
    above = lying(0.6, 0.6, step=STEP) @ UPRIGHT + (-2, 0, 5)
    assert one_with_the_first(
        (corner, GREY), (piece(), GREY), (above, GREY), (above + np.array([1.0, 0, 0]), GREY)
    ) == [2, 3]


def test_what_may_be_of_two_walls_is_of_the_larger():
    other = lying(3.0, 3.0, step=STEP) + np.array([6.0, 0, 0])
    colors = np.where((other[:, 0] < 6)[:, None], RED, GREY)
    assert one_with_the_first((FLOOR, checkered()), (other, colors), (piece(9), GREY), stuff=(1, 2)) == [3]


def test_pieces_of_a_piece_that_is_stuff_itself_are_the_walls():
    """A part of the floor in the shade has the colour of what is left of it, and the lit part has some shade."""
    other = lying(3.0, 3.0, step=STEP) + np.array([6.0, 0, 0])
    shaded = np.where((other[:, 0] < 5.1)[:, None], DARK, GREY)
    parts = (FLOOR, GREY), (other, shaded), (piece(9), DARK)
    assert one_with_the_first(*parts, stuff=(1, 2), colors=0.85) == []
    assert one_with_the_first(*parts, stuff=(1, 2), colors=0.75) == [2, 3]


def test_what_is_joined_gets_a_new_id_and_stays_stuff_and_all_else_keeps_its_own():
    before, after, tree = joined((FLOOR, GREY), (piece(3), RED), (piece(6), GREY), (piece(9)[:9], GREY))
    assert [np.unique(after.label[before.label == name]).tolist() for name in (1, 2, 3, 4)] == [[5], [2], [5], [4]]
    assert after.num_labels == 5
    assert after.match_mask.tolist() == [0, 1, 2, 3] and after.match_label.tolist() == [5, 2, 5, 4]
    since = corrected_tree(tree, before, after)
    assert since.stuff[since.node == 5].tolist() == [True]


def test_without_labels_there_is_nothing_to_join():
    none = labels_of(np.zeros(0, np.int32))
    cloud = even_cloud(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8), 1.0, STEP)
    node = np.zeros(0, np.int32)
    after = join_walls(cloud, none, Hierarchy(node, node, node.astype(np.float32), node > 0), params=WallParams())
    assert after.num_labels == 0 and not len(after.label)
