"""Correlation clustering of masks, against loops over points and pairs."""

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.sparse import csr_array

from ss_flow.tasks.artifacts import BORDER, INSIDE, STRAY, Observation, Visibility
from ss_flow.tasks.split.votes.at_once import (
    MaskClusteringParams,
    cluster_masks,
    correlation_clusters,
    evidence,
    membership,
    vote_at_once,
    words_of,
)

SMALL = MaskClusteringParams(min_points=1)
LEFT, RIGHT, WHOLE = range(10), range(10, 20), range(20)


def view(*masks, points=20, standing=INSIDE):
    """A view of all points, with these inside its masks."""
    row = np.concatenate([np.zeros(0, np.int32), *(np.array(mask, np.int32) for mask in masks)])
    return Observation(
        "view",
        np.arange(points, dtype=np.int32),
        np.arange(len(masks), dtype=np.int32),
        np.cumsum([0, *map(len, masks)]).astype(np.int32),
        row,
        np.full(len(row), standing, np.uint8),
    )


def clusters(views, params=SMALL, points=20):
    return [labels.tolist() for labels in cluster_masks(views, points, params)]


def test_masks_of_one_object_get_one_number_in_all_views():
    (left, right), second, third = clusters([view(LEFT, RIGHT), view(RIGHT, LEFT), view(LEFT)])
    assert left != right
    assert second == [right, left]
    assert third == [left]


def test_halves_that_most_views_see_as_a_whole_become_one_object():
    labels = clusters([view(LEFT, RIGHT), *(view(WHOLE) for _ in range(4))])
    assert len({label for of_view in labels for label in of_view}) == 1


def test_a_mask_that_holds_two_objects_does_not_join_them():
    labels = clusters([view(LEFT, RIGHT), view(WHOLE), view(LEFT, RIGHT), view(LEFT, RIGHT)])
    assert labels[0] == labels[2] == labels[3]
    assert labels[0][0] != labels[0][1]


def test_the_rate_decides_about_contradicting_views():
    views = [view(LEFT, RIGHT), view(WHOLE)]
    united = clusters(views, MaskClusteringParams(min_points=1, rate=0.2))
    parted = clusters(views, MaskClusteringParams(min_points=1, rate=0.9))
    assert united == [[1, 1], [1]]
    assert parted[0][0] != parted[0][1]


def test_the_largest_object_comes_first():
    assert clusters([view(range(3), range(3, 20))]) == [[2, 1]]


def test_views_without_masks_and_small_masks_show_nothing():
    assert clusters([view(), view()]) == [[], []]
    some = view(range(4), range(4, 20))
    assert clusters([some], MaskClusteringParams(min_points=5)) == [[0, 1]]
    assert clusters([some] * 4, MaskClusteringParams(min_points=5, max_views=2)) == [[0, 1]] * 4


@st.composite
def scenes(draw):
    """Views of 12 points whose masks are random parts of them, disjoint in each view."""
    owners = draw(st.lists(st.lists(st.integers(-1, 3), min_size=12, max_size=12), min_size=1, max_size=5))
    return [
        view(*(np.flatnonzero(np.array(owner) == m) for m in range(4) if m in owner), points=12) for owner in owners
    ]


@given(scenes())
@settings(deadline=None)
def test_the_evidence_is_the_chance_of_two_points_to_lie_under_one_mask(views):
    masks = [(k, seen.inside(j)) for k, seen in enumerate(views) for j in range(len(seen.mask))]
    assume(masks)
    once = np.ones(len(masks), int)
    together, said = evidence(membership([points for _, points in masks], 12), np.array([k for k, _ in masks]), once)
    together, seen_views = together.toarray(), sorted({k for k, _ in masks})
    for a, (_, first) in enumerate(masks):
        for column, k in enumerate(seen_views):
            under = [p for p in first if any(p in points for other, points in masks if other == k)]
            np.testing.assert_allclose(said[a, column], len(under) / len(first), rtol=1e-6)
        for b, (_, second) in enumerate(masks):
            pairs = [(p, q) for p in first for q in second]
            same = sum(p in points and q in points for p, q in pairs for _, points in masks)
            np.testing.assert_allclose(together[a, b], same / len(pairs), rtol=1e-6, atol=1e-12)


@pytest.mark.parametrize(("least", "beside"), [(0.0, 0.1), (0.2, 0.0)])
def test_a_share_below_the_least_counts_as_nothing(least, beside):
    members = membership([np.arange(10), np.arange(9, 19)], 20)  # of which one point is in both
    _, said = evidence(members, np.array([0, 1]), np.ones(2, int), least)
    np.testing.assert_allclose(said, [[1, beside], [beside, 1]])


def test_the_weight_of_a_union_is_a_mean_over_the_pairs_of_masks():
    # The last mask stands for nine; each says less for a union with the first (0.2) than the second one does (0.5).
    together = csr_array([[1, 0.5, 0.2], [0.5, 1, 0.1], [0.2, 0.1, 1]])
    said = np.array([[0.0], [1.0], [1.0]])
    assert correlation_clusters(together, said, np.array([1, 1, 9]), 1.0).tolist() == [0, 0, 1]


