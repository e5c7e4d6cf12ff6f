"""Photos from one place are told from those of a walk by their matches alone."""

from __future__ import annotations

import numpy as np
import pytest

from ss_flow.errors import InputError
from ss_flow.tasks.capture.features import Features
from ss_flow.tasks.capture.matches import Matches
from ss_flow.tasks.capture.sfm import sfm
from ss_flow.tasks.capture.turning import explained_by_turning, refuse_turning

WIDTH, HEIGHT, FOCAL = 400, 300, 350.0
NOTHING = np.zeros((0, 128), np.uint8)
Taken = tuple[list[Features], list[Matches]]


def taken(eyes: np.ndarray, degrees: np.ndarray, scene: np.ndarray) -> Taken:
    """Photos from [K, 3] places, turned about the vertical, and the matches of each with all before it, one of
    twenty-five wrong. scene: [N, 3] points."""
    rng = np.random.default_rng(0)
    photos, visible, matches = [], [], []
    for row, (eye, angle) in enumerate(zip(eyes, np.radians(degrees), strict=True)):
        turn = np.array([[np.cos(angle), 0, -np.sin(angle)], [0, 1, 0], [np.sin(angle), 0, np.cos(angle)]])
        x, y, z = ((scene - eye) @ turn.T).T
        pixels = np.stack([x, y], 1) * FOCAL / np.maximum(z, 1e-3)[:, None] + [WIDTH / 2, HEIGHT / 2]
        pixels += rng.normal(0, 0.3, pixels.shape)
        inside = (pixels > 0).all(axis=1) & (pixels < [WIDTH, HEIGHT]).all(axis=1) & (z > 0.1)
        astray = rng.random(len(pixels)) < 0.02
        pixels[astray] = rng.uniform(0, [WIDTH, HEIGHT], (astray.sum(), 2))
        photos.append(Features(str(row), WIDTH, HEIGHT, pixels.astype(np.float32), NOTHING))
        common = [np.flatnonzero(inside & other) for other in visible]
        first = np.cumsum([0, *map(len, common)])
        pair = np.concatenate([np.zeros(0, int), *common]).repeat(2).reshape(-1, 2)
        shape = np.zeros(row, np.int32), np.zeros((row, 3, 3))
        matches.append(Matches(str(row), tuple(map(str, range(row))), *shape, first, pair))
        visible.append(inside)
    return photos, matches


def room(depth: float = 2.0) -> np.ndarray:
    """Points between 2 and 2 + depth metres around the origin."""
    rng = np.random.default_rng(1)
    angle, distance = rng.uniform(0, 2 * np.pi, 4000), 2 + depth * rng.random(4000)
    return np.stack([distance * np.sin(angle), rng.uniform(-1, 1, 4000), distance * np.cos(angle)], 1)


def spin(jitter: float) -> Taken:
    """Twelve photos all around; their places differ by so many metres."""
    places = np.random.default_rng(2).normal(0, jitter / np.sqrt(3), (12, 3))
    return taken(places, np.arange(12) * 30.0, room())


def walk(scene: np.ndarray, step: float, turn: float = 0.0) -> Taken:
    return taken(np.arange(8)[:, None] * [step, 0, 0], np.arange(8) * turn, scene)


@pytest.mark.parametrize("jitter", [0.0, 0.01])
def test_photos_from_one_place_are_refused_with_the_share_that_a_turn_explains(jitter: float) -> None:
    photos, matches = spin(jitter)
    with pytest.raises(InputError, match=r"turning the camera explains [89][0-9]% of .* from one place") as refusal:
        refuse_turning(photos, matches)
    assert "\n" not in str(refusal.value)
    with pytest.raises(InputError, match="from one place"):
        sfm(photos, tuple(matches), ())


def wall() -> np.ndarray:
    """A flat one, 2 m away, as long as the walk."""
    rng = np.random.default_rng(3)
    return np.stack([rng.uniform(-2, 8, 4000), rng.uniform(-1, 1, 4000), np.full(4000, 2.0)], 1)


@pytest.mark.parametrize(
    "photos",
    [spin(0.3), walk(room(), 0.15), walk(room(), 0.15, turn=10), walk(wall(), 0.6)],
    ids=["an arm's length around", "a walk", "a walk that turns", "a walk along a wall"],
)
def test_a_walk_is_not_taken_for_a_turn(photos: Taken) -> None:
    assert explained_by_turning(*photos) < 0.6
    refuse_turning(*photos)


def test_neighbouring_frames_of_a_video_tell_nothing() -> None:
    """A centimetre from frame to frame, each matched with one: a turn explains that, yet there is depth."""
    photos, matches = walk(room(), 0.01)
    assert explained_by_turning(photos, matches) == 0


def test_too_few_matches_tell_nothing() -> None:
    photos, matches = spin(0)
    assert explained_by_turning(photos[:2], matches) == explained_by_turning([], []) == 0
