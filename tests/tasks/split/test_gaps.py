import numpy as np
import pytest
from flat_patches import BROWN, GREY, RED, SHADE, WHITE, Patch, patch, scene, views_of

from ss_flow.tasks.split.looks import Looks
from ss_flow.tasks.split.surfaces import ShadowParams, lit_surfaces
from ss_flow.tasks.split.votes.touching import TouchingParams, borders

ABOVE = [(0.5, 0.25, 2.5), (0.0, -0.8, 2.0), (1.0, 1.3, 2.0)]
HIGH = 0.7


def surfaces(*patches: Patch, unlabelled: int = 0, eyes=ABOVE, **changes) -> list[int]:
    """The surface of each labelled patch, seen from some places."""
    cloud, _, label = scene(*patches, unlabelled=unlabelled)
    cameras, visibility = views_of(cloud, *eyes)
    ends = borders(label, cloud, TouchingParams())
    return lit_surfaces(Looks(cloud, cameras, visibility), label, ends, ShadowParams(**changes))[1:].tolist()


def halves(gap: float = 0.16, color: np.ndarray = BROWN) -> list[Patch]:
    """Two halves of a table top, and how far they lie apart."""
    return [patch(BROWN, 0, 0, HIGH, width=0.5), patch(color, 0.5 + gap, 0, HIGH, width=0.5)]


def thing(rises: float = 0.1, width: float = 0.16, color: np.ndarray = RED) -> Patch:
    """What lies in the gap between them."""
    return patch(color, 0.5, 0, HIGH + rises, width=width)


FLOOR = patch(GREY, -1, -0.5, width=3), patch(GREY, -1, 0, width=3), patch(GREY, -1, 0.5, width=3)
"""Three strips, below."""


@pytest.mark.parametrize("rises", [0.1, 0.0], ids=["stands", "lies"])
def test_a_table_goes_on_under_what_is_on_it(rises):
    assert surfaces(*halves(), thing(rises)) == [1, 1, 3]
    assert surfaces(*halves(), thing(rises), gap=0.0) == [1, 2, 3]


def test_between_two_tables_some_view_sees_the_floor():
    assert surfaces(*halves(), *FLOOR)[:2] == [1, 2]
    assert surfaces(*halves(), thing(), *FLOOR)[:2] == [1, 1]


def test_what_no_view_looks_at_tells_nothing():
    assert surfaces(*halves()) == [1, 2]
    assert surfaces(*halves(), thing(), eyes=[(0.5, 0.25, -2.5)])[:2] == [1, 2]


def test_two_pages_lie_in_a_larger_table():
    (places, brown), page = patch(BROWN, 0, 0, HIGH, width=1.0), patch(WHITE, 0, 0, HIGH, width=1.0)[1]
    first, second = ((places[:, 0] > low) & (places[:, 0] < low + 0.3) for low in (0.09, 0.53))
    table = ~first & ~second
    parts = [(places[first], page[first]), (places[second], page[second]), (places[table], brown[table])]
    assert surfaces(*parts) == [1, 2, 3]
    assert surfaces(*parts, unlabelled=1) == [1, 2]


@pytest.mark.parametrize(("color", "surface"), [(BROWN, 1), (WHITE, 2)])
def test_points_without_a_label_go_on_in_a_surface_of_their_colour_alone(color, surface):
    assert surfaces(*halves(), thing(0.0, color=color), unlabelled=1) == [1, surface]


def test_of_other_colours_or_at_other_heights_they_are_two():
    assert surfaces(*halves(color=SHADE * BROWN), thing())[:2] == [1, 2]
    (left, right), lift = halves(), np.array([0, 0, 0.05])
    assert surfaces(left, (right[0] + lift, right[1]), thing())[:2] == [1, 2]


def test_a_gap_may_be_as_long_as_a_share_of_the_smaller_one():
    assert surfaces(*halves(0.3), thing(width=0.3))[:2] == [1, 2]
    assert surfaces(*halves(0.3), thing(width=0.3), gap=0.5)[:2] == [1, 1]
    places, color = patch(BROWN, 0, 0, HIGH, width=1.0)
    u, v = places[:, 0], places[:, 1]
    corner, piece, between = (u < 0.1) | (v < 0.1), (u > 0.4) & (v > 0.25), (u > 0.1) & (v > 0.1) & (v < 0.25)
    inside = (places[corner], color[corner]), (places[piece], color[piece])  # one's box holds the other
    on_it = places[between] + np.array([0, 0, 0.1]), 0 * color[between] + RED
    assert surfaces(*inside, on_it, gap=0.2)[:2] == [1, 2]
    assert surfaces(*inside, on_it, gap=0.4)[:2] == [1, 1]


def test_a_few_points_have_no_plane():
    for width, surface in ((0.06, 2), (0.1, 1)):
        piece = patch(BROWN, 0.6, 0, HIGH, width=width)
        assert surfaces(patch(BROWN, 0, 0, HIGH), piece, thing(width=0.1))[:2] == [1, surface]


def test_where_they_touch_the_border_alone_tells():
    (places, color), other = halves(gap=0.0)
    dark = np.where(places[:, :1] > 0.4, 0.5, 1) * color
    assert surfaces((places, dark), other, colors=0.5) == [1, 2]
