"""Parts of objects, from views made by hand."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from box_scene import mask_set
from hypothesis import given, settings
from hypothesis import strategies as st

from ss_flow.tasks.artifacts import BORDER, INSIDE, STRAY, Observation, PointLabels
from ss_flow.tasks.split.parts import PartsParams, find_parts

CUP, SHELF = [1] * 30, [2] * 40
HANDLE, BODY, WHOLE = range(12), range(12, 30), range(30)
UPPER, LOWER, FRAME = range(30, 40), range(40, 55), range(55, 70)
LABEL = CUP + SHELF


@dataclass(frozen=True)
class Mask:
    """A mask of a view: the points that it owns, the label that it was matched to, and the mask around it."""

    points: range | list[int]
    label: int = 1
    parent: int = -1
    standing: int = INSIDE


def parts_of(views: dict[str, list[Mask]], label=LABEL, params=None) -> list[int]:
    """The part of each point, by views that have these masks, from large to small."""
    observations, pools, matched = [], [], []
    for k, (name, masks) in enumerate(views.items()):
        points = np.array(sorted({p for mask in masks for p in mask.points}), np.int32)
        rows = [np.searchsorted(points, list(mask.points)).astype(np.int32) for mask in masks]
        observations.append(
            Observation(
                name,
                points,
                np.arange(len(masks), dtype=np.int32),
                np.cumsum([0, *map(len, rows)]).astype(np.int32),
                np.concatenate([np.zeros(0, np.int32), *rows]),
                np.repeat(np.array([mask.standing for mask in masks], np.uint8), [len(row) for row in rows]),
            )
        )
        parent = np.array([mask.parent for mask in masks], np.int32)
        pools.append(replace(mask_set(np.zeros((len(masks), 1, 1), bool), name), parent=parent))
        matched += [(k, j, mask.label) for j, mask in enumerate(masks) if mask.label]
    view, mask, shown = np.array(matched, np.int32).reshape(-1, 3).T
    labels = PointLabels(np.array(label, np.int32), np.ones(len(label), np.float32), 2, view, mask, shown)
    return find_parts(observations, pools, labels, params=params or PartsParams()).part.tolist()


PLAIN = [Mask(WHOLE)]
WITH_HANDLE = [Mask(BODY), Mask(HANDLE, parent=0)]
ONLY_HANDLE = [1] * 12 + [0] * 58
NONE = [0] * 70


def test_a_mask_inside_another_one_of_its_object_shows_a_part():
    assert parts_of({"a": WITH_HANDLE, "b": WITH_HANDLE}) == ONLY_HANDLE


def test_half_of_the_views_of_a_point_are_enough_for_a_part_and_fewer_are_not():
    views = {"a": WITH_HANDLE, "b": WITH_HANDLE, "c": PLAIN, "d": PLAIN}
    assert parts_of(views) == ONLY_HANDLE
    assert parts_of(views | {"e": PLAIN}) == NONE
    assert parts_of(views | {"e": PLAIN}, params=PartsParams(tau_part=0.4)) == ONLY_HANDLE


@pytest.mark.parametrize(
    "blind",
    [[], [Mask(BODY)], [Mask(WHOLE, label=2)], [Mask(WHOLE, label=0)], [Mask(WHOLE, standing=STRAY)]],
    ids=["no masks", "out of sight", "another object", "no object", "strayed"],
)
def test_views_that_do_not_see_a_point_under_a_mask_of_its_object_have_no_say(blind):
    assert parts_of({"a": WITH_HANDLE, "b": WITH_HANDLE, "c": blind, "d": blind, "e": blind}) == ONLY_HANDLE


def test_a_part_that_one_view_shows_does_not_count():
    assert parts_of({"a": WITH_HANDLE}) == NONE
    assert parts_of({"a": WITH_HANDLE, "b": PLAIN}) == NONE
    assert parts_of({"a": WITH_HANDLE}, params=PartsParams(min_views=1)) == ONLY_HANDLE


def test_a_part_of_few_points_does_not_count():
    small = [Mask(range(9, 30)), Mask(range(9), parent=0)]
    assert parts_of({"a": small, "b": small}) == NONE
    assert parts_of({"a": small, "b": small}, params=PartsParams(min_points=9)) == [1] * 9 + [0] * 61


def test_a_mask_inside_one_of_another_object_shows_no_part():
    on_shelf = [Mask(range(30, 70), label=2), Mask(WHOLE, parent=0)]
    assert parts_of({"a": on_shelf, "b": on_shelf}) == NONE


def test_a_mask_in_between_that_shows_nothing_is_passed_over():
    rim = [Mask(BODY), Mask([], label=0, parent=0), Mask(HANDLE, parent=1)]
    assert parts_of({"a": rim, "b": rim}) == ONLY_HANDLE


def test_parts_are_numbered_within_each_object_from_the_largest_on():
    shelf = [Mask(FRAME, 2), Mask(LOWER, 2, parent=0), Mask(UPPER, 2, parent=0)]
    cup = [Mask(BODY), Mask(HANDLE, parent=3)]
    views = {"a": [*shelf, *cup], "b": [*shelf, *cup]}
    assert parts_of(views) == [1] * 12 + [0] * 18 + [2] * 10 + [1] * 15 + [0] * 15


def test_a_part_is_as_large_as_all_views_together_show_it():
    rest = [Mask([*range(30, 37), *range(64, 70)], 2), Mask(range(37, 49), 2, parent=0)]
    left, right = Mask(range(49, 59), 2, parent=0), Mask(range(54, 64), 2, parent=0)
    found = parts_of({"a": [*rest, left], "b": [*rest, left], "c": [*rest, right], "d": [*rest, right]})
    assert found == [0] * 37 + [2] * 12 + [1] * 15 + [0] * 6


def test_masks_of_a_part_that_differ_a_little_show_one_part():
    wider = [Mask(range(14, 30)), Mask(range(14), parent=0)]
    cut = [Mask(range(10, 30)), Mask(range(10), parent=0)]
    assert parts_of({"a": WITH_HANDLE, "b": wider, "c": cut}) == ONLY_HANDLE


def test_a_point_under_two_masks_of_its_object_belongs_to_the_smaller():
    both = [Mask(WHOLE), Mask(HANDLE, parent=0)]
    assert parts_of({"a": both, "b": both}) == ONLY_HANDLE


def test_points_at_the_border_of_a_part_belong_to_it():
    rim = [Mask(BODY), Mask(range(10), parent=0), Mask(range(10, 12), parent=0, standing=BORDER)]
    assert parts_of({"a": WITH_HANDLE, "b": WITH_HANDLE, "c": rim}) == ONLY_HANDLE
    border = [Mask(BODY), Mask(HANDLE, parent=0, standing=BORDER)]
    assert parts_of({"a": border, "b": border}) == ONLY_HANDLE


@st.composite
def scenes(draw):
    """Up to five views of twelve points, under masks in masks in masks."""
    views = {}
    for name in "abcde"[: draw(st.integers(0, 5))]:
        owner = draw(st.lists(st.integers(-1, 3), min_size=12, max_size=12))
        label = draw(st.lists(st.sampled_from([1, 1, 1, 1, 2, 0]), min_size=4, max_size=4))
        views[name] = [
            Mask([p for p in range(12) if owner[p] == j], label[j], parent) for j, parent in enumerate((-1, 0, 0, 1))
        ]
    return views, draw(st.lists(st.sampled_from([1, 1, 1, 1, 2, 0]), min_size=12, max_size=12))


@given(scenes(), st.randoms())
@settings(deadline=None)
def test_the_order_of_views_does_not_matter_and_what_has_no_label_has_no_part(scene, random):
    views, label = scene
    params = PartsParams(min_points=1, tau_part=0.3)
    found = parts_of(views, label, params)
    order = random.sample(list(views), len(views))
    assert parts_of({name: views[name] for name in order}, label, params) == found
    assert not any(part for part, of in zip(found, label, strict=True) if of == 0)
    for of in (1, 2):
        sizes = np.bincount([part for part, own in zip(found, label, strict=True) if own == of])[1:]
        assert (sizes > 0).all() and (np.diff(sizes) <= 0).all()


def test_without_views_or_points_there_are_no_parts():
    assert parts_of({}) == NONE
    assert parts_of({}, label=[]) == []
