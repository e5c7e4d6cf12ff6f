"""Instance metrics: golden values, properties, void and gap rules."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest

from ss_flow.errors import InputError
from ss_flow.tasks.artifacts import Frame, Hierarchy, LabelMap
from ss_flow.tasks.evaluate.instances import evaluate_masks
from ss_flow.tasks.geometry.images import encode_png


def _maps(*views: list[list[int]]) -> tuple[LabelMap, ...]:
    return tuple(LabelMap(f"{i:04d}", np.array(ids, np.uint16)) for i, ids in enumerate(views))


def test_masks_are_pooled_over_views_so_that_an_id_must_hold_in_all_of_them() -> None:
    truth = _maps([[1, 1, 2, 2]], [[1, 1, 2, 2]])
    assert evaluate_masks(_maps([[7, 7, 9, 9]], [[7, 7, 9, 9]]), truth).values["miou"] == 1
    swapped = evaluate_masks(_maps([[7, 7, 9, 9]], [[9, 9, 7, 7]]), truth).values
    assert swapped["miou"] == pytest.approx(1 / 3) and swapped["pq"] == 0
    assert swapped["macc25"] == 1 and swapped["macc50"] == 0


@pytest.mark.parametrize("zero_is_void", [False, True])
def test_measuring_many_views_takes_no_more_memory_than_a_few_of_them(zero_is_void) -> None:
    ids = np.random.default_rng(0).integers(0, 9, (40, 40)).repeat(10, axis=0).repeat(10, axis=1).astype(np.uint16)
    maps = tuple(LabelMap(f"{i:04d}", ids) for i in range(100))
    tracemalloc.start()
    try:
        assert evaluate_masks(maps, maps, zero_is_void=zero_is_void).values["miou"] == 1
        assert tracemalloc.get_traced_memory()[1] < 100 * ids.nbytes / 4
    finally:
        tracemalloc.stop()


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


@pytest.mark.parametrize("zero_is_void", [False, True])
def test_pixels_that_a_views_valid_mask_excludes_count_on_neither_side(zero_is_void) -> None:
    truth = _maps([[1, 1, 2, 2, 0, 0]], [[1, 1, 1, 2, 2, 0]])
    predicted = _maps([[5, 5, 6, 6, 0, 0]], [[5, 5, 0, 5, 6, 7]])  # wrong where the second view is not valid
    valid = encode_png(np.array([[255, 255, 0, 0, 255, 0]], np.uint8))
    empty = np.zeros(0, np.uint8)
    frames = (Frame("0000", 6, 1, empty, empty, 6, 1), Frame("0001", 6, 1, empty, valid, 6, 1))
    values = evaluate_masks(predicted, truth, None, frames, zero_is_void=zero_is_void).values
    assert values["miou"] == values["pq"] == 1 and values["num_predicted"] == 2
    assert evaluate_masks(predicted, truth, zero_is_void=zero_is_void).values["miou"] < 1


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


def test_predicted_stuff_is_no_false_positive_where_only_things_are_annotated() -> None:
    truth, predicted = _maps([[1, 1, 0, 0, 0, 0, 0, 0]]), _maps([[5, 5, 8, 8, 9, 9, 0, 0]])
    tree = Hierarchy(np.int32([5, 8, 9]), np.zeros(3, np.int32), np.ones(3, np.float32), np.array([False, True, False]))
    values = evaluate_masks(predicted, truth, tree).values
    assert values["pq"] == pytest.approx(1 / 2) and values["pq_things"] == pytest.approx(1 / 1.5)
    assert "pq_things" not in evaluate_masks(predicted, truth).values
    # Beside what lies on void, which is none either.
    void = evaluate_masks(_maps([[5, 5, 8, 8, 8, 9, 9, 9]]), _maps([[1, 1, 2, 2, 2, 2, 0, 0]]), tree, zero_is_void=True)
    assert void.values["pq_things"] == pytest.approx(void.values["pq"]) == pytest.approx((1 + 3 / 4) / 2)


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
