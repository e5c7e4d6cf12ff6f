"""Votes of all views at once, on points in a row."""

from dataclasses import replace

import pytest
from box_scene import row_of_points
from labelled_rows import BARE, points, run, views_of

from ss_flow.tasks.split.votes.at_once import MaskClusteringParams


def test_views_at_once_outvote_one_mask_that_holds_two_objects():
    good = [[0, 1, 2, 3], [4, 5, 6, 7]]
    visible, masks = views_of([[0, 1, 2, 3, 4, 5, 6, 7]], good, good, good, good)
    clustering = MaskClusteringParams(min_points=1)
    result = run(points(8), visible, masks, replace(BARE, views="at_once", at_once=clustering))
    left, right = result.label[:4], result.label[4:]
    assert len(set(left)) == len(set(right)) == 1
    assert left[0] != right[0]
    sequential = run(points(8), visible, masks, BARE)
    assert len(set(sequential.label)) == 1


AT_ONCE = replace(BARE, views="at_once", at_once=MaskClusteringParams(min_points=1))


def test_a_point_that_no_view_sees_takes_no_label_from_its_neighbours():
    visible, masks = views_of(*[[[0, 1, 2], [4, 5, 6, 7]]] * 2)
    assert run(points(8), visible, masks, replace(AT_ONCE, smoothing=3)).label[3] == 0


@pytest.mark.parametrize(("background_vote", "label"), [(0.2, 2), (0.3, 0)])
def test_a_point_that_many_views_see_under_no_mask_gets_no_label(background_vote, label):
    # One view has a mask over points 1 to 3; four see them under none: a vote of 1 against 0.8 and 1.2.
    visible, masks = views_of([[1, 2, 3], [4, 5, 6]], *[[[4, 5, 6]]] * 4)
    seen = visible[0], *[row_of_points([1, 2, 3, 4, 5, 6])[0]] * 4
    voting = MaskClusteringParams(min_points=1, background_vote=background_vote)
    found = run(points(8), seen, masks, replace(AT_ONCE, at_once=voting, min_label_views=1))
    assert found.label[1:7].tolist() == [label] * 3 + [1] * 3


def test_a_second_copy_of_a_view_confirms_no_label():
    twice = [[1, 2, 3], [4, 5, 6]]
    visible, masks = views_of(twice, twice, *[[[4, 5, 6]]] * 3)
    others = (row_of_points([1, 2, 3, 4, 5, 6, *more])[0] for more in ([], [0], [7]))
    voting = MaskClusteringParams(min_points=1, background_vote=0.0)
    found = run(points(8), (*visible[:2], *others), masks, replace(AT_ONCE, at_once=voting))
    assert found.label[4:7].all() and not found.label[1:4].any()


def test_the_background_is_no_label_that_views_fail_to_confirm(recwarn):
    _, masks = views_of(*[[[4, 5, 6]]] * 2)
    seen = tuple(row_of_points([*more, 1, 2, 3, 4, 5, 6])[0] for more in ([], [0]))
    assert run(points(8), seen, masks, AT_ONCE).label.tolist() == [0] * 4 + [1] * 3 + [0]
    assert not recwarn.list


def test_contested_points_follow_their_neighbours():
    # Two views disagree about point 3 of a row; its neighbours are sure.
    row = [[0, 1, 2, 3], [4, 5, 6, 7]], [[0, 1, 2], [3, 4, 5, 6, 7]]
    visible, masks = views_of(*row, *row)
    wanted = replace(BARE, views="at_once", at_once=MaskClusteringParams(min_points=1))
    assert run(points(8), visible, masks, wanted).label[3] == 0
    smooth = run(points(8), visible, masks, replace(wanted, smoothing=1))
    assert (smooth.label > 0).all()
    assert len(set(smooth.label.tolist())) == 2
