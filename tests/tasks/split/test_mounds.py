from dataclasses import replace

import numpy as np
import pytest
from clouds import even_cloud
from labelled_points import labels_of, lying, one_camera

from ss_flow.tasks.artifacts import Tally
from ss_flow.tasks.split.mounds import Mounds, find_mounds
from ss_flow.tasks.split.votes.touching import TouchingParams, borders

STEP = 0.02
BEIGE, RED = (200, 180, 150), (150, 20, 40)


SEAT = lying(1.2, 0.8, step=STEP)
HOLE = (np.abs(SEAT[:, :2]) < 0.15).all(axis=1)


def mounds(
    places: np.ndarray, label: np.ndarray, color: tuple[int, int, int], asked: float, spacing=STEP, noise=0.0
) -> Mounds:
    """Of a beige label 1 and label 2 in a colour, which meet each other alone, seen from above."""
    pose = np.diag([1.0, -1, -1, 1])
    pose[:3, 3] = (0, 0, 2)
    both = np.array([1, 2], np.int32)
    beside = np.array([[0, 40], [40, 0]], np.int32)
    seen = Tally("a", both, np.bincount(label)[1:].astype(np.int32), np.zeros((0, 2), np.int32), beside, np.zeros(0))
    cloud = even_cloud(places.astype(np.float32), np.array([BEIGE, color], np.uint8)[label - 1], 1.0, STEP)
    ends = borders(label, cloud, TouchingParams())
    cloud = replace(cloud, spacing=np.full_like(cloud.spacing, spacing), noise=noise)
    return find_mounds(cloud, one_camera(pose), labels_of(label), [seen], ends, around=0.8, height=asked)


def on_seat(
    height: float, color: tuple[int, int, int], asked: float = 0.09, spacing: float = STEP, noise: float = 0.0
) -> Mounds:
    """A beige seat (label 1), seen from above, with something of this height and colour in the middle (label 2).

    asked: share of its extent from which it stands there.
    """
    top = lying(0.3, 0.3, height, STEP)
    steps = np.arange(STEP, height, STEP)
    rim = top[(np.abs(top[:, :2]) > 0.13).any(axis=1)]
    sides = np.concatenate([np.zeros((0, 3)), *(rim * (1, 1, 0) + (0, 0, z) for z in steps)])
    places = np.concatenate([SEAT[~HOLE], top, sides]).astype(np.float32)
    label = np.repeat(np.array([1, 2], np.int32), [(~HOLE).sum(), len(top) + len(sides)])
    return mounds(places, label, color, asked, spacing, noise)


@pytest.mark.parametrize(
    ("height", "color", "stands"),
    [(0.0, RED, False), (0.12, BEIGE, False), (0.12, RED, True), (0.3, BEIGE, True), (0.3, RED, True)],
)
def test_a_bag_on_a_seat_stands_on_it_and_a_patch_sewn_on_or_a_fold_of_it_does_not(height, color, stands):
    assert on_seat(height, color).standing([0, 1]).tolist() == [False, stands]


@pytest.mark.parametrize(("height", "stands"), [(0.1, False), (0.14, True)])
def test_what_has_other_colours_still_rises_by_two_thirds_of_what_is_asked(height, stands):
    assert on_seat(height, RED, asked=0.3).standing([0, 1]).tolist() == [False, stands]


@pytest.mark.parametrize(("spacing", "rises"), [(0.03, True), (0.07, False)])
def test_what_rises_by_less_than_two_spacings_may_be_noise(spacing, rises):
    assert on_seat(0.12, RED, asked=0.0, spacing=spacing).bulges.tolist() == [False, rises]


@pytest.mark.parametrize(("noise", "rises"), [(0.01, True), (0.04, False)])
def test_what_rises_by_less_than_twice_the_noise_of_the_depth_at_two_metres_may_be_noise(noise, rises):
    assert on_seat(0.12, RED, asked=0.0, noise=noise).bulges.tolist() == [False, rises]


def test_a_hump_that_rises_without_an_edge_does_not_stand_on_what_is_round_it():
    away = np.linalg.norm(SEAT[:, :2], axis=1)
    hump = SEAT + np.where(away < 0.2, 0.1 * np.cos(np.pi * away / 0.4) ** 2, 0)[:, None] * (0, 0, 1)
    found = mounds(hump, np.where(away < 0.2, 2, 1).astype(np.int32), RED, 0.09)
    assert not found.bulges.any() and found.share.tolist() == [[0, 1], [1, 0]]


def test_nothing_stands_on_something_smaller_or_on_what_does_not_surround_it():
    share, bulges = np.array([[0, 1], [1, 0]], float), np.array([True, True])
    assert Mounds(share, np.array([100, 40], np.int32), bulges, 0.8).standing([0, 1]).tolist() == [False, True]
    assert Mounds(share, np.array([100, 60], np.int32), bulges, 0.8).standing([0, 1]).tolist() == [False, False]
    assert Mounds(0.7 * share, np.array([100, 40], np.int32), bulges, 0.8).standing([0, 1]).tolist() == [False, False]
