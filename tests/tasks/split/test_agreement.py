"""How often views show pieces as one thing, by hand: pieces of 100 points, of which the first two are asked about."""

import numpy as np
import pytest

from ss_flow.tasks.artifacts import Tally
from ss_flow.tasks.split.agreement import View, agreement_of, views_of


def view(*masks: tuple[tuple[int, int, int], float], seen: tuple[int, int, int] = (100, 100, 100)) -> View:
    """A view of three pieces and its masks: (points of each piece, quality)."""
    held = np.array([points for points, _ in masks], np.float32).reshape(len(masks), 3)
    return View(np.array(seen, np.float32), held, np.array([quality for _, quality in masks]))


def agreement(*views: View, silent: float = 0.3) -> float:
    pair = np.array([[1, 1, 0]], np.float32)
    return float(agreement_of(views, pair, doubt=0.2, silent=silent, prior=0.0, prior_agreement=0.0)[0])


@pytest.mark.parametrize(("beside", "expected"), [(29, 0.25), (31, 1.0)])
def test_a_mask_is_a_pieces_own_from_an_iou_of_three_quarters_on(beside, expected):
    # With a doubt of 0.2, a quarter of the agreement remains beside an own mask that is surer by 0.15.
    both, surer = ((100, 90, 0), 0.8), ((0, 90, beside), 0.95)
    assert agreement(view(both, surer, seen=(100, 90, 100))) == pytest.approx(expected)


def test_a_surer_mask_of_the_largest_piece_says_half_as_much_against_the_whole():
    whole, largest, smaller = ((100, 90, 0), 0.8), ((100, 0, 0), 0.95), ((0, 90, 0), 0.85)
    assert agreement(view(whole, largest, seen=(100, 90, 100))) == pytest.approx(1 - 0.15 / 0.2 / 2)
    assert agreement(view(whole, smaller, seen=(100, 90, 100))) == pytest.approx(1 - 0.05 / 0.2)
    assert agreement(view(whole, largest, smaller, seen=(100, 90, 100))) == pytest.approx(1 - 0.15 / 0.2 / 2)


@pytest.mark.parametrize(("points", "weight"), [(50, 1.0), (12, 1.0), (5, 0.5)])
def test_a_view_that_sees_little_of_a_piece_counts_little(points, weight):
    shows, denies = view(((100, 100, 0), 0.9)), view(((100 - points, 0, 0), 0.9), seen=(100 - points, points, 0))
    assert agreement(shows, denies) == pytest.approx(1 / (1 + weight))


@pytest.mark.parametrize(("held", "expected"), [(60, 0.75), (40, 2 / 3 * 0.25)])
def test_a_mask_shows_two_pieces_the_better_the_more_it_holds_of_the_smaller(held, expected):
    # 60 of 100 points are three quarters of the way from 30 to 70; the IoU of 160 / 200 is enough, that of 0.7 is not.
    assert agreement(view(((100, held, 0), 0.9))) == pytest.approx(expected)


SILENT = {
    "no mask": (),
    "a mask of all things": (((100, 100, 201), 0.9),),
    "a mask of less than half of each": (((49, 49, 0), 0.9),),
    "a mask of something else": (((0, 0, 100), 0.9),),
}
SPEAKS = {
    "a piece's own": (((100, 0, 0), 0.9),),
    "half of a piece": (((0, 50, 0), 0.9),),
    "one and as much beside it": (((100, 0, 100), 0.9),),
}


@pytest.mark.parametrize("masks", [*SILENT.values(), *SPEAKS.values()], ids=[*SILENT, *SPEAKS])
def test_a_view_without_a_mask_that_lies_on_the_pieces_says_little_against_them(masks):
    shows, weight = view(((100, 100, 0), 0.9)), 0.3 if masks in SILENT.values() else 1.0
    assert agreement(shows, view(*masks)) == pytest.approx(1 / (1 + weight))
    assert agreement(shows, view(*masks), silent=1.0) == pytest.approx(1 / 2)
    assert agreement(view(*masks)) == 0  # that none says anything makes nothing one


def tally(label: list[int], seen: list[int], held: list[list[int]], quality: list[float]) -> Tally:
    numbers = (np.array(of, np.int32) for of in (label, seen, held))
    return Tally("a", *numbers, np.zeros((len(label), len(label)), np.int32), np.array(quality, np.float32))


def test_a_view_sees_nothing_of_pieces_that_its_tally_lacks_nor_of_those_that_do_not_count():
    (found,) = views_of(np.array([1, 2, 3], np.int32), [tally([1, 3], [5, 7], [[4, 6]], [0.9])])
    assert found.seen.tolist() == [5, 0, 7] and found.held.tolist() == [[4, 0, 6]]
    only = found.only(np.array([True, True, False]))
    assert only.seen.tolist() == [5, 0, 0] and only.held.tolist() == [[4, 0, 0]]


def test_a_view_with_the_same_points_and_masks_in_whatever_order_says_nothing_more():
    def count(*changes) -> int:
        return len(views_of(np.array([1, 2], np.int32), [tally([1, 2], *of) for of in (once, changes)]))

    once = [9, 9], [[9, 0], [0, 9]], [0.9, 0.8]
    assert count([9, 9], [[0, 9], [9, 0]], [0.8, 0.9]) == 1
    assert count([9, 10], [[9, 0], [0, 9]], [0.9, 0.8]) == 2
    assert count([9, 9], [[9, 0], [0, 9]], [0.9, 0.7]) == 2
