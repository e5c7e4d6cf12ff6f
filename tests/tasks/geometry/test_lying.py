"""Photos that lie on their side are found out by their poses, and none that stand are."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ss_flow.tasks.geometry.cameras import looking, up_of
from ss_flow.tasks.geometry.lying import quarter_turns

UP = np.array([0.0, 0.0, 1.0])


def at(eye, target=(0, 0, 0)):
    forward = np.array(target, float) - eye
    return looking(np.array(eye, float), forward / np.linalg.norm(forward), UP)


def orbit(height, end=2 * np.pi, count=30):
    return [at((2 * np.cos(a), 2 * np.sin(a), height)) for a in np.linspace(0, end, count, endpoint=False)]


def stored(poses, turns):
    """The cameras of upright photos that are stored so that they must be turned so many quarters, counterclockwise."""
    roll = np.eye(4)
    roll[:3, :3] = Rotation.from_euler("z", 90 * turns, degrees=True).as_matrix()
    return roll @ np.array(poses)


def shaken(poses, degrees):
    rng = np.random.default_rng(0)
    shakes = np.tile(np.eye(4), (len(poses), 1, 1))
    shakes[:, :3, :3] = Rotation.from_rotvec(np.radians(degrees) * rng.normal(size=(len(poses), 3))).as_matrix()
    return list(shakes @ np.array(poses))


def walk():
    ways = [(np.cos(0.3 * k), np.sin(0.3 * k)) for k in range(60)]
    return [at((0.1 * k, 0, 1.6), (0.1 * k + x, y, 1.2)) for k, (x, y) in enumerate(ways)]


@pytest.mark.parametrize("turns", [1, 3])
@pytest.mark.parametrize(
    "poses",
    [orbit(0.8), shaken(orbit(0.8), 5), orbit(0.8, end=1.5), [*orbit(0.4, np.pi), *orbit(1.5, np.pi)], walk()],
    ids=["round a thing", "by a shaky hand", "a quarter of the way", "from two heights", "through rooms"],
)
def test_photos_that_lie_are_turned_the_right_way(poses, turns):
    lying = stored(poses, turns)
    assert quarter_turns(lying) == turns
    np.testing.assert_allclose(up_of(lying), up_of(np.array(poses)), atol=1e-9)


def test_a_stored_photo_that_is_turned_has_its_upright_cameras_axes():
    """Of a photo that is to be turned once, counterclockwise, the right edge is its upper edge then."""
    (lying,) = stored([at((2, 0, 0))], 1)
    assert lying[0, :3] @ UP == pytest.approx(1)


@pytest.mark.parametrize(
    "poses",
    [
        orbit(0.8),
        shaken(orbit(0.8), 10),
        orbit(-1.0),
        [at((2 * np.cos(a), 0.1, 2 * np.sin(a))) for a in np.linspace(-0.3, 1.2, 20)],
        [at((x, -2, 0.5), (x, 0, 0)) for x in np.linspace(-1, 1, 20)],
        [at((0.3 * np.cos(a), 0.3 * np.sin(a), 2)) for a in np.linspace(0, 6.2, 30)],
        walk(),
        orbit(0.8)[:1],
        [],
    ],
    ids=["round", "shaky", "from below", "over the top", "along", "straight down", "walk", "one view", "none"],
)
def test_photos_that_stand_stay(poses):
    poses = np.array(poses).reshape(-1, 4, 4)
    assert quarter_turns(poses) == 0
    # Nor are those that are upside down: they may as well look up.
    assert quarter_turns(stored(poses, 2)) == 0


def test_where_the_plumb_line_is_not_clear_photos_stay():
    level = orbit(0.0)  # looks neither down nor up, so that either side may be the upper one
    all_ways = [
        at((2 * np.cos(a) * np.cos(e), 2 * np.sin(a) * np.cos(e), 2 * np.sin(e)))
        for e in (-0.9, -0.3, 0.3, 0.9)
        for a in np.linspace(0, 6.2, 8)
    ]
    for poses in (level, all_ways, orbit(0.8, end=0.3)):
        assert quarter_turns(stored(poses, 1)) == 0
