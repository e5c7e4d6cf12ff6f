"""How often views show pieces as one thing, by hand: pieces of 100 points, of which the first two are asked about."""

import numpy as np
import pytest

from ss_flow.tasks.split.agreement import View, agreement_of


def view(*masks: tuple[tuple[int, int, int], float], seen: tuple[int, int, int] = (100, 100, 100)) -> View:
    """A view of three pieces and its masks: (points of each piece, quality)."""
    held = np.array([points for points, _ in masks], np.float32).reshape(len(masks), 3)
    return View(np.array(seen, np.float32), held, np.array([quality for _, quality in masks]))


def agreement(*views: View) -> float:
    pair = np.array([[1, 1, 0]], np.float32)
    return float(agreement_of(views, pair, doubt=0.2, prior=0.0, prior_agreement=0.0)[0])


@pytest.mark.parametrize(("beside", "expected"), [(30, 0.25), (40, 1.0)])
def test_a_mask_is_a_pieces_own_from_an_iou_of_three_quarters_on(beside, expected):
    # With a doubt of 0.2, a quarter of the agreement remains beside an own mask that is surer by 0.15.
    both, surer = ((100, 100, 0), 0.8), ((100, 0, beside), 0.95)
    assert agreement(view(both, surer)) == pytest.approx(expected)


@pytest.mark.parametrize(("points", "weight"), [(50, 1.0), (12, 1.0), (5, 0.5)])
def test_a_view_that_sees_little_of_a_piece_counts_little(points, weight):
    shows, denies = view(((100, 100, 0), 0.9)), view(((100 - points, 0, 0), 0.9), seen=(100 - points, points, 0))
    assert agreement(shows, denies) == pytest.approx(1 / (1 + weight))
