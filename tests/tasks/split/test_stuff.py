import numpy as np

from ss_flow.tasks.artifacts import Cameras, PointCloud, PointLabels
from ss_flow.tasks.split.stuff import StuffParams, find_stuff

RNG = np.random.default_rng(0)


def plane(low, high, count: int = 400):
    """Points on an axis-parallel rectangle."""
    return RNG.uniform(low, high, (count, 3))


def kinds(*pieces) -> list[bool]:
    """Which of these pieces of a scene, seen from (0, 0, 1.5), are stuff."""
    places = np.concatenate(pieces).astype(np.float32)
    label = np.repeat(np.arange(1, len(pieces) + 1, dtype=np.int32), [len(p) for p in pieces])
    nothing = np.zeros(0, np.int32)
    labels = PointLabels(label, np.ones(len(label)), len(pieces), nothing, nothing, nothing, np.zeros(0))
    pose = np.eye(4)
    pose[:3, 3] = (0, 0, -1.5)
    cameras = Cameras(("a",), np.array([[8, 8]], np.int32), np.array([[8.0, 8, 4, 4]]), pose[None], True)
    cloud = PointCloud(places, np.zeros((len(places), 3), np.uint8), 1.0, 0.05)
    return find_stuff(cloud, cameras, labels, StuffParams()).tolist()


FLOOR = plane((-2, -2, 0), (2, 2, 0.01), 2000)
WALL = plane((2, -2, 0), (2.01, 2, 2.5), 2000)
TABLE = plane((-1, -0.6, 0.7), (1, 0.6, 0.71))
BOX = plane((-0.2, -0.2, 0.7), (0.2, 0.2, 1.1))
POSTER = plane((1.99, -0.5, 1), (2, 0.5, 1.7))


def test_walls_and_floors_are_stuff_and_what_stands_before_them_is_not():
    assert kinds(FLOOR, WALL, TABLE, BOX, POSTER) == [True, True, False, False, False]


def test_a_table_top_that_the_capture_never_looks_beyond_is_stuff():
    assert kinds(TABLE, BOX) == [True, False]


def test_a_large_thing_that_is_not_flat_is_a_thing():
    hill = plane((-2, -2, 0), (2, 2, 0))
    hill[:, 2] = 0.5 * np.cos(hill[:, 0])
    assert kinds(hill) == [False]
