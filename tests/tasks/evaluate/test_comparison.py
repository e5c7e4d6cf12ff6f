"""Which instances of two results go together."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from ss_flow.tasks.evaluate.comparison import correspondence

_IDS = hnp.arrays(np.uint16, (6, 8), elements=st.integers(0, 5))


@given(st.lists(_IDS, min_size=1, max_size=3), st.permutations([1, 2, 3, 4, 5]))
def test_other_ids_for_the_same_masks_change_nothing(views: list[np.ndarray], ids: list[int]) -> None:
    renamed = np.array([0, *ids], np.uint16)
    found = correspondence((view, renamed[view]) for view in views)
    there = np.setdiff1d(np.unique(views), [0])
    assert found.pairs == {(int(a), int(renamed[a])): 1.0 for a in there}
    assert found.agreement == 1.0
    assert not (found.in_pieces or found.joined or found.only_first or found.only_second)


@given(st.lists(st.tuples(_IDS, _IDS), min_size=1, max_size=3))
def test_exchanging_the_results_exchanges_what_is_told(views: list[tuple[np.ndarray, np.ndarray]]) -> None:
    found, turned = correspondence(views), correspondence((b, a) for a, b in views)
    assert found.in_pieces == turned.joined and found.joined == turned.in_pieces
    assert found.agreement == pytest.approx(turned.agreement)
    assert (found.num_first, found.num_second) == (turned.num_second, turned.num_first)


def test_views_count_together_as_if_they_were_one_image() -> None:
    draw = np.random.default_rng(0)
    views = [(draw.integers(0, 4, (5, 5)), draw.integers(0, 4, (5, 5))) for _ in range(3)]
    whole = correspondence([(np.concatenate([a for a, _ in views]), np.concatenate([b for _, b in views]))])
    assert correspondence(views) == whole


def test_an_object_in_two_halves_is_told_as_in_pieces() -> None:
    first, second = np.zeros((4, 10), int), np.zeros((4, 10), int)
    first[:, :8] = 7
    second[:, :4], second[:, 4:8] = 1, 2
    found = correspondence([(first, second)])
    assert found.in_pieces == {7: (1, 2)} and not found.joined
    assert found.agreement == pytest.approx(0.5 / 2)
    assert found.only_first == () and found.only_second == ()


def test_what_the_other_result_lacks_is_named() -> None:
    first, second = np.zeros((4, 10), int), np.zeros((4, 10), int)
    first[:, :5], second[:, :5] = 3, 9
    first[0, 8] = 4
    found = correspondence([(first, second)])
    assert found.pairs == {(3, 9): 1.0} and found.only_first == (4,) and found.agreement == 0.5


def test_nothing_on_either_side_agrees() -> None:
    assert correspondence([(np.zeros((2, 2), int), np.zeros((2, 2), int))]).agreement == 1.0


def test_images_of_different_sizes_are_refused() -> None:
    with pytest.raises(ValueError, match="different shapes"):
        correspondence([(np.zeros((2, 2), int), np.zeros((3, 2), int))])
