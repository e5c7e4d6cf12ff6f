"""Labels of points, painted into a view, against the masks that should show them."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from ss_flow.tasks.masks.painting import PaintedView, agreement, agreements

H, W = 6, 7


@given(st.integers(0, 2**32 - 1))
def test_the_agreements_of_all_labels_at_once_are_those_of_each(seed):
    rng = np.random.default_rng(seed)
    ids = rng.integers(0, 4, (H, W)).astype(np.int32)
    pixel = np.flatnonzero(rng.random(H * W) < 0.5).astype(np.int32)
    areas = rng.integers(1, 5, len(pixel)).astype(np.float32)
    painted = PaintedView(pixel, rng.integers(0, 5, len(pixel)).astype(np.int32), areas)
    labels = np.array([1, 2, 3, 4, 9], np.int32)  # 4 has no mask, 9 occurs nowhere
    expected = [agreement(painted, ids == label, label) for label in labels.tolist()]
    np.testing.assert_array_equal(agreements(painted, ids, labels), expected)