@given(scenes(), st.integers(0, 100))
@settings(deadline=None)
def test_no_two_clusters_are_left_that_belong_together(views, percent):
    masks = [(k, seen.inside(j)) for k, seen in enumerate(views) for j in range(len(seen.mask))]
    assume(masks)
    once = np.ones(len(masks), int)
    together, said = evidence(membership([points for _, points in masks], 12), np.array([k for k, _ in masks]), once)
    cluster = correlation_clusters(together, said, once, percent / 100)
    weight = together.toarray() - percent / 100 * said @ said.T
    for a in range(cluster.max() + 1):
        for b in range(a):
            assert weight[np.ix_(cluster == a, cluster == b)].sum() <= 1e-6


@given(scenes(), st.randoms())
@settings(deadline=None)
def test_neither_the_order_of_views_nor_a_second_copy_changes_a_label(views, random):
    def labelled(some):
        votes, against = vote_at_once(12, some, cluster_masks(some, 12, SMALL), SMALL)
        leader, _ = votes.leaders()
        covered = np.where(votes.weight() > against, leader, 0)
        return covered[:, None] == covered[None]

    shuffled = random.sample(views, len(views))
    np.testing.assert_array_equal(labelled(views), labelled(shuffled))
    np.testing.assert_array_equal(labelled(views), labelled(2 * views))


def test_what_lots_of_views_find_is_clustered_again():
    views = [view(LEFT, RIGHT) for _ in range(12)]
    views[4], views[6] = view(WHOLE), view(RIGHT)
    left, right = clusters(views, MaskClusteringParams(min_points=1, max_views=4))[0]
    for labels, seen in zip(clusters(views, MaskClusteringParams(min_points=1, max_views=4)), views, strict=True):
        if len(seen.mask) == 2:
            assert labels == [left, right]
    assert left != right


def test_points_at_a_border_count_less_and_strays_not_at_all():
    params = MaskClusteringParams(border_vote=0.25, background_vote=0.5)
    for standing, weight in ((INSIDE, 1.0), (BORDER, 0.25), (STRAY, 0.0)):
        votes, against = vote_at_once(20, [view(LEFT, standing=standing)], [np.array([7], np.int32)], params)
        assert votes.weight().tolist() == [weight] * 10 + [0] * 10
        assert against.tolist() == [0] * 10 + [0.5] * 10
    leader, share = vote_at_once(20, [view(LEFT)], [np.array([7], np.int32)], params)[0].leaders()
    assert leader.tolist() == [7] * 10 + [0] * 10 and share.tolist() == [1] * 10 + [0] * 10


def test_a_view_without_masks_says_nothing_against_labels_that_others_give():
    params = MaskClusteringParams(background_vote=0.5)
    views, seven, none = [view(LEFT), view(), view(LEFT)], np.array([7], np.int32), np.zeros(0, np.int32)
    votes, against = vote_at_once(20, views, [seven, none, seven], params)
    assert votes.weight().tolist() == [2] * 10 + [0] * 10
    assert against.tolist() == [0] * 10 + [2 * 0.5] * 10


def at(depth, points=20):
    """All points, seen from one distance."""
    seen = np.arange(points, dtype=np.int32)
    return Visibility("view", seen, seen, np.full(points, depth, np.float32), 4, 5)


def test_a_view_counts_less_from_farther_off_than_the_third_nearest_sees_a_point():
    words = words_of([at(1.0), at(2.0), at(2.01), at(2.7), at(5.6)], 20)
    assert [float(word[0]) for word in words] == [1, 1, 1, 1, 0.25]
    assert all((word == word[0]).all() for word in words)
    assert [word[0] for word in words_of([at(1.0), at(9.0)], 20)] == [1, 1]


def test_a_second_copy_of_a_view_is_no_nearer_one():
    seen = [at(1.0), at(1.1), at(5.0), at(6.0)]
    assert [word[0] for word in words_of(seen, 20)] == [word[0] for word in words_of(seen * 2, 20)][:4] == [1] * 4


def test_far_views_that_do_not_part_what_near_ones_do_join_nothing():
    # Half of the views are near and part paper and desk, which lie under one mask in the others.
    views = [view(range(4), range(4, 20))] * 3 + [view(WHOLE)] * 3
    words = words_of([at(d) for d in (1.0, 1.05, 1.1, 2.2, 2.25, 2.3)], 20)
    alike, weighed = cluster_masks(views, 20, SMALL), cluster_masks(views, 20, SMALL, words)
    assert alike[0][0] == alike[0][1]
    assert weighed[0][0] != weighed[0][1]


def test_a_far_view_votes_less_for_labels_and_against_them():
    params = MaskClusteringParams()
    labels, words = [np.array([7], np.int32)], [np.full(20, 0.25, np.float32)]
    votes, against = vote_at_once(20, [view(LEFT)], labels, params, words)
    assert votes.weight()[0] == 0.25
    assert against[15] == pytest.approx(0.25 * params.background_vote)
