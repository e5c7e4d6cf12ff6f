"""Instance metrics: golden values, properties, void and gap rules."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from ss_flow.errors import InputError
from ss_flow.tasks.artifacts import Gaussians, LabelMap, PointCloud, PointLabels
from ss_flow.tasks.evaluate.instances import (
    evaluate_gaussians,
    evaluate_masks,
    evaluate_points,
    ig_metrics,
    transfer_nearest,
)

TRUTH = np.array([0, 0, 0, 0, 1, 1, 2, -1])
PREDICTED = np.array([5, 5, 5, 7, 7, 7, 5, 9])


def _maps(*views: list[list[int]]) -> tuple[LabelMap, ...]:
    return tuple(LabelMap(f"{i:04d}", np.array(ids, np.uint16)) for i, ids in enumerate(views))


def _cloud(points: np.ndarray) -> PointCloud:
    return PointCloud(points.astype(np.float32), np.zeros((len(points), 3), np.uint8), 1.0, 0.1)


def _labels(label: list[int]) -> PointLabels:
    none = np.zeros(0, np.int32)
    array = np.array(label, np.int32)
    return PointLabels(array, np.ones(len(label), np.float32), 9, none, none, none, np.zeros(0, np.float32))


def test_ig_protocol_gives_the_golden_values_e3() -> None:
    values = ig_metrics(TRUTH, PREDICTED)
    assert values["miou"] == pytest.approx((3 / 5 + 2 / 3 + 1 / 4) / 3)
    assert values["miou"] == pytest.approx(0.50556, abs=1e-5)
    assert values["macc25"] == pytest.approx(2 / 3), "an IoU of exactly 0.25 is no hit"
    assert values["macc50"] == pytest.approx(2 / 3)


def test_the_gap_bug_scores_the_missing_id_and_overlooks_the_highest() -> None:
    truth = np.array([0, 0, 2, 2])
    predicted = np.array([1, 1, 4, 4])
    assert ig_metrics(truth, predicted)["miou"] == 1
    assert ig_metrics(truth, predicted, compat_gap_bug=True)["miou"] == 0.5
    assert ig_metrics(TRUTH, PREDICTED, compat_gap_bug=True) == ig_metrics(TRUTH, PREDICTED), "no gap, no difference"


@given(
    hnp.arrays(np.int64, 30, elements=st.integers(-1, 4)).filter(lambda x: (x >= 0).any()),
    hnp.arrays(np.int64, 30, elements=st.integers(-1, 4)),
    st.permutations(range(6)),
)
def test_renaming_predictions_and_shuffling_points_changes_nothing(
    truth: np.ndarray, predicted: np.ndarray, names: list[int]
) -> None:
    expected = ig_metrics(truth, predicted)
    assert ig_metrics(truth, np.array(names)[predicted + 1]) == pytest.approx(expected)
    order = np.random.default_rng(0).permutation(30)
    assert ig_metrics(truth[order], predicted[order]) == pytest.approx(expected)
    assert 0 <= expected["macc50"] <= expected["macc25"] <= 1
    assert ig_metrics(truth, truth)["miou"] == 1


def test_points_without_annotation_are_refused() -> None:
    with pytest.raises(InputError, match="no annotated point"):
        ig_metrics(np.array([-1, -1]), np.array([0, 1]))


def test_labels_go_to_the_nearest_target_and_no_farther_than_the_radius() -> None:
    points = np.array([[0, 0, 0], [1, 0, 0]], np.float32)
    targets = np.array([[0.4, 0, 0], [0.6, 0, 0], [9, 0, 0]], np.float32)
    labels = np.array([3, 4], np.int32)
    assert transfer_nearest(points, labels, targets).tolist() == [3, 4, 4]
    assert transfer_nearest(points, labels, targets, radius=0.5).tolist() == [3, 4, 0]
    with pytest.raises(InputError, match="no labelled point"):
        transfer_nearest(points[:0], labels[:0], targets)


def test_points_and_gaussians_are_scored_on_the_points_of_the_ground_truth() -> None:
    place = np.arange(8)[:, None] * np.array([1.0, 0, 0])
    shown = _cloud(place + np.array([0.01, 0, 0]))
    truth = _labels([int(i) + 1 for i in TRUTH])
    expected = pytest.approx(ig_metrics(TRUTH, PREDICTED))
    assert evaluate_points(shown, _labels(PREDICTED.tolist()), _cloud(place), truth).values == expected
    n = len(place)
    scene = Gaussians(
        shown.points,
        np.tile(np.float32([1, 0, 0, 0]), (n, 1)),
        np.zeros((n, 3), np.float32),
        np.full(n, -9, np.float32),
        np.zeros((n, 1, 3), np.float32),
        PREDICTED.astype(np.int32),
        np.ones(n, np.float32),
        np.zeros(n, np.int32),
    )
    assert evaluate_gaussians(scene, _cloud(place), truth).values == expected


def test_masks_are_pooled_over_views_so_that_an_id_must_hold_in_all_of_them() -> None:
    truth = _maps([[1, 1, 2, 2]], [[1, 1, 2, 2]])
    assert evaluate_masks(_maps([[7, 7, 9, 9]], [[7, 7, 9, 9]]), truth).values["miou"] == 1
    swapped = evaluate_masks(_maps([[7, 7, 9, 9]], [[9, 9, 7, 7]]), truth).values
    assert swapped["miou"] == pytest.approx(1 / 3) and swapped["pq"] == 0
    assert swapped["macc25"] == 1 and swapped["macc50"] == 0


def test_mask_metrics_are_those_counted_by_hand() -> None:
    truth = _maps([[1, 1, 1, 1, 0, 0, 0, 0]], [[2, 2, 3, 3, 3, 0, 0, 0]])
    predicted = _maps([[5, 5, 5, 0, 0, 0, 0, 0]], [[6, 6, 6, 0, 0, 0, 8, 8]])
    # 1 and 5: 3/4; 2 and 6: 2/3; 3 and 6: 1/5; 8 lies on structure.
    values = evaluate_masks(predicted, truth).values
    assert values["miou"] == pytest.approx((3 / 4 + 2 / 3 + 1 / 5) / 3)
    assert values["macc25"] == values["macc50"] == pytest.approx(2 / 3)
    assert values["sq"] == pytest.approx((3 / 4 + 2 / 3) / 2)
    assert values["rq"] == pytest.approx(2 / (2 + 0.5 + 0.5))
    assert values["pq"] == pytest.approx(values["sq"] * values["rq"])
    assert values["hungarian_miou"] == pytest.approx((3 / 4 + 2 / 3) / 3)
    assert values["over_segmentation"] == 0 and values["under_segmentation"] == pytest.approx(1 / 3)
    assert values["num_truth"] == 3 and values["num_predicted"] == 3


def test_predictions_on_void_count_neither_for_nor_against() -> None:
    truth = _maps([[1, 1, 0, 0, 0, 0, 0, 0]])
    predicted = _maps([[5, 5, 5, 5, 5, 0, 8, 8]])
    strict, void = (evaluate_masks(predicted, truth, zero_is_void=flag).values for flag in (False, True))
    assert strict["miou"] == pytest.approx(2 / 5) and strict["rq"] == 0
    assert void["miou"] == 1 and void["pq"] == 1
    mostly_void = evaluate_masks(_maps([[5, 0, 5, 5, 5, 0, 0, 0]]), truth, zero_is_void=True).values
    assert mostly_void["rq"] == 0 and mostly_void["miou"] == 0.5
    on_it = evaluate_masks(_maps([[5, 6, 6, 0, 0, 0, 0, 0]]), _maps([[1, 1, 0, 2, 2, 2, 2, 2]]), zero_is_void=True)
    assert on_it.values["num_predicted"] == 2


def test_the_share_of_whole_instances_is_that_counted_by_hand() -> None:
    truth = _maps([[1, 1, 1, 1, 2, 2, 2, 2, 0, 0, 0, 0]], [[1, 1, 1, 1, 3, 3, 3, 3, 0, 0, 0, 0]])
    # 1 is 5 in one view and 6 in the other; 2 is 7; 3 is 8, which reaches far into 0.
    predicted = _maps([[5, 5, 5, 5, 7, 7, 7, 0, 0, 0, 0, 8]], [[6, 6, 6, 6, 8, 8, 8, 8, 8, 8, 8, 8]])
    assert evaluate_masks(predicted, truth).values["whole"] == pytest.approx(1 / 3)
    assert evaluate_masks(predicted, truth, zero_is_void=True).values["whole"] == pytest.approx(2 / 3)


def test_an_unmatched_prediction_is_a_false_positive_only_when_it_lies_mostly_on_annotated_pixels() -> None:
    truth = _maps([[1, 1, 1, 1, 1, 1, 0, 0, 0, 0]])
    good = [5, 5, 5, 5]
    inside = evaluate_masks(_maps([[*good, 6, 6, 6, 0, 0, 0]]), truth, zero_is_void=True).values
    outside = evaluate_masks(_maps([[*good, 0, 6, 6, 6, 6, 0]]), truth, zero_is_void=True).values
    assert inside["rq"] == pytest.approx(1 / 1.5)
    assert outside["rq"] == 1


def test_nothing_predicted_scores_zero() -> None:
    values = evaluate_masks(_maps([[0, 0]]), _maps([[1, 2]])).values
    assert values["miou"] == values["pq"] == values["macc25"] == values["hungarian_miou"] == 0


def test_views_without_ground_truth_are_left_out_and_views_go_by_name() -> None:
    predicted = _maps([[4, 4]], [[3, 3]])
    truth = (LabelMap("0001", np.array([[1, 1]], np.uint16)),)
    assert evaluate_masks(predicted, truth).values["miou"] == 1
    assert evaluate_masks(predicted[::-1], truth).values["num_predicted"] == 1


def test_masks_that_do_not_belong_to_the_ground_truth_are_refused() -> None:
    with pytest.raises(InputError, match="View 0001 has ground truth masks but no predicted"):
        evaluate_masks(_maps([[1]]), _maps([[1]], [[1]]))
    with pytest.raises(InputError, match="2 x 1 pixels, its ground truth has 1 x 1"):
        evaluate_masks(_maps([[1, 1]]), _maps([[1]]))
    with pytest.raises(InputError, match="no instance"):
        evaluate_masks(_maps([[1]]), _maps([[0]]))
    with pytest.raises(InputError, match="no instance"):
        evaluate_masks((), ())
