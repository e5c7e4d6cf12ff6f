import numpy as np

from ss_flow.tasks.split.votes.smoothing import smooth


def row(count):
    """Points in a row, at a distance of 1."""
    return np.stack([np.arange(count), np.zeros(count), np.zeros(count)], axis=1).astype(np.float32)


def apart(distance, count):
    """The spacing of so many points that lie evenly."""
    return np.full(count, distance, np.float32)


def smoothed(labels, contested, rounds=1):
    contested = np.isin(np.arange(len(labels)), contested)
    return smooth(np.array(labels, np.int32), contested, row(len(labels)), apart(1.0, len(labels)), rounds).tolist()


def test_a_contested_point_takes_what_most_of_its_neighbours_carry():
    assert smoothed([1, 1, 1, 0, 2, 2], [3]) == [1, 1, 1, 1, 2, 2]


def test_only_contested_points_change():
    assert smoothed([1, 1, 1, 2, 1, 1, 0], [6]) == [1, 1, 1, 2, 1, 1, 1]


def test_ties_go_to_the_lowest_label_and_unlabelled_neighbours_do_not_count():
    assert smoothed([0, 0, 5, 0, 4, 0, 0], [3]) == [0, 0, 5, 4, 4, 0, 0]


def test_labels_travel_one_reach_a_round():
    assert smoothed([3] + [0] * 9, range(1, 10)) == [3, 3, 3] + [0] * 7
    assert smoothed([3] + [0] * 9, range(1, 10), rounds=2) == [3] * 5 + [0] * 5


def test_points_far_from_all_others_stay_as_they_are():
    label, contested, points = np.array([1, 0, 2], np.int32), np.array([False, True, False]), row(3) * 10
    assert smooth(label, contested, points, apart(1.0, 3), 1).tolist() == [1, 0, 2]
    assert smooth(label[:0], contested[:0], points[:0], apart(0.0, 0), 3).tolist() == []


def test_a_neighbour_may_be_as_far_as_the_point_itself_lies_from_others():
    label, contested, points = np.array([1, 0, 0, 2], np.int32), np.array([False, True, True, False]), row(4) * 3
    spacing = np.array([9.0, 1.0, 2.0, 9.0], np.float32)
    assert smooth(label, contested, points, spacing, 1).tolist() == [1, 0, 2, 2]


def test_many_rounds_give_what_one_round_after_the_other_gives():
    random = np.random.default_rng(0)
    spacing = apart(0.1, 500)
    points = random.random((500, 3)).astype(np.float32)
    label = np.where(random.random(500) < 0.4, random.integers(1, 5, 500), 0).astype(np.int32)
    contested = random.random(500) < 0.7
    step_by_step = label
    for _ in range(6):
        step_by_step = smooth(step_by_step, contested, points, spacing, 1)
    assert (step_by_step != smooth(label, contested, points, spacing, 1)).any()
    assert smooth(label, contested, points, spacing, 6).tolist() == step_by_step.tolist()
