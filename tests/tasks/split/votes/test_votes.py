import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from ss_flow.tasks.split.votes.votes import Votes


@settings(deadline=None)
@given(st.lists(st.tuples(st.sets(st.integers(0, 7)), st.integers(1, 12), st.integers(1, 4)), max_size=30))
def test_votes_agree_with_a_dense_matrix(rounds):
    votes, dense = Votes(8), np.zeros((8, 13))
    for points, label, weight in rounds:
        rows = np.array(sorted(points), np.int32)
        assert (votes.fresh(rows) == (dense[rows].sum(axis=1) == 0)).all()
        votes.add(rows, label, np.full(len(rows), float(weight)))
        dense[rows, label] += weight
    leader, share = votes.leaders()
    assert leader.tolist() == dense.argmax(axis=1).tolist()
    total = dense.sum(axis=1)
    np.testing.assert_allclose(share, dense.max(axis=1) / np.where(total > 0, total, 1))


def test_a_tie_goes_to_the_lowest_label_whatever_came_first():
    votes = Votes(1)
    point = np.zeros(1, np.int32)
    votes.add(point, 5, np.ones(1))
    votes.add(point, 2, np.ones(1))
    assert votes.leaders()[0].tolist() == [2]
    assert votes.leaders(point)[1].tolist() == [0.5]
