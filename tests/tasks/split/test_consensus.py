import numpy as np

from ss_flow.tasks.split.consensus import ConsensusParams, cluster_masks, merge_labels
from ss_flow.tasks.split.observation import MaskPoints

LEFT, RIGHT, WHOLE = range(10), range(10, 20), range(20)


def view(*masks):
    return [
        MaskPoints(i, np.array(mask, np.int32), np.array(mask, np.int32), len(mask)) for i, mask in enumerate(masks)
    ]


def test_masks_of_one_object_get_one_number_in_all_views():
    objects = cluster_masks([view(LEFT, RIGHT), view(RIGHT, LEFT), view(LEFT)], 20, ConsensusParams())
    left, right = objects[0]
    assert left != right
    assert objects[1].tolist() == [right, left]
    assert objects[2].tolist() == [left]


def test_a_mask_that_most_views_split_belongs_to_no_object():
    views = [view(LEFT, RIGHT), view(WHOLE), view(LEFT, RIGHT), view(LEFT, RIGHT)]
    objects = cluster_masks(views, 20, ConsensusParams())
    assert objects[1].tolist() == [0]
    assert objects[0].tolist() == objects[2].tolist() == objects[3].tolist()
    assert 0 not in objects[0]


def test_halves_that_most_views_see_as_a_whole_become_one_object():
    views = [view(LEFT, RIGHT), *(view(WHOLE) for _ in range(12))]
    objects = cluster_masks(views, 20, ConsensusParams())
    assert len({int(label) for labels in objects for label in labels}) == 1


def test_the_order_of_views_changes_only_the_numbers():
    views = [view(LEFT, RIGHT), view(WHOLE), view(LEFT, RIGHT), view(RIGHT), view(LEFT, RIGHT)]
    forward = cluster_masks(views, 20, ConsensusParams())
    backward = cluster_masks(views[::-1], 20, ConsensusParams())[::-1]
    a, b = np.concatenate(forward), np.concatenate(backward)
    assert ((a[:, None] == a[None]) == (b[:, None] == b[None])).all()


def test_views_without_masks_have_no_objects():
    assert [o.tolist() for o in cluster_masks([[], []], 5, ConsensusParams())] == [[], []]
    assert [o.tolist() for o in cluster_masks([[], view(range(3))], 5, ConsensusParams())] == [[], [1]]


def test_masks_that_contradict_each_other_everywhere_form_no_object():
    # Each mask is cut in two by the masks of the other view.
    views = [view(range(20), range(20, 40)), view([*range(10), *range(20, 30)], [*range(10, 20), *range(30, 40)])]
    params = ConsensusParams(split=0.3)
    assert [o.tolist() for o in cluster_masks(views, 40, params)] == [[0, 0], [0, 0]]


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
