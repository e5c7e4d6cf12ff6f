"""Outlines drawn by hand: polygons and label images tell the same."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from outlines import read_outlines

SQUARE = [[2, 1], [6, 1], [6, 5], [2, 5]]
HOLE = [[3, 2], [5, 2], [5, 4], [3, 4]]


@pytest.fixture
def polygons(tmp_path):
    """Two views: a ring and a bar, and the bar alone."""
    file = tmp_path / "capture.json"
    bar = [[[8, 0], [9, 0], [9, 7], [8, 7]]]
    views = {"a": {"ring": [SQUARE, HOLE], "bar": bar}, "b": {"bar": bar}}
    file.write_text(json.dumps({"width": 10, "height": 8, "views": views}))
    return read_outlines(file)


def test_a_polygon_inside_another_is_a_hole(polygons):
    ring = np.zeros((8, 10), bool)
    ring[1:6, 2:7] = True
    ring[3, 4] = False  # the pixels on the border of the hole belong to the object
    np.testing.assert_array_equal(polygons.views["a"] == 1, ring)


def test_an_object_has_one_number_in_all_views(polygons):
    assert polygons.names == {1: "ring", 2: "bar"}
    assert np.unique(polygons.views["b"]).tolist() == [0, 2]
    np.testing.assert_array_equal(polygons.views["a"] == 2, polygons.views["b"] == 2)


def test_label_images_tell_the_same(polygons, tmp_path):
    for view, ids in polygons.views.items():
        cv2.imwrite(str(tmp_path / f"{view}.png"), ids.astype(np.uint8))
    read = read_outlines(tmp_path)
    assert read.names == {1: "1", 2: "2"}
    for view, ids in polygons.views.items():
        np.testing.assert_array_equal(read.views[view], ids)


def test_a_frame_of_another_size_has_the_same_objects(polygons):
    np.testing.assert_array_equal(polygons.at_size("a", 16, 20)[::2, ::2], polygons.views["a"])
    assert polygons.at_size("c", 8, 10) is None


def test_the_office_names_things_over_views():
    office = read_outlines(Path(__file__).parents[2] / "bench" / "outlines" / "hololens_office.json")
    seen = {name: sum((ids == i).sum() >= 100 for ids in office.views.values()) for i, name in office.names.items()}
    assert min(seen.values()) >= 1  # each object has area in some view
    assert sum(count >= 2 for count in seen.values()) >= 20  # and most hold their name over several
