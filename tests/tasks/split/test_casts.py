import numpy as np
import pytest
from flat_patches import BROWN, GREY, RED, SHADE, WHITE, Patch, patch, scene
from labelled_points import labels_of

from ss_flow.tasks.artifacts import Tally
from ss_flow.tasks.split.casts import find_casts
from ss_flow.tasks.split.hierarchy import HierarchyParams, hierarchy
from ss_flow.tasks.split.votes.touching import TouchingParams, borders


def casts(*patches: Patch, stuff: tuple[int, ...] = (1,), together: tuple[int, ...] = ()) -> list[int]:
    """Which of these patches, 1.., are shadows on those that are stuff; some are one surface."""
    cloud, _, label = scene(*patches)
    surface = np.arange(len(patches) + 1, dtype=np.int32)
    surface[list(together)] = min(together, default=0)
    names = np.unique(surface[1:])
    found = find_casts(cloud, label, surface, borders(label, cloud, TouchingParams()), np.isin(names, stuff))
    return names[found].tolist()


WALL = patch(WHITE, 0, 0)
THING = patch(RED, 0.7, 0)


def test_a_shadow_that_lies_in_a_wall_is_one():
    assert casts(WALL, patch(WHITE * SHADE, 0.5, 0, width=0.2), THING) == [2]
    assert casts(patch(WHITE * SHADE, 0.5, 0, width=0.2), WALL, THING, stuff=(2,)) == [1]


def test_a_shadow_on_a_thing_is_none():
    assert casts(WALL, patch(WHITE * SHADE, 0.5, 0, width=0.2), THING, stuff=()) == []
    assert casts(WALL, patch(WHITE * SHADE, 0.5, 0, width=0.2), THING, stuff=(3,)) == []


@pytest.mark.parametrize("color", [BROWN, RED, WHITE * 0.9, WHITE * 0.05, GREY / WHITE.mean() * (1.4, 0.9, 0.7)])
def test_what_has_another_colour_or_hardly_another_or_is_black_is_none(color):
    assert casts(WALL, patch(color, 0.5, 0, width=0.2), THING) == []


def test_what_leaves_the_wall_is_none():
    places, colors = patch(WHITE * SHADE, 0.5, 0, width=0.2)
    for slope, found in ((0.0, [2]), (0.1, [2]), (0.6, [])):
        rising = places + np.array([0.0, 0, slope]) * (places[:, :1] - 0.5)
        assert casts(WALL, (rising, colors), THING) == found


def test_what_touches_the_wall_along_a_small_part_of_its_border_is_none():
    shadow, beside = patch(WHITE * SHADE, 0.5, 0, width=0.6), patch(RED, 1.1, 0)
    assert casts(WALL, shadow, beside) == [2]
    assert casts(WALL, shadow, beside, patch(RED, 0.5, 0.5, width=0.6), patch(RED, 0.5, -0.5, width=0.6)) == []


def test_a_print_of_two_shades_is_none():
    dark, light = (patch(WHITE * SHADE * by, 0.5, 0, width=0.2) for by in (0.7, 1.4))
    places, colors = dark
    odd = np.arange(len(places)) % 2 == 1
    assert casts(WALL, (places, np.where(odd[:, None], light[1], colors)), THING) == []


def test_a_grey_mat_alone_on_a_floor_is_none():
    assert casts(WALL, patch(WHITE * SHADE, 0.5, 0, width=0.2)) == []


def test_pieces_of_one_surface_are_one_shadow():
    pieces = patch(WHITE * SHADE, 0.5, 0, width=0.1), patch(WHITE * SHADE, 0.6, 0, width=0.1)
    assert casts(WALL, *pieces, THING) == [2]  # the second hardly touches the wall
    assert casts(WALL, *pieces, THING, together=(2, 3)) == [2]


def test_nothing_casts_nothing():
    assert casts(patch(WHITE, 0, 0), stuff=()) == []


@pytest.mark.parametrize(("color", "united"), [(WHITE * SHADE, set()), (BROWN, {4})])
def test_a_thing_and_its_shadow_are_not_one_though_every_view_shows_them_so(color, united):
    cloud, cameras, label = scene(patch(WHITE, 0, 0, width=2), patch(color, 2, 0, width=0.2), patch(RED, 2.2, 0))
    names = np.arange(1, 4, dtype=np.int32)
    seen, held = np.full(3, 100, np.int32), np.array([[100, 0, 0], [0, 100, 100]], np.int32)
    view = Tally("a", names, seen, held, np.zeros((3, 3), np.int32), np.full(2, 0.9, np.float32))
    found = hierarchy(cloud, cameras, [], labels_of(label), [view], params=HierarchyParams(prior=0.0, convex=0.0))
    assert set(found.parent.tolist()) - {0} == united
    assert found.stuff.tolist()[:3] == [True, not united, False]
