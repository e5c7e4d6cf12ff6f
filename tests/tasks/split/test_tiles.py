"""Tiles of a floor go to the floor; pictures, mats, and what stands on them do not."""

from __future__ import annotations

import numpy as np
import pytest
from labelled_points import lying

from ss_flow.tasks.artifacts import PointCloud
from ss_flow.tasks.split.tiles import with_tiles
from ss_flow.tasks.split.votes.touching import TouchingParams, borders

STEP = 0.03
SIDE = 0.36
FLOOR = 1


def floor_with(pieces, height=0.0):
    """A floor of 4 x 4 m, label 1, in which pieces (x, y, width, depth) lie, or stand so high; labels 2.. in order."""
    places = lying(4.0, 4.0, step=STEP)
    label = np.full(len(places), FLOOR, np.int32)
    for number, (x, y, width, depth) in enumerate(pieces, 2):
        inside = (np.abs(places[:, 0] - x) < width / 2) & (np.abs(places[:, 1] - y) < depth / 2)
        label[inside], places[inside, 2] = number, height
    return places, label


def tiles(places, label, stuff=(FLOOR,)):
    """Which labels are the floor's then, besides itself."""
    cloud = PointCloud(places.astype(np.float32), np.zeros((len(places), 3), np.uint8), 1.0, STEP)
    surface = np.arange(int(label.max()) + 1, dtype=np.int32)
    names = np.unique(label[label > 0])
    ends = borders(label, cloud, TouchingParams())
    found = with_tiles(cloud, label, surface, ends, np.isin(names, stuff))
    assert found[0] == 0 and set(found.tolist()) <= set(surface.tolist())
    return [name for name in names.tolist() if name != FLOOR and found[name] == FLOOR]


def grid(rows, columns, side=SIDE):
    return [(-1.2 + SIDE * i, -1.2 + SIDE * j, side, side) for i in range(rows) for j in range(columns)]


def test_pieces_of_one_size_in_the_plane_of_a_floor_are_its_tiles():
    assert tiles(*floor_with(grid(3, 3))) == list(range(2, 11))


@pytest.mark.parametrize(("count", "found"), [(7, 0), (8, 8)])
def test_a_few_of_one_size_are_mats(count, found):
    assert len(tiles(*floor_with(grid(3, 3)[:count]))) == found


def test_pieces_of_all_sizes_are_none():
    odd = [(-1.5 + 0.75 * (k % 5), -1 + k // 5, 0.22 * 1.12**k, 0.22 * 1.12**k) for k in range(8)]
    assert tiles(*floor_with(odd)) == []


def test_as_many_carpets_are_none():
    assert tiles(*floor_with([(-1.5 + i, -0.5 + j, 0.9, 0.9) for i in range(4) for j in range(2)])) == []


def test_pieces_of_no_stuff_are_none():
    assert tiles(*floor_with(grid(3, 3)), stuff=()) == []


def test_what_rises_from_the_floor_is_none():
    assert tiles(*floor_with(grid(3, 3), height=0.2)) == []


def test_half_a_tile_is_one_and_a_rug_among_them_is_none():
    half, rug = (1.4, -1.2, SIDE / 2, SIDE), (0.9, 1.0, 1.2, 0.8)
    assert tiles(*floor_with([*grid(3, 3), half, rug])) == list(range(2, 12))


@pytest.mark.parametrize(("slope", "found"), [(2.0, False), (0.0, True)])
def test_what_touches_something_that_rises_along_much_of_its_border_is_none(slope, found):
    """As the mat below a bowl."""
    places, label = floor_with([*grid(3, 3), (1.4, -1.2, SIDE, SIDE)])
    mat, bowl = 11, 12
    away = np.abs(places[:, :2] - (1.4, -1.2)).max(axis=1)
    label[(away < 0.75 * SIDE) & (label == FLOOR)] = bowl
    places[label == bowl, 2] = slope * (away[label == bowl] - SIDE / 2)
    assert [name for name in tiles(places, label) if name != bowl] == [*range(2, 11), *([mat] if found else [])]


def test_surfaces_of_several_labels_go_as_one():
    places, label = floor_with(grid(3, 3))
    left = (label == 2) & (places[:, 0] < -1.2)
    label[left] = 11
    cloud = PointCloud(places.astype(np.float32), np.zeros((len(places), 3), np.uint8), 1.0, STEP)
    surface = np.arange(12, dtype=np.int32)
    surface[11] = 2
    ends = borders(label, cloud, TouchingParams())
    assert with_tiles(cloud, label, surface, ends, np.arange(9 + 1) == 0).tolist() == [0, *[FLOOR] * 11]
