"""What a view without depth sees by colour."""

import numpy as np
import pytest
from clouds import even_cloud

from ss_flow.tasks.artifacts import Cameras, ColourTransform, DepthMap, Frame
from ss_flow.tasks.geometry.cameras import camera_of
from ss_flow.tasks.geometry.images import encode_png
from ss_flow.tasks.geometry.visibility import VisibilityParams
from ss_flow.tasks.split.visibility import visibility
from ss_flow.tasks.split.visible_by_color import visible_by_color

RED, GREEN = (200, 30, 30), (30, 160, 60)
WIDTH, HEIGHT, SPACING = 16, 8, 0.05


@pytest.fixture
def looks():
    """Look at points with a camera at the origin, whose photo is red on the left and green on the right."""
    lens = np.array([[16.0, 16.0, 8.0, 4.0]])
    camera = camera_of(Cameras(("a",), np.array([[WIDTH, HEIGHT]], np.int32), lens, np.eye(4)[None], True), 0)
    photo = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    photo[:, :8], photo[:, 8:] = RED, GREEN
    frame = Frame("a", WIDTH, HEIGHT, encode_png(photo), np.zeros(0, np.uint8), WIDTH, HEIGHT)

    def look(points, colors, depth=None, color=8.0, frame=frame, colours=()):
        cloud = even_cloud(np.asarray(points, np.float32), np.asarray(colors, np.uint8), 1.0, SPACING)
        known = DepthMap("a", np.zeros((HEIGHT, WIDTH), np.float32) if depth is None else depth, "sensor")
        seen = visibility(cloud, camera, known, params=VisibilityParams())
        return visible_by_color(cloud, camera, known, frame, seen, colours, color=color)

    return look


LEFT, RIGHT = [-0.25, 0.0, 1.0], [0.25, 0.0, 1.0]


def test_a_point_is_seen_where_the_photo_has_its_colour(looks):
    seen = looks([LEFT, RIGHT], [RED, RED])
    assert seen.point_index.tolist() == [0]
    assert seen.pixel.tolist() == [4 * WIDTH + 4]
    assert seen.depth.tolist() == [1.0]


def test_nearly_its_colour_is_enough(looks):
    other = np.add(RED, [6, 0, 0])
    assert len(looks([LEFT], [other], color=8.0).pixel) == 1
    assert len(looks([LEFT], [other], color=1.0).pixel) == 0


def test_a_darker_photo_is_compared_in_the_colours_of_the_scene(looks):
    brighter = ColourTransform("a", "b", np.concatenate([1.2 * np.eye(3), np.zeros((3, 1))], axis=1))
    scene = np.multiply(RED, 1.2)
    assert len(looks([LEFT], [scene]).pixel) == 0
    assert len(looks([LEFT], [scene], colours=(brighter,)).pixel) == 1


def test_one_pixel_beside_its_colour_is_enough(looks):
    at_the_step, farther = [0.03, 0, 1.0], [0.1, 0, 1.0]  # columns 8 and 9; the last red one is 7
    assert looks([at_the_step, farther], [RED, RED]).point_index.tolist() == [0]


def test_what_lies_behind_another_point_is_not_seen(looks):
    behind = [-0.5, 0.0, 2.0]  # in the same pixel as LEFT
    assert looks([behind, LEFT], [RED, RED]).point_index.tolist() == [1]
    assert looks([behind], [RED]).point_index.tolist() == [0]


def test_a_point_that_the_view_measures_hides_what_lies_behind_it(looks):
    depth = np.zeros((HEIGHT, WIDTH), np.float32)
    depth[4, 4] = 1.0
    beside = [-0.3, 0.0, 1.5]  # column 4.8, in the next pixel to the left of the middle: 4
    beside_unknown = [-0.32, 0.1, 1.5]  # row 5, which has no depth
    assert looks([LEFT, beside, beside_unknown], [GREEN, RED, RED], depth).point_index.tolist() == [0]


def test_where_depth_is_known_colour_adds_nothing(looks):
    depth = np.full((HEIGHT, WIDTH), 3.0, np.float32)
    assert not len(looks([LEFT, RIGHT], [RED, GREEN], depth).pixel)


def test_pixels_that_are_not_valid_show_nothing(looks):
    valid = np.full((HEIGHT, WIDTH), 255, np.uint8)
    valid[4, 12] = 0
    photo = np.full((HEIGHT, WIDTH, 3), RED, np.uint8)
    frame = Frame("a", WIDTH, HEIGHT, encode_png(photo), encode_png(valid), WIDTH, HEIGHT)
    assert looks([LEFT, RIGHT], [RED, RED], frame=frame).point_index.tolist() == [0]


def test_rows_stay_in_order(looks):
    depth = np.zeros((HEIGHT, WIDTH), np.float32)
    depth[4, 12] = 1.0
    points = [[-0.25, 0.1, 1.0], RIGHT, [-0.25, -0.1, 1.0]]
    seen = looks(points, [RED, GREEN, RED], depth)
    assert seen.point_index.tolist() == [0, 1, 2]
    assert seen.pixel.tolist() == [5 * WIDTH + 4, 4 * WIDTH + 12, 2 * WIDTH + 4]
