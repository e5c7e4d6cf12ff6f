"""Counting label pairs: against the obvious way."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from ss_flow.tasks.evaluate import contingency as module
from ss_flow.tasks.evaluate.contingency import Contingency, added_up, contingency

_LABELS = hnp.arrays(np.int64, 40, elements=st.sampled_from([-1, 0, 1, 2, 7, 65535]))


@given(_LABELS, _LABELS)
def test_counts_and_ious_are_those_of_masks_compared_one_by_one(truth: np.ndarray, predicted: np.ndarray) -> None:
    table = contingency(truth, predicted)
    np.testing.assert_array_equal(table.truth_ids, np.unique(truth))
    np.testing.assert_array_equal(table.predicted_ids, np.unique(predicted))
    for i, g in enumerate(table.truth_ids):
        for j, p in enumerate(table.predicted_ids):
            a, b = truth == g, predicted == p
            assert table.intersection[i, j] == (a & b).sum()
            assert table.iou[i, j] == pytest.approx((a & b).sum() / (a | b).sum())


def test_elements_are_counted_a_few_at_a_time(monkeypatch: pytest.MonkeyPatch) -> None:
    truth, predicted = np.random.default_rng(0).integers(0, 9, (2, 1_000_001)).astype(np.uint16)
    at_once = contingency(truth, predicted)
    monkeypatch.setattr(module, "_AT_ONCE", 1 << 12)
    tracemalloc.start()
    try:
        table = contingency(truth, predicted)
        assert tracemalloc.get_traced_memory()[1] < 1_000_000
    finally:
        tracemalloc.stop()
    np.testing.assert_array_equal(table.intersection, at_once.intersection)
    assert table.intersection.sum() == len(truth)


def test_labels_far_apart_are_counted_without_a_table_of_their_range() -> None:
    table = contingency(np.array([0, 2**40, 2**40]), np.array([5, 5, -(2**40)]))
    assert table.truth_ids.tolist() == [0, 2**40] and table.predicted_ids.tolist() == [-(2**40), 5]
    assert table.intersection.tolist() == [[0, 1], [1, 1]]


def test_taking_a_label_out_leaves_its_elements_in_the_areas_of_the_others() -> None:
    table = contingency(np.array([0, 1, 1, 1]), np.array([3, 3, 3, 0])).without(truth=0, predicted=0)
    assert table.predicted_area.tolist() == [3] and table.truth_area.tolist() == [3]
    assert table.iou.tolist() == [[0.5]]


def assert_same(table: Contingency, other: Contingency) -> None:
    for name, counts in vars(other).items():
        np.testing.assert_array_equal(getattr(table, name), counts)


@given(st.lists(st.tuples(_LABELS, _LABELS), max_size=3))
def test_tables_add_up_to_that_of_all_elements(pairs: list[tuple[np.ndarray, np.ndarray]]) -> None:
    nothing = np.zeros(0, np.int64)
    truth, predicted = (np.concatenate([nothing, *(pair[side] for pair in pairs)]) for side in (0, 1))
    assert_same(added_up(contingency(*pair) for pair in pairs), contingency(truth, predicted))


@given(_LABELS, _LABELS)
def test_a_table_of_some_true_labels_is_that_of_their_elements(truth: np.ndarray, predicted: np.ndarray) -> None:
    whole, kept = contingency(truth, predicted), truth > 0
    assert_same(whole.elements_of(whole.truth_ids > 0), contingency(truth[kept], predicted[kept]))


def test_no_elements_give_an_empty_table() -> None:
    table = contingency(np.zeros(0, np.int64), np.zeros(0, np.int64))
    assert table.iou.shape == (0, 0) and table.best_iou().shape == (0,)


def test_labellings_of_different_shapes_are_refused() -> None:
    with pytest.raises(ValueError, match="different shapes"):
        contingency(np.zeros(3, int), np.zeros(4, int))
