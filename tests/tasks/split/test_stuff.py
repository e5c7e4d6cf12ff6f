import numpy as np
from clouds import even_cloud
from labelled_points import labels_of, one_camera

from ss_flow.tasks.split.stuff import StuffParams, find_stuff

RNG = np.random.default_rng(0)


def plane(low, high, count: int = 400):
    """Points on an axis-parallel rectangle."""
    return RNG.uniform(low, high, (count, 3))


def kinds(*pieces, **values) -> list[bool]:
    """Which of these pieces of a scene, seen from (0, 0, 1.5), are stuff."""
    places = np.concatenate(pieces).astype(np.float32)
    label = np.repeat(np.arange(1, len(pieces) + 1, dtype=np.int32), [len(p) for p in pieces])
    pose = np.eye(4)
    pose[:3, 3] = (0, 0, -1.5)
    cloud = even_cloud(places, np.zeros((len(places), 3), np.uint8), 1.0, 0.05)
    return find_stuff(cloud, one_camera(pose), labels_of(label), StuffParams(**values)).tolist()


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


OTHER_WALL = plane((-2, 2, 0), (2, 2.01, 2.5), 2000)
CORNER = np.concatenate([WALL, OTHER_WALL])


def test_two_walls_that_are_one_piece_are_stuff():
    assert kinds(FLOOR, CORNER, TABLE) == [True, True, False]
    assert kinds(FLOOR, CORNER, TABLE, planes=1) == [True, False, False]
    assert kinds(np.concatenate([FLOOR, CORNER]), TABLE, planes=2) == [False, False]
    assert kinds(np.concatenate([FLOOR, CORNER]), TABLE, planes=3) == [True, False]


def test_two_sides_of_a_cabinet_with_the_room_behind_it_are_a_thing():
    sides = plane((-1, -1, 0), (1, -0.99, 1.5)), plane((0.99, -1, 0), (1, 1, 1.5))
    assert kinds(FLOOR, CORNER, np.concatenate(sides)) == [True, True, False]


def test_a_wall_and_a_thing_before_it_in_one_piece_are_no_stuff():
    assert kinds(FLOOR, np.concatenate([WALL, plane((1, -1, 0), (1.01, 1, 1.5), 1500)])) == [True, False]


def test_strays_all_over_a_wall_make_no_wall_of_a_picture():
    strays = plane((1.99, -2, 0), (2, 2, 2.5), 40)
    assert kinds(FLOOR, WALL, np.concatenate([POSTER, strays])) == [True, True, False]
    assert kinds(FLOOR, WALL, np.concatenate([POSTER, *[strays] * 10])) == [True, True, True]


def test_a_few_points_are_no_wall_however_far_apart():
    share = np.linspace(0, 1, 9)
    few = np.stack([4 * share - 2, np.full(9, 2.0), 2.5 * (4 * share % 1)], axis=1)
    assert kinds(FLOOR, few) == [True, False]
    assert kinds(FLOOR, np.concatenate([few, [[0, 2, 1]]])) == [True, True]
