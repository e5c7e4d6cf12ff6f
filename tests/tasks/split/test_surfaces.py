import numpy as np
import pytest
from flat_patches import BROWN, GREY, RED, SHADE, WHITE, Patch, patch, scene
from labelled_points import labels_of

from ss_flow.tasks.artifacts import Hierarchy
from ss_flow.tasks.split.hierarchy import HierarchyParams, hierarchy
from ss_flow.tasks.split.looks import Looks
from ss_flow.tasks.split.surfaces import ShadowParams, lit_surfaces
from ss_flow.tasks.split.votes.touching import TouchingParams, borders


def surfaces(*patches: Patch, unlabelled: int = 0, **changes) -> list[int]:
    """The surface of each labelled patch."""
    cloud, cameras, label = scene(*patches, unlabelled=unlabelled)
    params = ShadowParams(**{"repeats": 1, **changes})
    return lit_surfaces(Looks(cloud, cameras, []), label, borders(label, cloud, TouchingParams()), params)[1:].tolist()


def floor(shade: np.ndarray = SHADE) -> list[Patch]:
    """A grey floor, half of it darker."""
    return [patch(GREY, 0, 2), patch(shade * GREY, 0.5, 2)]


def table(x: float = 0.5, y: float = 0.0, z: float = 0.7) -> list[Patch]:
    """A brown table, and a dark half of it, which starts at a place."""
    return [patch(BROWN, 0, y, 0.7), patch(SHADE * BROWN, x, y, z)]


def test_a_step_that_parallel_surfaces_of_other_colours_repeat_is_a_shadow():
    assert surfaces(*floor(), *table()) == [1, 1, 3, 3]


def test_a_step_that_nothing_repeats_may_be_paint():
    assert surfaces(*table()) == [1, 2]
    assert surfaces(*floor(0.5 * SHADE), *table()) == [1, 2, 3, 4]


def test_a_step_that_too_few_borders_repeat_may_be_chance():
    assert surfaces(*floor(), *table(), repeats=2) == [1, 2, 3, 4]
    assert surfaces(*floor(), *[(p + np.array([0, 2, 0]), c) for p, c in floor()], *table(), repeats=2)[4:] == [5, 5]


def test_a_step_that_only_surfaces_of_the_same_colour_repeat_may_be_a_print():
    assert surfaces(*table(), *table(y=2)) == [1, 2, 3, 4]


@pytest.mark.parametrize("light", [0.5, 0.7])
def test_a_step_that_only_the_same_colour_repeats_in_another_light_may_be_a_print(light):
    darker = [(places, light * color) for places, color in table(y=2)]
    assert surfaces(*table(), *darker) == [1, 2, 3, 4]


def test_a_step_of_another_tint_is_no_shadow():
    blue = np.array([0.3, 0.5, 0.9])
    assert surfaces(*floor(blue), patch(BROWN, 0, 0), patch(blue * BROWN, 0.5, 0)) == [1, 2, 3, 4]


def test_a_step_twice_as_deep_is_not_that_shadow():
    assert surfaces(*floor(), *table(y=4), patch(BROWN, 0, 0), patch(SHADE**2 * BROWN, 0.5, 0)) == [1, 1, 3, 3, 5, 6]


def test_a_shadow_on_a_wall_tells_nothing_about_a_table():
    wall = [(places[:, [0, 2, 1]], color) for places, color in floor()]
    assert surfaces(*wall, *table()) == [1, 2, 3, 4]


def test_a_shadow_on_a_table_tells_nothing_about_a_wall():
    wall = [(places[:, [0, 2, 1]], color) for places, color in (patch(BROWN, 0, 2), patch(SHADE * BROWN, 0.5, 2))]
    assert surfaces(*floor(), *table(), *wall) == [1, 1, 3, 3, 5, 6]


def test_a_step_that_differs_along_its_border_is_no_shadow():
    lit, (places, color) = floor()
    uneven = color * SHADE ** np.where(places[:, 1:2] < 2.25, -0.6, 0.6)  # the shadow's step in the middle
    assert surfaces(lit, (places, uneven), *table()) == [1, 2, 3, 4]


def test_a_border_that_goes_into_a_shadow_here_and_out_of_it_there_is_not_that_of_a_shadow():
    places, color = patch(BROWN, 0.5, 0)
    both = color * SHADE ** np.where(places[:, 1:2] < 0.25, 1, -1)
    assert surfaces(*floor(), *table(y=4), patch(BROWN, 0, 0), (places, both)) == [1, 1, 3, 3, 5, 6]


@pytest.mark.parametrize("color", [WHITE, RED, GREY])
def test_another_colour_stays_apart_beside_a_shadow(color):
    assert surfaces(*floor(), *table(), patch(color, 0, 0.5, 0.7)) == [1, 1, 3, 3, 5]


@pytest.mark.parametrize("height", [0.72, 0.8])
def test_what_lies_higher_is_not_of_the_same_surface(height):
    assert surfaces(*floor(), *table(y=4), *table(z=height)) == [1, 1, 3, 3, 5, 6]


def test_what_does_not_touch_is_not_of_the_same_surface():
    assert surfaces(*floor(), *table(y=4), *table(x=0.7)) == [1, 1, 3, 3, 5, 6]


def test_points_without_label_between_them_part_no_surface():
    between = patch(BROWN, 0.5, 0, 0.7, width=0.2)
    assert surfaces(*floor(), *table(y=4), *table(x=0.7), between, unlabelled=1) == [1, 1, 3, 3, 5, 5]


