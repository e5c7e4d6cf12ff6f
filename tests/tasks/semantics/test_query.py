import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ss_flow.errors import InputError
from ss_flow.tasks.artifacts import Descriptors, PartDescriptors
from ss_flow.tasks.models.colour_words import TERMS
from ss_flow.tasks.semantics import query as module
from ss_flow.tasks.semantics.query import QueryParams, Similarity, chosen, query, similarity, terms


def descriptor(instance_id: int, embedding, encoder: str = "colour words") -> Descriptors:
    vector = np.asarray(embedding, np.float32)
    return Descriptors(instance_id, vector, ("0",), np.ones(1, np.float32), encoder, vector[None])


def coloured(instance_id: int, **share: float) -> Descriptors:
    p = np.zeros(len(TERMS))
    for term, value in share.items():
        p[TERMS.index(term)] = value
    return descriptor(instance_id, np.sqrt(p))


ROOM = (
    coloured(1, grey=0.8, white=0.2),
    coloured(2, red=0.6, brown=0.4),
    coloured(3, blue=1.0),
    coloured(4, red=0.95, orange=0.05),
    coloured(5, brown=0.6, red=0.4),
)


class Directions:
    """A stand-in for CLIP in three dimensions: a word is a direction."""

    name, dimension, sees_masks, absolute = "directions", 3, False, False
    words = {  # noqa: RUF012
        "east": (1, 0, 0), "north": (0, 1, 0), "up": (0, 0, 1), "an image of a east": (0, 1, 0),
        "north-east": (0.5**0.5, 0.5**0.5, 0),
    }  # fmt: skip

    def encode_texts(self, texts):
        return np.array([self.words[text] for text in texts], np.float32)

    def negatives(self, text):
        return ("up",)


@pytest.fixture
def directions(monkeypatch):
    monkeypatch.setattr(module, "encoder_of", lambda files: Directions())


def at_degrees(instance_id: int, angle: float, height: float = 0.0) -> Descriptors:
    a = np.radians(angle)
    vector = np.array([np.cos(a), np.sin(a), height])
    return descriptor(instance_id, vector / np.linalg.norm(vector), "directions")


def test_red_finds_the_red_objects_and_no_others():
    found = query(ROOM, text="the crimson thing")
    assert found.matches() == [4, 2] and found.accepted


def test_what_matches_is_an_answer_though_another_object_that_the_text_does_not_fit_has_a_higher_score():
    ids, scores, relevancies = np.array([6, 4], np.int32), np.float32([0.541, 0.53]), np.float32([0.26, 0.53])
    found = chosen(Similarity("red and blue", "colour words", True, ids, scores, relevancies, 0 * ids))
    assert found.instance_id.tolist() == [6, 4] and found.matches() == [4] and found.accepted


def test_parts_are_ranked_each_by_itself():
    parts = [PartDescriptors(**vars(d), part_id=p) for p, d in ((2, coloured(4, blue=1.0)), (1, coloured(4, red=1.0)))]
    found = query((*parts, coloured(2, red=1.0)), text="red")
    assert list(zip(found.instance_id.tolist(), found.part_id.tolist(), strict=True)) == [(2, 0), (4, 1), (4, 2)]
    assert found.matched.tolist() == [1, 1, 0]


def test_a_colour_that_nothing_has_matches_nothing():
    found = query(ROOM, text="purple")
    assert found.matches() == [] and not found.accepted


def test_two_colours_find_what_has_both():
    room = (*ROOM, coloured(6, red=0.5, white=0.5))
    assert query(room, text="red and white").instance_id[0] == 6


def test_a_text_without_a_colour_is_refused():
    with pytest.raises(InputError, match="names no colour"):
        query(ROOM, text="the mug")


def test_scores_margins_and_deltas_are_as_worked_out_by_hand(directions):
    found = query((at_degrees(8, 60), at_degrees(5, 0), at_degrees(2, 90)), text="east")
    assert found.instance_id.tolist() == [5, 8, 2]
    np.testing.assert_allclose(found.score, [1, 0.5, 0], atol=1e-6)
    np.testing.assert_allclose(found.margin, [0.5, 0.5, 0], atol=1e-6)
    np.testing.assert_allclose(found.delta, [0, 0.5, 1], atol=1e-6)
    np.testing.assert_allclose(found.relevancy, [1 / (1 + np.exp(-10)), 1 / (1 + np.exp(-5)), 0.5], atol=1e-6)


