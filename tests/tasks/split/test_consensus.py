import numpy as np

from ss_flow.tasks.artifacts import INSIDE, Observation
from ss_flow.tasks.split.consensus import ConsensusParams, merge_labels

LEFT, RIGHT, WHOLE = range(10), range(10, 20), range(20)


def view(*masks):
    """A view of 21 points, with these points inside its masks."""
    row = np.concatenate([np.array(mask, np.int32) for mask in masks])
    return Observation(
        "view",
        np.arange(21, dtype=np.int32),
        np.arange(len(masks), dtype=np.int32),
        np.cumsum([0, *map(len, masks)]).astype(np.int32),
        row,
        np.full(len(row), INSIDE, np.uint8),
    )


def labels():
    return np.array([4] * 10 + [7] * 10 + [0], np.int32)


def test_labels_that_the_views_hold_together_take_the_lower_number():
    merged = merge_labels(labels(), [view(WHOLE)] * 3, ConsensusParams())
    assert merged.tolist() == [4] * 20 + [0]


def test_labels_stay_apart_with_too_few_views_or_against_the_views():
    assert merge_labels(labels(), [view(WHOLE)] * 2, ConsensusParams()).tolist() == labels().tolist()
    mixed = [view(WHOLE)] * 3 + [view(LEFT, RIGHT)]
    assert merge_labels(labels(), mixed, ConsensusParams()).tolist() == labels().tolist()
    assert set(merge_labels(labels(), mixed, ConsensusParams(rate=0.7))) == {4, 0}


def test_a_view_that_sees_too_little_of_a_label_has_no_say():
    glimpse = view(range(8, 12))  # two points of each label
    assert merge_labels(labels(), [glimpse] * 5, ConsensusParams()).tolist() == labels().tolist()
