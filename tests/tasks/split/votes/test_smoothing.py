import numpy as np

from ss_flow.tasks.split.votes.smoothing import smooth


def row(count):
    """Points in a row, at a distance of 1."""
    return np.stack([np.arange(count), np.zeros(count), np.zeros(count)], axis=1).astype(np.float32)


def smoothed(labels, contested, rounds=1):
    contested = np.isin(np.arange(len(labels)), contested)
    return smooth(np.array(labels, np.int32), contested, row(len(labels)), 1.0, rounds).tolist()


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
    points = row(3) * 10
    assert smooth(np.array([1, 0, 2], np.int32), np.array([False, True, False]), points, 1.0, 1).tolist() == [1, 0, 2]
    assert smooth(np.zeros(0, np.int32), np.zeros(0, bool), np.zeros((0, 3), np.float32), 0.0, 3).tolist() == []


def test_many_rounds_give_what_one_round_after_the_other_gives():
    random = np.random.default_rng(0)
    points = random.random((500, 3)).astype(np.float32)
    label = np.where(random.random(500) < 0.4, random.integers(1, 5, 500), 0).astype(np.int32)
    contested = random.random(500) < 0.7
    step_by_step = label
    for _ in range(6):
        step_by_step = smooth(step_by_step, contested, points, 0.1, 1)
    assert (step_by_step != smooth(label, contested, points, 0.1, 1)).any()
    assert smooth(label, contested, points, 0.1, 6).tolist() == step_by_step.tolist()