def test_an_instance_matches_when_its_distance_is_near_the_best(directions):
    room = (at_degrees(1, 10), at_degrees(2, 14), at_degrees(3, 30))
    assert query(room, text="east", params=QueryParams(tau_corr=0.02)).matches() == [1, 2]
    assert query(room, text="east", params=QueryParams(tau_corr=0.005)).matches() == [1]
    assert query(room, text="east", params=QueryParams(tau_corr=0.2)).matches() == [1, 2, 3]


def test_delta_must_be_below_tau_corr_and_not_equal(directions):
    room = (at_degrees(1, 0), at_degrees(2, 90))
    assert query(room, text="east", params=QueryParams(tau_corr=1.0)).matches() == [1]


def test_a_background_that_fits_best_leaves_the_objects_their_matches_unless_it_is_asked_for(directions):
    room = (at_degrees(0, 0), at_degrees(1, 10), at_degrees(2, 14), at_degrees(3, 30))
    found = query(room, text="east", params=QueryParams(tau_corr=0.005))
    assert (found.instance_id.tolist(), found.matches(), found.delta[0]) == ([1, 2, 3], [1], 0)
    asked = query(room, text="east", params=QueryParams(tau_corr=0.005), background=True)
    assert (asked.instance_id.tolist(), asked.matches()) == ([0, 1, 2, 3], [0])


def test_a_text_that_only_the_background_fits_matches_nothing():
    found = query((coloured(0, white=1.0), *ROOM[1:]), text="white")
    assert found.matches() == [] and not found.accepted


def test_what_fits_a_negative_better_does_not_match(directions):
    room = (at_degrees(1, 0, height=1.2), at_degrees(2, 0, height=1.3))
    found = query(room, text="east", params=QueryParams(tau_corr=0.5))
    assert found.matches() == [] and not found.accepted and (found.relevancy < 0.5).all()
    untested = query(room, text="east", params=QueryParams(tau_corr=0.5, min_relevancy=0.0))
    assert untested.matches() == [1, 2] and untested.accepted


def test_without_the_test_of_relevancy_missing_descriptors_and_other_colours_still_do_not_match(
    directions, monkeypatch
):
    untested = QueryParams(min_relevancy=0.0)
    room = (at_degrees(1, 0), descriptor(2, np.zeros(3), "directions"))
    assert query(room, text="east", params=untested).matches() == [1]
    monkeypatch.undo()
    assert query(ROOM, text="red", params=untested).matches() == query(ROOM, text="red").matches()


def test_a_prompt_without_a_place_for_the_text_is_refused():
    with pytest.raises(InputError, match=r"has no \{text\} in it"):
        similarity(ROOM, text="red", prompt="an image")
    with pytest.raises(InputError, match=r"has no \{text\} in it"):
        QueryParams(prompt="an image")


def test_the_prompt_wraps_the_text(monkeypatch):
    class Prompted(Directions):
        def negatives(self, text):
            return ()

    monkeypatch.setattr(module, "encoder_of", lambda files: Prompted())
    room = (at_degrees(1, 0), at_degrees(2, 90))
    assert query(room, text="east", params=QueryParams(prompt="an image of a {text}")).matches() == [2]


def test_an_instance_without_a_descriptor_comes_last_and_never_matches():
    found = query((descriptor(9, np.zeros(11)), *ROOM), text="red")
    assert found.instance_id[-1] == 9 and found.score[-1] == -1 and found.relevancy[-1] == 0
    assert 9 not in found.matches()


def test_equal_scores_are_ranked_by_id():
    room = tuple(coloured(i, red=1.0) for i in (5, 3, 4))
    assert query(room, text="red").instance_id.tolist() == [3, 4, 5]


@given(st.permutations(range(len(ROOM))))
def test_the_order_of_the_descriptors_changes_nothing(order):
    shuffled, straight = query(tuple(ROOM[i] for i in order), text="red"), query(ROOM, text="red")
    for field in ("instance_id", "score", "margin", "delta", "relevancy", "matched"):
        np.testing.assert_array_equal(getattr(shuffled, field), getattr(straight, field))


