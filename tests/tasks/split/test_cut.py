from dataclasses import replace

import numpy as np
import pytest
from clouds import even_cloud
from hypothesis import given, settings
from hypothesis import strategies as st

from ss_flow.tasks.artifacts import Hierarchy, PointLabels, PointParts
from ss_flow.tasks.split.cut import cut, cut_parts

# 6 = {1, 2} is a thing, 7 = {6, 3} a group; 4 stands alone, label 5 has lost its points.
TREE = Hierarchy(
    np.array([1, 2, 3, 4, 6, 7], np.int32),
    np.array([6, 6, 7, 0, 7, 0], np.int32),
    np.array([1, 1, 1, 1, 0.8, 0.3], np.float32),
    np.zeros(6, bool),
)
LABELS = PointLabels(
    label=np.array([1, 1, 1, 2, 2, 3, 4, 0], np.int32),
    confidence=np.linspace(0, 1, 8, dtype=np.float32),
    num_labels=5,
    match_view=np.array([0, 0, 1, 1], np.int32),
    match_mask=np.array([0, 1, 0, 1], np.int32),
    match_label=np.array([1, 2, 5, 4], np.int32),
)
CLOUD = even_cloud(np.zeros((8, 3), np.float32), np.zeros((8, 3), np.uint8), 1.0, 1.0)


def test_granularity_moves_the_cut_from_parts_to_things_to_groups():
    assert cut(CLOUD, LABELS, TREE, granularity=1.0).label.tolist() == LABELS.label.tolist()
    assert cut(CLOUD, LABELS, TREE, granularity=0.5).label.tolist() == [6, 6, 6, 6, 6, 3, 4, 0]
    assert cut(CLOUD, LABELS, TREE, granularity=0.2).label.tolist() == [7, 7, 7, 7, 7, 7, 4, 0]


def test_masks_follow_their_labels_and_ids_are_those_of_the_tree():
    things = cut(CLOUD, LABELS, TREE, granularity=0.5)
    assert things.match_label.tolist() == [6, 6, 5, 4] and things.num_labels == 7
    assert things.confidence.tolist() == LABELS.confidence.tolist()


def test_a_whole_makes_up_for_a_doubtful_union_in_it_but_not_for_one_that_the_views_deny():
    for weakest, taken in ((0.4, [7, 7, 7, 7, 7, 7, 4, 0]), (0.3, LABELS.label.tolist())):
        odd = Hierarchy(TREE.node, TREE.parent, np.array([1, 1, 1, 1, weakest, 0.8], np.float32), TREE.stuff)
        assert cut(CLOUD, LABELS, odd, granularity=0.5).label.tolist() == taken


def test_parts_are_what_an_instance_is_made_of_the_largest_first():
    parts = PointParts(np.array([1, 0, 0, 0, 0, 2, 1, 0], np.int32))
    things = cut(CLOUD, LABELS, TREE, granularity=0.5)
    # Of instance 6: two points of label 1, two of label 2, and the one that is a part of label 1.
    assert cut_parts(LABELS, parts, things).part.tolist() == [3, 1, 1, 2, 2, 2, 1, 0]


def test_labels_left_as_they_are_keep_their_parts():
    parts = PointParts(np.array([1, 0, 0, 0, 0, 2, 1, 0], np.int32))
    assert cut_parts(LABELS, parts, cut(CLOUD, LABELS, TREE, granularity=1.0)).part.tolist() == parts.part.tolist()


def test_a_piece_of_one_label_is_no_part_of_itself_and_has_the_parts_of_the_label_that_it_holds():
    parts = PointParts(np.array([0, 0, 2, 1, 2, 0, 0, 0], np.int32))
    label = np.array([1, 1, 1, 1, 1, 1, 2, 0], np.int32)
    divided = np.array([8, 8, 9, 9, 9, 9, 2, 0], np.int32)  # label 1, as a board and what hangs on it, or by clicks
    found = cut_parts(replace(LABELS, label=label), parts, replace(LABELS, label=divided, num_labels=9))
    assert found.part.tolist() == [0, 0, 1, 2, 1, 0, 0, 0]


def test_an_instance_of_most_labelled_points_is_warned_of_and_a_background_or_a_wall_of_most_is_not(recwarn):
    most = replace(LABELS, label=np.array([0, 0, 0, 0, 0, 1, 1, 4], np.int32))
    cut(CLOUD, replace(LABELS, label=np.array([0, 0, 0, 0, 0, 1, 2, 4], np.int32)), TREE, granularity=1.0)
    cut(CLOUD, most, replace(TREE, stuff=TREE.node == 1), granularity=1.0)
    assert not recwarn.list
    with pytest.warns(UserWarning, match="Instance 1 holds 67% of the labelled surface"):
        cut(CLOUD, most, replace(TREE, stuff=TREE.node == 4), granularity=1.0)


def test_that_an_instance_is_near_and_so_has_most_points_is_not_warned_of(recwarn):
    most = replace(LABELS, label=np.array([0, 0, 0, 0, 0, 1, 1, 4], np.int32))
    near = replace(CLOUD, spacing=np.where(most.label == 1, 0.5, 1).astype(np.float32))
    cut(near, most, replace(TREE, stuff=TREE.node == 4), granularity=1.0)
    assert not recwarn.list


@given(st.floats(0, 1), st.floats(0, 1))
@settings(deadline=None)
def test_a_lower_granularity_never_takes_apart(a, b):
    fine, coarse = (cut(CLOUD, LABELS, TREE, granularity=g).label for g in (max(a, b), min(a, b)))
    for name in np.unique(fine):
        assert len(np.unique(coarse[fine == name])) == 1
