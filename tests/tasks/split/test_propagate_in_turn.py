"""Votes view by view, on points in a row: which label a mask takes, and what its points then have."""

from dataclasses import replace

import numpy as np
import pytest
from box_scene import permuted, row_of_points
from labelled_rows import BARE, in_turn, lying, points, run, views_of

from ss_flow.tasks.artifacts import BORDER, INSIDE
from ss_flow.tasks.split.observe import ObserveParams
from ss_flow.tasks.split.propagate import propagate
from ss_flow.tasks.split.votes.in_turn import SequentialParams, _vote
from ss_flow.tasks.split.votes.votes import Votes

PRESETS = {
    "paper": (in_turn(contested_vote=1.0), ObserveParams(nested=True)),
    "reference": (in_turn(contested_vote=0.75, contested_first_vote=1.0), ObserveParams(nested=True)),
    "default": (BARE, ObserveParams()),
}
EXAMPLE = ([[1, 2, 3], [4, 5]], [[2, 3, 4], [5, 6]], [[4, 5, 6]])
"""The worked example E1 of the specification; pixel and point 0 and 7 are seen by no view."""


@pytest.mark.parametrize(
    ("preset", "label_of_4", "share_of_4"),
    [("paper", 0, 2.25 / 3.25), ("reference", 2, 2.25 / 3.0), ("default", 2, 2.25 / (2.25 + 2 / 3))],
)
def test_the_worked_example_of_the_specification(preset, label_of_4, share_of_4):
    visible, masks = views_of(*EXAMPLE)
    result = run(points(8), visible, masks, *PRESETS[preset])
    assert result.label.tolist() == [0, 1, 1, 1, label_of_4, 2, 2, 0]
    np.testing.assert_allclose(result.confidence, [0, 1, 1, 1, share_of_4, 1, 1, 0], rtol=1e-6)
    assert result.num_labels == 2
    assert result.match_view.tolist() == [0, 0, 1, 1, 2]
    assert result.match_mask.tolist() == [0, 1, 0, 1, 0]
    assert result.match_label.tolist() == [1, 2, 1, 2, 2]


@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize("nested", [False, True])
def test_swapping_the_masks_of_the_worked_example_changes_nothing(preset, nested):
    params, _ = PRESETS[preset]
    visible, masks = views_of(*EXAMPLE)
    swapped = tuple(permuted(m, np.arange(len(m))[::-1]) for m in masks)
    a, b = (run(points(8), visible, m, params, ObserveParams(nested=nested)) for m in (masks, swapped))
    assert a.label.tolist() == b.label.tolist()
    assert a.confidence.tolist() == b.confidence.tolist()


@pytest.mark.parametrize(("first", "leader", "share"), [(0.0, 3, 1 / 1.9375), (1.0, 2, 0.5)])
def test_the_first_vote_of_a_point_from_a_contested_mask_has_a_weight_of_its_own(first, leader, share):
    votes, params = Votes(2), SequentialParams(contested_vote=0.75, contested_first_vote=first)
    for rows, label, purity in (([0], 1, 1.0), ([0, 1], 2, 0.5), ([1], 3, 1.0)):
        _vote(votes, np.array(rows, np.int32), label, purity, params)
    labels, shares = votes.leaders()
    assert labels.tolist() == [1, leader]
    np.testing.assert_allclose(shares, [1.25 / 2.0, share])


def test_a_mask_without_enough_points_founds_no_object():
    visible, masks = views_of([[1, 2, 3], [4, 5]])
    result = run(points(8), visible, masks, in_turn(min_new_points=3))
    assert result.label.tolist() == [0, 1, 1, 1, 0, 0, 0, 0]
    assert result.match_mask.tolist() == [0]


def test_a_mask_that_hardly_touches_a_label_is_a_new_object():
    visible, masks = views_of([[0, 1]], [[1, 2, 3, 4, 5, 6]])
    joined = run(points(8), visible, masks, BARE)
    assert joined.label[6] == joined.label[0] == 1
    for least in ({"min_overlap_share": 0.5}, {"min_overlap": 2}):
        assert run(points(8), visible, masks, in_turn(**least)).label[6] == 2


def test_a_second_pass_matches_early_views_against_late_labels():
    # View 1 sees two halves of an object, view 2 all of it: only then is it known that the halves are one.
    visible, masks = views_of([[1, 2, 3], [4, 5, 6, 7]], [[1, 2, 3, 4, 5, 6, 7]], [[1, 2, 3, 4, 5, 6, 7]])
    once, twice = (
        run(points(8), visible, masks, replace(in_turn(contested_vote=1.0, passes=passes), tau_label=0.6))
        for passes in (1, 2)
    )
    assert once.label[1:].tolist() == [1] * 7
    assert once.confidence[1] == pytest.approx(2 / 3.25)
    assert twice.confidence[1:].tolist() == [1.0] * 7


def test_a_mask_that_overlaps_no_label_is_a_new_object_however_little_is_asked_for():
    visible, masks = views_of([[0, 1]], [[2, 3]])
    assert run(points(8), visible, masks, in_turn(min_overlap=0)).match_label.tolist() == [1, 2]


@pytest.mark.parametrize(("standing", "label"), [([INSIDE] * 4, 1), ([BORDER, BORDER, INSIDE, INSIDE], 2)])
def test_points_at_the_border_of_a_mask_are_no_overlap(standing, label):
    view, _ = row_of_points([0, 1, 2, 3])
    both = lying([INSIDE, INSIDE, BORDER, BORDER]), lying(standing)
    assert propagate(points(8), (view, view), both, params=BARE).match_label.tolist() == [1, label]


def test_points_that_a_pass_left_contested_are_painted_with_no_label_in_the_next():
    # Points 6 and 7 are of one mask in the last view; two labels share the votes on 6.
    visible, masks = views_of([[0, 1], [2, 3, 6], [4, 5]], [[0, 1], [2, 3], [4, 5, 6]], [[6, 7]])
    found = run(points(8), visible, masks, in_turn(passes=2, lambda_init=0.001))
    assert found.match_view.tolist()[-1] == 2 and found.match_label.tolist()[-1] == 4
