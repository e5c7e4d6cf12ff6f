"""One-to-one measures: hand-counted examples and their bounds."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from ss_flow.tasks.evaluate.contingency import Contingency, contingency
from ss_flow.tasks.evaluate.panoptic import (
    hungarian_miou,
    over_segmentation,
    panoptic_quality,
    pieces,
    under_segmentation,
    whole,
)

_IDS = hnp.arrays(np.int64, 24, elements=st.integers(0, 4))


def _table(truth: list[int] | np.ndarray, predicted: list[int] | np.ndarray) -> Contingency:
    return contingency(np.asarray(truth), np.asarray(predicted)).without(truth=0, predicted=0)


def test_an_iou_of_exactly_one_half_is_no_match() -> None:
    assert panoptic_quality(_table([1, 1], [3, 0])).matched == 0
    assert panoptic_quality(_table([1, 1, 1], [3, 3, 0])) == pytest.approx((2 / 3, 2 / 3, 1, 1, 0, 0))


def test_an_ignored_prediction_is_no_false_positive() -> None:
    table = _table([1, 1, 0], [3, 3, 4])
    assert panoptic_quality(table).rq == pytest.approx(1 / 1.5)
    assert panoptic_quality(table, np.array([False, True])).rq == 1


@given(_IDS, _IDS)
def test_matches_are_one_to_one_and_quality_lies_between_zero_and_one(truth: np.ndarray, predicted: np.ndarray) -> None:
    table = _table(truth, predicted)
    quality = panoptic_quality(table)
    matches = table.iou > 0.5
    assert (matches.sum(axis=0) <= 1).all() and (matches.sum(axis=1) <= 1).all()
    assert quality.matched + quality.false_negatives == len(table.truth_ids)
    assert quality.matched + quality.false_positives == len(table.predicted_ids)
    assert 0 <= quality.pq <= 1


@given(_IDS.filter(lambda x: x.any()), _IDS)
def test_hungarian_miou_is_the_best_of_all_assignments(truth: np.ndarray, predicted: np.ndarray) -> None:
    table = _table(truth, predicted)
    g, p = table.iou.shape
    iou = np.pad(table.iou, ((0, 0), (0, g)))
    best = max(sum(iou[i, j] for i, j in enumerate(way)) for way in itertools.permutations(range(p + g), g))
    assert hungarian_miou(table) == pytest.approx(best / g)
    assert hungarian_miou(table) <= table.best_iou().mean() + 1e-12


def test_over_and_under_segmentation_count_shares_of_a_tenth_and_more() -> None:
    truth = [1] * 20 + [2] * 20
    split = [3] * 18 + [4] * 2 + [5] * 20
    assert over_segmentation(_table(truth, split)) == 0.5
    assert over_segmentation(_table(truth, [3] * 19 + [4] + [5] * 20)) == 0, "a twentieth does not count"
    assert under_segmentation(_table(truth, split)) == 0
    assert under_segmentation(_table(truth, [3] * 40)) == 1
    thirty = _table([1] * 30, [3] * 27 + [4] * 3)  # 0.1 * 30 is more than 3 in floating point
    assert over_segmentation(thirty) == 1 and pieces(thirty).tolist() == [2] and not whole(thirty).any()


def test_a_thing_is_whole_when_one_prediction_fits_it_and_no_second_covers_a_tenth() -> None:
    truth = np.repeat([1, 2, 3, 4, 5, 0], 20)
    predicted = [5] * 19 + [6] + [7] * 18 + [8] * 2 + [9] * 8 + [0] * 12 + [10] * 40 + [11] * 20
    table = _table(truth, predicted)
    assert pieces(table).tolist() == [1, 2, 1, 1, 1], "a twentieth is no piece, exactly a tenth is one"
    assert over_segmentation(table) == 0.2
    # 1: IoU 0.95; 2: 0.9, but a tenth of it is another id; 3: IoU 0.4; 4 and 5: one id on both, IoU 0.5 each.
    assert whole(table).tolist() == [True, False, False, True, True]
    assert whole(_table([1] * 10 + [0], [5] * 11)).tolist() == [True], "10/11"
    assert whole(_table([1] * 9 + [2] * 11, [5] * 20)).tolist() == [False, True], "what is merged into more is not"


@given(_IDS.filter(lambda x: x.any()), _IDS, st.permutations(range(1, 6)))
def test_whole_things_are_matched_ones_and_the_names_of_predictions_do_not_matter(
    truth: np.ndarray, predicted: np.ndarray, names: list[int]
) -> None:
    table = _table(truth, predicted)
    assert whole(_table(truth, truth)).all()
    assert (whole(table) <= (table.best_iou() >= 0.5)).all() and (whole(table) <= (pieces(table) == 1)).all()
    renamed = np.where(predicted > 0, np.array([0, *names])[predicted], 0)
    assert whole(_table(truth, renamed)).tolist() == whole(table).tolist()


def test_an_empty_prediction_scores_zero_everywhere() -> None:
    table = _table([1, 2], [0, 0])
    assert panoptic_quality(table) == (0, 0, 0, 0, 0, 2)
    assert hungarian_miou(table) == over_segmentation(table) == under_segmentation(table) == 0
    assert not whole(table).any() and not pieces(table).any()