def test_a_scene_without_instances_matches_nothing():
    found = query((), text="red")
    assert found.matches() == [] and not found.accepted and len(found.score) == 0


@pytest.mark.parametrize("text", ["", "  "])
def test_an_empty_text_is_refused(text):
    with pytest.raises(InputError, match="query is empty"):
        query(ROOM, text=text)


def test_a_tau_that_matches_nothing_is_refused():
    with pytest.raises(InputError, match="tau_corr is 0"):
        query(ROOM, text="red", params=QueryParams(tau_corr=0))


def test_descriptors_of_another_encoder_are_refused():
    with pytest.raises(InputError, match="made by clip-b16"):
        query((descriptor(1, np.ones(11), "clip-b16"),), text="red")


@pytest.mark.parametrize(
    ("text", "wanted", "unwanted"),
    [
        ("red mug", ("red mug",), ()),
        ("red mug, not the lamp", ("red mug",), ("the lamp",)),
        ("Not the wall", (), ("the wall",)),
        ("a mug but not red, wooden", ("a mug", "wooden"), ("red",)),
        ("knot, a notebook", ("knot", "a notebook"), ()),
        ("forget-me-not vase, but not-red", ("forget-me-not vase", "but not-red"), ()),
        ("cup not red not blue", ("cup",), ("red", "blue")),
    ],
)
def test_a_text_is_taken_apart_into_what_is_meant_and_what_is_not(text, wanted, unwanted):
    assert terms(text) == (wanted, unwanted)


@pytest.mark.parametrize("text", ["red, not", "not", "cup not, red"])
def test_a_not_that_nothing_follows_is_refused(text):
    with pytest.raises(InputError, match='nothing follows "not"'):
        query(ROOM, text=text)


def test_of_several_terms_all_must_fit_and_the_least_counts(directions):
    room = (at_degrees(1, 0), at_degrees(2, 45), at_degrees(3, 90))
    found = query(room, text="east, north", params=QueryParams(tau_corr=2.0))
    assert found.instance_id[0] == 2
    np.testing.assert_allclose(found.score, [0.5**0.5, 0, 0], atol=1e-6)
    assert found.matches() == [2]


def test_what_is_not_meant_counts_against_what_is(directions):
    room = (at_degrees(1, 5), at_degrees(2, 60))
    everything = QueryParams(tau_corr=2.0)
    assert query(room, text="east", params=everything).matches() == [1, 2]
    found = query(room, text="east, not north", params=everything)
    assert found.matches() == [1]
    # exp(10 cos 60) / (exp(10 cos 60) + exp(10 cos 30))
    assert found.relevancy[1] == pytest.approx(1 / (1 + np.exp(10 * (np.sqrt(3) / 2 - 0.5))), abs=1e-6)


def test_a_text_of_only_what_is_not_meant_finds_all_the_rest(directions):
    room = (at_degrees(1, 0), at_degrees(2, 120), at_degrees(3, 0, height=3.0))
    found = query(room, text="not east")
    assert found.matches() == [2, 3] and found.instance_id.tolist() == [2, 3, 1]


def test_with_colour_words_not_red_is_what_is_not_mostly_red():
    assert sorted(query(ROOM, text="not red").matches()) == [1, 3, 5]


def test_topk_takes_the_best_few_that_fit(directions):
    room = (at_degrees(1, 40), at_degrees(2, 0), at_degrees(3, 20), at_degrees(4, 0, height=5.0))
    for count, expected in ((1, [2]), (2, [2, 3]), (9, [2, 3, 1])):
        assert query(room, text="east", params=QueryParams(select="topk", top_k=count)).matches() == expected


def test_topk_with_colour_words_takes_the_best_few_of_that_colour():
    assert query(ROOM, text="red", params=QueryParams(select="topk", top_k=1)).matches() == [4]


def test_a_search_is_the_choice_among_similarities():
    found = similarity(ROOM, text="red")
    assert found.instance_id.tolist() == [1, 2, 3, 4, 5]
    ours, theirs = chosen(found, params=QueryParams()), query(ROOM, text="red")
    assert ours.matches() == theirs.matches() and np.array_equal(ours.score, theirs.score)
