"""What becomes of labels when all have voted: which are dropped, united, parted, or renumbered."""

from dataclasses import replace

import numpy as np
import pytest
from box_scene import mask_set, row_of_points
from clouds import even_cloud
from labelled_rows import BARE, lying, points, run, views_of

from ss_flow.tasks.artifacts import BORDER, INSIDE, Visibility
from ss_flow.tasks.split import propagate as module
from ss_flow.tasks.split.propagate import PropagateParams, propagate
from ss_flow.tasks.split.votes.at_once import MaskClusteringParams


def test_labels_of_few_points_are_dropped_in_the_end():
    visible, masks = views_of([[1, 2, 3], [4, 5]])
    result = run(points(8), visible, masks, replace(BARE, min_label_points=3))
    assert set(result.label) == {0, 1}
    assert result.num_labels == 2


@pytest.mark.parametrize(("most", "ids"), [(2, (0, 1, 2)), (3, (0, 2, 3))])
def test_ids_move_up_over_those_that_were_dropped_only_where_the_highest_would_not_fit(monkeypatch, most, ids):
    monkeypatch.setattr(module, "MOST_LABELS", most)
    visible, masks = views_of([[1]], [[2, 3], [4, 5]])
    result = run(points(7), visible, masks, replace(BARE, min_label_points=2))
    assert result.label.tolist() == np.array(ids)[[0, 0, 1, 1, 2, 2, 0]].tolist()
    assert result.num_labels == ids[-1]
    assert result.match_label.tolist() == np.array(ids)[[0, 1, 2]].tolist()


@pytest.mark.parametrize(("touching_merge", "labels"), [(True, 1), (False, 2)])
def test_halves_of_a_sheet_that_masks_part_are_united_only_where_asked(touching_merge, labels):
    v, u = np.divmod(np.arange(400), 20)
    places = np.stack([u, v, 0 * u], axis=1).astype(np.float32)
    cloud = even_cloud(places, np.full((400, 3), 128, np.uint8), 1.0, 1.0)
    every = np.arange(400, dtype=np.int32)
    view = Visibility("0", every, every, np.ones(400, np.float32), 20, 20)
    left = (u < 10).reshape(20, 20)
    found = run(cloud, (view,), (mask_set(np.stack([left, ~left])),), PropagateParams(touching_merge=touching_merge))
    assert len(np.unique(found.label[found.label > 0])) == labels


@pytest.mark.parametrize(("others", "stays"), [(1, True), (2, True), (3, False)])
def test_a_label_that_one_view_shows_goes_to_the_background_where_many_others_look(others, stays):
    visible, masks = views_of([[1, 2, 3], [4, 5, 6]], *[[[4, 5, 6]]] * others)
    besides = [], [0], [7]  # as a second copy of a view confirms nothing
    seen_by_all = visible[0], *(row_of_points([1, 2, 3, 4, 5, 6, *more])[0] for more in besides[:others])
    params = replace(BARE, views="at_once", at_once=MaskClusteringParams(min_points=1, background_vote=0.0))
    settled = run(points(8), seen_by_all, masks, params)
    assert settled.label[4:7].all() and settled.label[1:4].any() == stays
    assert settled.match_label.tolist().count(0) == (not stays)
    # Where no other view looks, it stays; so it does with min_label_views=1, and with a share of 0.
    for views, kept in (
        (visible, params),
        (seen_by_all, replace(params, min_label_views=1)),
        (seen_by_all, replace(params, min_label_share=0.0)),
    ):
        assert run(points(8), views, masks, kept).label[1:7].all()


SEAT = [INSIDE] * 100
SEAT_AND_LEG = replace(
    points(104),
    points=np.array([*np.ndindex(10, 10, 1), (40, 0, 0), (41, 0, 0), (42, 0, 0), (43, 0, 0)], np.float32),
)
"""A seat of 100 points and, well apart, a leg of 4."""


@pytest.mark.parametrize(
    ("inside_in", "tau_piece", "stays"),
    [(2, 0.55, True), (1, 0.55, True), (0, 0.55, False), (1, 0.75, False), (2, 1, False)],
)
def test_a_small_piece_of_a_label_stays_where_views_see_it_inside_of_masks(inside_in, tau_piece, stays):
    views = [lying(SEAT + [INSIDE if view < inside_in else BORDER] * 4) for view in range(2)]
    found = propagate(SEAT_AND_LEG, (), views, params=PropagateParams(tau_piece=tau_piece))
    assert found.label[:100].all()
    assert found.label[100:].all() == found.label[100:].any() == stays


@pytest.mark.parametrize("legs", [([INSIDE] * 4, [BORDER] * 4), ([BORDER] * 4, [INSIDE] * 4)])
def test_a_small_piece_under_two_masks_of_its_label_is_where_the_better_one_says(legs):
    view = lying(*(SEAT + leg for leg in legs))
    assert propagate(SEAT_AND_LEG, (), [view], params=PropagateParams()).label.all()
