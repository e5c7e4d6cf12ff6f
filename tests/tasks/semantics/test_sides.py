"""Objects that look different from different sides, by an encoder whose vectors are known."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ss_flow.tasks.artifacts import Descriptors
from ss_flow.tasks.semantics import query as module
from ss_flow.tasks.semantics.query import QueryParams, query
from ss_flow.tasks.semantics.sides import sides

SIDES = QueryParams(tau_view=0.3, tau_corr=0.1)


def unit(*directions: tuple[float, ...]) -> np.ndarray:
    vectors = np.array(directions, np.float32)
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def seen(instance_id: int, vectors: np.ndarray, weights: tuple[float, ...] | None = None) -> Descriptors:
    """What `describe` says of an object with these vectors of views."""
    weighed = np.asarray(weights or (1,) * len(vectors), np.float32)
    mean = unit((weighed[:, None] * vectors).sum(axis=0))[0]
    return Descriptors(instance_id, mean, tuple(map(str, range(len(vectors)))), weighed, "directions", vectors)


COVER, BACK = unit((1, 0.1, 0), (1, 0, 0.1)), unit((0, 1, 0.1), (0.1, 1, 0), (0, 1, 0))
BOOK = seen(1, np.concatenate([COVER, BACK]))
PLANT = seen(2, unit((0.8, 0.6, 0.3), (0.8, 0.6, 0.2)))
"""More of the cover's direction than the book's mean has, less than its cover."""


class Directions:
    """A stand-in for CLIP in three dimensions: a word is a direction."""

    name, dimension, sees_masks, absolute = "directions", 3, False, False
    words = {"cover": (1, 0, 0), "back": (0, 1, 0), "thing": (0, 0, 1)}  # noqa: RUF012

    def encode_texts(self, texts):
        return np.array([self.words[text] for text in texts], np.float32)

    def negatives(self, text):
        return ("thing",)


@pytest.fixture
def directions(monkeypatch):
    monkeypatch.setattr(module, "encoder_of", lambda files: Directions())


def test_the_mean_comes_first_and_then_every_side():
    found = sides(BOOK, 0.3)
    np.testing.assert_array_equal(found[0], BOOK.embedding)
    expected = unit(COVER.sum(axis=0), BACK.sum(axis=0))
    np.testing.assert_allclose(sorted(found[1:].tolist()), sorted(expected.tolist()), atol=1e-6)


def test_views_weigh_as_much_in_their_side_as_in_the_mean():
    weights = (5.0, 1.0, 1.0, 1.0, 4.0)
    found = sides(seen(1, BOOK.vectors, weights), 0.3)
    expected = unit(5 * COVER[0] + COVER[1], BACK[0] + BACK[1] + 4 * BACK[2])
    np.testing.assert_allclose(sorted(found[1:].tolist()), sorted(expected.tolist()), atol=1e-6)


def test_an_object_that_looks_the_same_all_round_has_its_mean_alone():
    assert len(sides(PLANT, 0.3)) == len(sides(BOOK, 0.0)) == len(sides(BOOK, 1.5)) == 1
    assert len(sides(seen(3, COVER[:1]), 0.3)) == 1
    nowhere = Descriptors(4, np.zeros(3, np.float32), (), np.zeros(0, np.float32), "x", np.zeros((0, 3), np.float32))
    np.testing.assert_array_equal(sides(nowhere, 0.3), np.zeros((1, 3)))


@given(st.permutations(range(5)))
def test_the_order_of_the_views_changes_no_side(order):
    found = sides(seen(1, BOOK.vectors[order]), 0.3)
    np.testing.assert_allclose(sorted(found[1:].tolist()), sorted(sides(BOOK, 0.3)[1:].tolist()), atol=1e-6)


def test_a_text_finds_the_book_by_its_cover_where_the_mean_misses_it(directions):
    by_mean = query((BOOK, PLANT), text="cover", params=QueryParams(tau_corr=0.1))
    assert by_mean.matches() == [2]
    by_side = query((BOOK, PLANT), text="cover", params=SIDES)
    assert by_side.matches() == [1]
    expected = unit(COVER.sum(axis=0))[0, 0]
    assert by_side.score[0] == pytest.approx(expected, abs=1e-6)
    assert query((BOOK, PLANT), text="back", params=SIDES).matches() == [1]


def test_terms_may_be_met_by_different_sides_and_a_refused_one_by_none(directions):
    back_only = seen(3, BACK)
    cover_only = seen(4, unit((1, 0, 0.3)))  # "thing" fits it more than "back" does
    room = (BOOK, back_only, cover_only)
    assert query(room, text="cover, back", params=SIDES).matches() == [1]
    assert query(room, text="cover, not back", params=SIDES).matches() == [4]
    assert query(room, text="not back", params=SIDES).matches() == [4]


@given(st.lists(st.lists(st.tuples(*[st.floats(0.05, 1)] * 3), min_size=1, max_size=6), max_size=5))
def test_no_object_fits_a_text_less_with_its_sides_than_with_its_mean(objects):
    room = tuple(seen(i, unit(*views)) for i, views in enumerate(objects, start=1))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "encoder_of", lambda files: Directions())
        plain = query(room, text="cover", params=QueryParams(tau_corr=2.0))
        clustered = query(room, text="cover", params=QueryParams(tau_corr=2.0, tau_view=0.1))
    of = {int(i): s for i, s in zip(clustered.instance_id, clustered.score, strict=True)}
    assert all(of[int(i)] >= s - 1e-6 for i, s in zip(plain.instance_id, plain.score, strict=True))
