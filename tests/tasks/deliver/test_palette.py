import itertools

import numpy as np

from ss_flow.tasks.deliver.palette import BACKGROUND, depth_colors, instance_color, instance_colors, paint_ids, turbo
from ss_flow.tasks.models.colour_words import _lab


def test_a_color_does_not_depend_on_how_many_there_are():
    np.testing.assert_array_equal(instance_colors(5), instance_colors(90)[:5])
    assert instance_color(17) == tuple(instance_colors(18)[17])
    assert instance_color(0) == BACKGROUND


def test_the_first_forty_colors_can_be_told_apart():
    lab = _lab(instance_colors(41))
    apart = [np.linalg.norm(a - b) for a, b in itertools.combinations(lab, 2)]
    assert min(apart) > 5
    assert all(np.linalg.norm(a - b) > 40 for a, b in itertools.pairwise(lab[1:]))


def test_ids_are_painted_in_their_colors_with_light_borders():
    ids = np.zeros((9, 12), np.int32)
    ids[:, 6:] = 3
    picture = paint_ids(ids)
    assert tuple(picture[4, 2]) == BACKGROUND and tuple(picture[4, 9]) == instance_color(3)
    assert (picture[:, 6] == 245).all()


def test_over_a_photo_objects_are_tinted_and_the_rest_stays():
    ids = np.zeros((9, 12), np.int32)
    ids[:, 6:] = 1
    photo = np.full((9, 12, 3), 100, np.uint8)
    picture = paint_ids(ids, photo, 0.5)
    np.testing.assert_array_equal(picture[4, 2], [80, 80, 80])
    np.testing.assert_allclose(picture[4, 9], (100 + np.array(instance_color(1))) / 2, atol=1)


def test_near_depth_is_red_far_is_blue_and_unknown_is_dark():
    depth = np.linspace(1, 3, 1000, dtype=np.float32).reshape(20, 50)
    depth[0, 0] = 0
    colors, low, high = depth_colors(depth)
    assert tuple(colors[0, 0]) == (34, 34, 34)
    assert colors[0, 5, 0] > colors[0, 5, 2] and (colors[-1, -1] == turbo()[0]).all()
    assert 1.0 < low < 1.05 and 2.95 < high < 3.0


def test_a_depth_map_without_any_depth_has_a_picture_too():
    colors, low, high = depth_colors(np.zeros((4, 4), np.float32))
    assert (colors == 34).all() and low < high