def test_a_book_on_a_table_is_not_of_its_surface_however_large_the_table():
    wide = patch(BROWN, 0, 0, 0.7, width=4)
    for height, surface in ((0.7, 5), (0.73, 6)):
        book = patch(SHADE * BROWN, 4, 0, height, width=0.3)
        assert surfaces(*floor(), *table(y=4), wide, book) == [1, 1, 3, 3, 5, surface]


def test_a_label_half_in_the_shadow_goes_with_both_sides():
    half = patch(np.sqrt(SHADE) * BROWN, 1.0, 0, 0.7, width=0.1)
    assert surfaces(*floor(), *table(), half) == [1, 1, 3, 3, 3]


def test_where_the_colour_does_not_change_nothing_ends():
    assert surfaces(patch(BROWN, 0, 0), patch(BROWN, 0.5, 0)) == [1, 1]
    assert surfaces(patch(BROWN, 0, 0), patch(BROWN, 0.6, 0)) == [1, 2]
    assert surfaces(patch(BROWN, 0, 0), patch(BROWN, 0.5, 0, 0.1)) == [1, 2]


def test_surfaces_touch_at_enough_points_and_along_enough_of_the_border_of_one_of_them():
    row = patch(WHITE, -0.5, 0), patch(BROWN, 0, 0), patch(BROWN, 0.5, 0), patch(WHITE, 1, 0)
    assert surfaces(*row) == [1, 2, 2, 4]
    assert surfaces(*row, contact=0.7) == surfaces(*row, min_points=2000) == [1, 2, 3, 4]


@pytest.mark.parametrize(("width", "height"), [(0.5, 0.01), (4, 0.025)])
def test_surfaces_are_as_thick_as_points_are_apart_and_the_larger_they_are_the_thicker(width, height):
    assert surfaces(patch(BROWN, 0, 0, width=width), patch(BROWN, width, 0, height, width=width)) == [1, 1]


@pytest.mark.parametrize(("height", "surface"), [(0.1, 1), (0.3, 2)])
def test_what_lies_off_the_plane_of_the_others_for_the_most_part_is_no_piece_of_their_surface(height, surface):
    (flat, color), (wall, same) = patch(BROWN, 0, 0), patch(BROWN, -height, 0, width=2 * height)
    bent = np.concatenate([flat, wall[:, [2, 1, 0]]]), np.concatenate([color, same])
    assert surfaces(bent, patch(BROWN, 0.5, 0)) == [1, surface]


def test_a_sheet_of_paper_does_not_take_the_colour_of_what_fills_the_gap_beside_it():
    between = patch(BROWN, 0.5, 0, width=0.2)
    assert surfaces(patch(BROWN, 0, 0), patch(WHITE, 0.7, 0), between, unlabelled=1) == [1, 2]


def dark_edge(color: np.ndarray, open_from: float = 0.3) -> list[Patch]:
    """A brown patch, darker where it ends but for a piece of that border, and one of a colour beside it."""
    places, light = patch(BROWN, 0, 0)
    light[(places[:, 0] > 0.4) & (places[:, 1] < open_from)] *= 0.5
    return [(places, light), patch(color, 0.5, 0)]


def test_of_one_colour_all_over_they_are_one_whatever_lies_along_most_of_their_border():
    assert surfaces(*dark_edge(BROWN)) == [1, 1]
    assert surfaces(*dark_edge(BROWN), colors=1.0) == [1, 2]
    assert surfaces(*dark_edge(RED)) == [1, 2]


def test_what_has_an_outline_all_along_stays_apart_though_of_one_colour():
    assert surfaces(*dark_edge(BROWN, open_from=1)) == [1, 2]


def test_two_sheets_of_one_colour_stay_apart_beside_a_gap_between_them():
    sheets = [patch(WHITE, 0, 0), patch(WHITE, 0.7, 0)]
    assert surfaces(*sheets, patch(BROWN, 0.5, 0, width=0.2), unlabelled=1) == [1, 2]


def test_in_the_dark_nothing_is_known():
    assert surfaces(patch(0 * BROWN, 0, 0), patch(0 * BROWN, 0.5, 0)) == [1, 2]


def test_faces_of_one_colour_that_meet_in_an_edge_stay_apart():
    places, color = patch(BROWN, 0, 0)
    assert surfaces((places, color), (places[:, [2, 1, 0]], color)) == [1, 2]


def tree(agreement: float) -> Hierarchy:
    """A floor and a table, both in light and shadow, of which no view has a mask."""
    cloud, cameras, label = scene(*floor(), *table())
    params = HierarchyParams(shadows=ShadowParams(agreement=agreement, repeats=1))
    return hierarchy(cloud, cameras, [], labels_of(label), [], params=params)


def test_the_tree_unites_what_light_alone_parts():
    found = tree(0.6)
    assert found.node.tolist() == [1, 2, 3, 4, 5, 6]
    assert found.parent.tolist() == [5, 5, 6, 6, 0, 0]
    assert found.agreement.tolist() == pytest.approx([1, 1, 1, 1, 0.6, 0.6])
    # Halves of the floor are stuff though each alone would be too small.
    assert found.stuff.tolist() == [True, True, False, False, True, False]


def test_shadows_need_not_be_looked_for():
    assert tree(0.0).node.tolist() == [1, 2, 3, 4]
