import numpy as np
import pytest

from ss_flow.tasks.capture.matches import descriptor_matches
from ss_flow.tasks.capture.pairs import Look, PairParams, in_series, partners


def looks(names, places, seed=0):
    """Photos that show windows of one long strip of features: those at near places have features in common."""
    rng = np.random.default_rng(seed)
    strip = rng.random((4000, 128)) ** 4
    strip = 512 * strip / np.linalg.norm(strip, axis=1, keepdims=True)
    return [
        Look(name, np.clip(np.round(strip[p : p + 100] + rng.normal(0, 2, (100, 128))), 0, 255).astype(np.uint8))
        for name, p in zip(names, places, strict=True)
    ]


def chosen(photos, place=None, **params):
    place = len(photos) - 1 if place is None else place
    others = photos[:place] + photos[place + 1 :]
    return partners(photos[place], others, place=place, params=PairParams(**params)).row.tolist()


NAMES = ["lamp", "oak", "door", "cat", "tree", "rug", "mug", "bed"]


def test_the_photos_that_show_the_same_are_partners():
    photos = looks(NAMES, [0, 1000, 50, 2000, 30, 1050, 2020, 60])
    assert chosen(photos, exhaustive_limit=0) == [0, 2, 4]
    assert chosen(photos, exhaustive_limit=0, partners=1) == [2]


def test_of_many_photos_the_first_features_leave_few_to_look_at_in_full(monkeypatch):
    compared = []
    monkeypatch.setattr(
        "ss_flow.tasks.capture.pairs.descriptor_matches",
        lambda a, b: compared.append(len(a)) or descriptor_matches(a, b),
    )
    places = np.random.default_rng(1).permutation(40) * 90
    photos = looks([f"{chr(97 + i // 10)}{chr(97 + i % 10)}" for i in range(41)], [*places, places[7] + 5])
    assert chosen(photos, exhaustive_limit=0, partners=2, look_features=80)[0] == 7
    assert compared == [20] * 40 + [80] * 8


def test_few_photos_are_all_partners():
    photos = looks(NAMES, [0, 1000, 50, 2000, 30, 1050, 2020, 60])
    assert chosen(photos, exhaustive_limit=8) == [0, 1, 2, 3, 4, 5, 6]
    assert chosen(photos, exhaustive_limit=7) == [0, 2, 4]


def test_neighbours_in_a_series_are_partners_besides_those_that_close_a_loop():
    series = [f"frame-{i:06d}" for i in range(0, 80, 10)]
    places = [0, 400, 800, 1200, 1600, 2000, 2400, 20]
    assert chosen(looks(series, places), exhaustive_limit=0, overlap=2) == [0, 5, 6]
    assert chosen(looks(NAMES, places), exhaustive_limit=0, overlap=2) == [0]
    # In the middle of the series it has neighbours on either side.
    assert chosen(looks(series, places), place=3, exhaustive_limit=0, overlap=1) == [2, 3]


def test_a_photo_like_no_other_is_still_compared_with_some():
    photos = looks(NAMES, [400 * i for i in range(8)])
    assert len(chosen(photos, exhaustive_limit=0, partners=5)) == 5


def test_what_a_photo_chooses_does_not_depend_on_later_ones():
    photos = looks(NAMES, [0, 1000, 50, 2000, 30, 1050, 2020, 60])
    for count in (5, 6, 8):
        assert chosen(photos[:count][:5], exhaustive_limit=0) == [0, 2]


@pytest.mark.parametrize(("matching", "expected"), [("exhaustive", list(range(7))), ("sequential", [4, 5, 6])])
def test_pairs_may_be_asked_for_plainly(matching, expected):
    assert chosen(looks(NAMES, [400 * i for i in range(8)]), matching=matching, overlap=3) == expected


@pytest.mark.parametrize(
    ("a", "b", "expected"),
    [
        ("IMG_0041", "IMG_0042", True),
        ("frame-000000", "frame-000120", True),
        ("9", "10", True),
        ("room1_003", "room1_004", True),
        ("room1_003", "room2_004", False),
        ("IMG_0041", "DSC_0041", False),
        ("lamp", "oak", False),
        ("lamp1", "lamp", False),
        ("a", "a", False),
    ],
)
def test_a_series_counts_in_one_place_of_its_names(a, b, expected):
    assert in_series(a, b) is expected
