"""Instances corrected by points that were clicked on things."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from box_scene import row_of_points
from clouds import even_cloud
from hypothesis import given
from hypothesis import strategies as st

from ss_flow.tasks.artifacts import Clicks, Hierarchy, PointCloud, PointLabels, Visibility
from ss_flow.tasks.masks.pool import mask_set
from ss_flow.tasks.split.correct import clicked_points, correct, corrected_tree, part_masks

SIDE = 12
NAMES = ("mug", "box", "cup", "jug")
GREY, RED = (120, 120, 120), (200, 40, 40)


def sheet(*halves: tuple[int, int, int]) -> PointCloud:
    """A square of points, its left half in the first colour, its right half in the last."""
    v, u = np.divmod(np.arange(SIDE * SIDE), SIDE)
    colors = np.where((u < SIDE // 2)[:, None], halves[0], halves[-1])
    points = np.stack([u, v, np.zeros(SIDE * SIDE)], axis=1)
    return even_cloud(points.astype(np.float32), colors.astype(np.uint8), 1.0, 1.0)


def view() -> Visibility:
    """One that sees each point of the sheet at a pixel of its own."""
    every = np.arange(SIDE * SIDE, dtype=np.int32)
    return Visibility("0", every, every, np.ones(len(every), np.float32), SIDE, SIDE)


def left() -> np.ndarray:
    return np.arange(SIDE * SIDE) % SIDE < SIDE // 2


def labelled(label: np.ndarray, confidence: float = 1.0, num_labels: int = 9) -> PointLabels:
    """With one mask matched to label 1, and one to label 2."""
    mask = np.array([0, 1], np.int32)
    share = np.full(len(label), confidence, np.float32)
    return PointLabels(label.astype(np.int32), share, num_labels, 0 * mask, mask, mask + 1)


def clicks(*points: tuple[int, float, float]) -> Clicks:
    """Points of things: number, x, y."""
    things, xs, ys = (np.array(column) for column in zip(*points, strict=True))
    return Clicks(
        "0", things.astype(np.int32), np.stack([xs, ys], axis=1).astype(float), np.ones(len(things), np.int32)
    )


def corrected(cloud: PointCloud, labels: PointLabels, clicked: Clicks, *, pieces=None, masks=()) -> PointLabels:
    return correct(cloud, (view(),), (clicked,), labels if pieces is None else pieces, labels, masks, names=NAMES)


ONE = labelled(np.ones(SIDE * SIDE))
BOTH = clicks((1, 1.5, 6.5), (2, 10.5, 2.5))
"""A point on the left half and one on the right."""


def test_instances_with_points_of_one_thing_become_one_and_others_stay():
    label = np.where(left(), 1, 2)
    label[-5:] = 3
    found = corrected(sheet(GREY), labelled(label), clicks((1, 1.5, 1.5), (1, 10.5, 1.5)))
    assert found.label.tolist() == np.where(label < 3, 10, 3).tolist()
    assert found.num_labels == 10 and found.match_label.tolist() == [10, 10]


def test_an_instance_is_divided_where_its_colour_changes():
    found = corrected(sheet(GREY, RED), ONE, BOTH)
    assert (found.label == np.where(left(), 10, 11)).all()
    assert found.match_label.tolist() == [2]  # the mask of what is divided shows no single thing


def test_an_instance_of_one_colour_is_divided_where_its_pieces_meet():
    pieces = labelled(np.where(np.arange(SIDE * SIDE) % SIDE < 4, 5, 6))
    found = corrected(sheet(GREY), ONE, BOTH, pieces=pieces)
    assert (found.label == np.where(pieces.label == 5, 10, 11)).all()


def test_an_instance_of_one_colour_and_piece_is_divided_where_the_clicked_masks_say():
    masks = labelled(np.where(np.arange(SIDE * SIDE) % SIDE < 3, 1, 2), 0.9, num_labels=2)
    found = corrected(sheet(GREY), ONE, BOTH, masks=(masks,))
    assert (found.label == np.where(masks.label == 1, 10, 11)).all()


def test_a_click_counts_for_more_than_the_mask_of_another_thing():
    wrong = labelled(np.ones(SIDE * SIDE), num_labels=1)
    found = corrected(sheet(GREY, RED), ONE, BOTH, masks=(wrong,))
    assert found.label[2 * SIDE + 10] == 11 and found.label[6 * SIDE + 1] == 10


def test_what_hangs_together_with_no_click_goes_by_its_colour():
    cloud = sheet(GREY, RED)
    cloud.points[SIDE * 6 :, 2] = 500  # the lower half, on which nobody clicks
    found = corrected(cloud, ONE, clicks((1, 1.5, 1.5), (2, 10.5, 1.5)))
    assert (found.label == np.where(left(), 10, 11)).all()


def test_two_parts_of_divided_instances_can_become_one_thing():
    label = np.where(np.arange(SIDE * SIDE) < SIDE * 6, 1, 2)
    all_four = clicks((1, 1.5, 1.5), (1, 1.5, 10.5), (2, 10.5, 1.5), (3, 10.5, 10.5))
    found = corrected(sheet(GREY, RED), labelled(label), all_four)
    assert (found.label == np.where(left(), 10, np.where(label == 1, 11, 12))).all()


def test_a_thing_that_is_right_keeps_its_id():
    found = corrected(sheet(GREY), labelled(np.where(left(), 1, 2)), clicks((1, 1.5, 1.5), (2, 10.5, 1.5)))
    assert found.label.tolist() == np.where(left(), 1, 2).tolist() and found.num_labels == 9


@given(st.permutations([(1, 1.5, 6.5), (1, 3.5, 2.5), (2, 10.5, 2.5), (2, 8.5, 9.5)]))
def test_the_order_of_clicks_does_not_matter(points):
    assert (
        corrected(sheet(GREY), ONE, clicks(*points)).label == corrected(sheet(GREY), ONE, clicks(*sorted(points))).label
    ).all()


def test_clicks_beside_all_instances_are_warned_of():
    label = np.where(left(), 1, 0)
    with pytest.warns(UserWarning, match="1 clicks lie on no instance; they correct nothing"):
        found = corrected(sheet(GREY), labelled(label), clicks((1, 1.5, 1.5), (2, 10.5, 1.5)))
    assert found.label.tolist() == label.tolist()


def test_clicks_on_two_things_that_mean_one_point_are_warned_of_with_both_names():
    with pytest.warns(UserWarning, match="Clicks on 'box' and 'cup' mean one point, which only one of them gets"):
        corrected(sheet(GREY), ONE, clicks((1, 1.5, 1.5), (1, 1.6, 1.5), (2, 6.5, 6.5), (3, 6.6, 6.5)))


def test_a_click_means_the_nearest_point_that_the_view_sees_within_reach():
    seen, _ = row_of_points([2, 5], 200)
    on = Clicks(
        "0",
        np.array([1, 1, 4, 1], np.int32),
        np.array([[2.9, 0.5], [4.6, 0.5], [5.5, 0.5], [100, 0.5]]),
        np.array([1, 1, 0, 1], np.int32),
    )
    nothing = Clicks("1", np.zeros(0, np.int32), np.zeros((0, 2)), np.zeros(0, np.int32))
    rows, things = clicked_points((seen, seen), (on, nothing))
    assert rows.tolist() == [2, 5] and things.tolist() == [1, 1]


WHOLE = mask_set("0", np.ones((1, SIDE, SIDE), bool), np.ones(1, np.float32), "sam")
"""A mask over the whole sheet."""
HALVES = labelled(np.where(left(), 10, 11), num_labels=11)
"""The sheet divided, of which `ONE` is the instance."""


# 5 = {1, 2} is a thing, 6 = {5, 3} a group; 4 and 7 are walls of one stuff, 8 = {4, 7}.
TREE = Hierarchy(
    np.array([1, 2, 3, 4, 7, 5, 6, 8], np.int32),
    np.array([5, 5, 6, 8, 8, 6, 0, 0], np.int32),
    np.array([1, 1, 1, 1, 1, 0.8, 0.4, 0.3], np.float32),
    np.array([0, 0, 0, 1, 1, 0, 0, 1], bool),
)


@pytest.mark.parametrize(
    ("before", "after", "parents", "stuff"),
    [
        ([5, 5, 3, 4, 4], [9, 10, 3, 4, 4], [6, 6], [False, False]),  # divided: both are of the group still
        ([5, 5, 3, 4, 7], [5, 5, 3, 9, 9], [8], [True]),  # walls united are a wall
        ([5, 5, 3, 4, 4], [9, 9, 9, 4, 4], [6], [False]),  # of one group, which they make up
        ([5, 5, 3, 4, 4], [5, 5, 9, 9, 4], [0], [False]),  # of two groups; half of it a wall
        ([5, 5, 3, 4, 0], [5, 5, 3, 4, 0], [], []),
    ],
)
def test_corrected_instances_are_stuff_and_of_the_groups_that_they_were_made_of(before, after, parents, stuff):
    found = corrected_tree(TREE, labelled(np.array(before)), labelled(np.array(after)))
    new = np.isin(found.node, TREE.node, invert=True)
    assert found.node[new].tolist() == sorted({*after} - {*before})
    assert found.parent[new].tolist() == parents and found.stuff[new].tolist() == stuff
    for name, values in vars(TREE).items():
        kept = getattr(found, name)[~new]
        assert kept.tolist() == values.tolist() and kept.dtype == values.dtype
    row = found.row_of()
    assert all(row[int(above)] > own for own, above in enumerate(found.parent) if above)  # children come first


def test_a_mask_over_both_halves_of_a_divided_sheet_becomes_two():
    found = part_masks(view(), WHOLE, ONE, HALVES, contained=0.9)
    lefts = left().reshape(SIDE, SIDE)
    assert sorted(mask.tolist() for mask in found.dense()) == sorted([lefts.tolist(), (~lefts).tolist()])


def test_a_mask_of_one_half_alone_stays_as_it_is():
    half = mask_set("0", left().reshape(1, SIDE, SIDE), np.ones(1, np.float32), "sam")
    assert part_masks(view(), half, ONE, HALVES, contained=0.9) is half


def test_pixels_of_a_divided_mask_on_a_thing_that_it_hardly_shows_go_to_the_nearest_other_one():
    column = np.arange(SIDE * SIDE) % SIDE
    thirds = labelled(np.where(column < 5, 10, np.where(column < 9, 11, 12)), num_labels=12)
    mask = mask_set("0", (column < 10).reshape(1, SIDE, SIDE), np.ones(1, np.float32), "sam")  # a third of thing 12
    assert part_masks(view(), mask, ONE, thirds, contained=0.9).areas().tolist() == [5 * SIDE, 5 * SIDE]


def test_a_view_that_sees_no_point_keeps_its_masks():
    nothing = np.zeros(0, np.int32)
    blind = replace(view(), point_index=nothing, pixel=nothing, depth=np.zeros(0, np.float32))
    assert part_masks(blind, WHOLE, ONE, HALVES, contained=0.9) is WHOLE
