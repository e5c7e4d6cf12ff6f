from dataclasses import replace

import numpy as np
import pytest
from labelled_points import labels_of, lying, one_camera

from ss_flow.tasks.artifacts import PointCloud, PointLabels, Tally
from ss_flow.tasks.split.hierarchy import HierarchyParams, hierarchy
from ss_flow.tasks.split.sheets import Sheets, find_sheets
from ss_flow.tasks.split.votes.touching import TouchingParams, borders

STEP = 0.01
TABLE, PAGE, MUG = 0, 1, 2


def halved(cloud: PointCloud, labels: PointLabels, at: float) -> Sheets:
    """The same scene with the page in two pieces, the right one with label 4."""
    label = np.where((labels.label == 2) & (cloud.points[:, 0] >= at), 4, labels.label).astype(np.int32)
    return sheets_of(cloud, replace(labels, label=label))


def within(places: np.ndarray, half: float) -> np.ndarray:
    return (np.abs(places[:, :2]) < half - 1e-6).all(axis=1)


def block(height: float) -> np.ndarray:
    """[N, 3] the top and the sides of a block of 8 cm x 8 cm about the z axis."""
    top = lying(0.08, 0.08, height)
    rim = top[(np.abs(top[:, :2]) > 0.033).any(axis=1)]
    sides = [rim * (1, 1, 0) + (0, 0, z) for z in np.arange(STEP, height, STEP)]
    return np.concatenate([top, *sides])


def scene(page: float = 0.0, mug: float = 0.1, table: float = 0.8) -> tuple[PointCloud, PointLabels]:
    """A table (label 1) so wide, on it a page (2) so thick, and on this a mug (3) so high; metres."""
    top = lying(table, table)
    sheet = lying(0.24, 0.24, page)
    pieces = [top[~within(top, 0.12)], sheet[~within(sheet, 0.04)], block(mug) + np.array([0, 0, page])]
    places = np.concatenate(pieces).astype(np.float32)
    label = np.repeat(np.arange(1, 4, dtype=np.int32), [len(piece) for piece in pieces])
    cloud = PointCloud(places, np.zeros((len(places), 3), np.uint8), 1.0, STEP)
    return cloud, labels_of(label)


def on_table(flush: float = 0.6, **sizes: float) -> Sheets:
    return sheets_of(*scene(**sizes), flush)


def sheets_of(cloud: PointCloud, labels: PointLabels, flush: float = 0.6) -> Sheets:
    return find_sheets(cloud, labels, borders(labels.label, cloud, TouchingParams()), flush=flush, height=0.09)


def test_a_mug_stands_on_the_page_that_lies_on_a_table():
    assert on_table().standing([(PAGE,), (MUG,)]).tolist() == [False, True]


def test_a_piece_of_the_page_that_no_mask_shows_with_it_tells_nothing():
    sheets = replace(halved(*scene(), at=0.05), flush=0.7)
    assert sheets.standing([(PAGE,), (MUG,)]).tolist() == [False, True]


def test_within_a_set_that_holds_the_table_the_page_is_no_sheet():
    assert not on_table().standing([(TABLE,), (PAGE,), (MUG,)]).any()
    assert not on_table().standing([(TABLE,), (PAGE, MUG)]).any()


@pytest.mark.parametrize(("thickness", "stands"), [(0.0, True), (0.06, False)])
def test_what_has_an_edge_all_round_is_no_sheet(thickness, stands):
    assert on_table(page=thickness).standing([(PAGE,), (MUG,)]).any() == stands


def test_a_cushion_that_bulges_out_of_the_table_is_no_sheet():
    cloud, labels = scene()
    bulge = 0.1 * (np.cos(np.pi * cloud.points[:, :2].clip(-0.12, 0.12) / 0.24) ** 2).prod(axis=1)
    round_ = replace(cloud, points=(cloud.points + bulge[:, None] * np.array([0, 0, 1])).astype(np.float32))
    assert sheets_of(round_, labels)._outwards([(PAGE,), (MUG,)])[0] > 0.6
    assert not sheets_of(round_, labels).standing([(PAGE,), (MUG,)]).any()


@pytest.mark.parametrize(
    ("smooth", "border", "sizes", "pieces", "expected"),
    [
        ([[0, 30, 70], [30, 0, 0], [70, 0, 0]], [100, 30, 70], [10, 20, 30], [(0,), (1,)], (70 - 30) / 120),
        ([[0, 10, 40], [10, 0, 40], [40, 40, 0]], [50, 50, 80], [10, 10, 30], [(0, 1)], 80 / 100),
        ([[0, 40, 40], [40, 0, 0], [40, 0, 0]], [40, 40, 40], [10, 20, 30], [(0,)], 40 / 60),
        ([[0, 40, 40], [40, 0, 0], [40, 0, 0]], [40, 40, 40], [10, 20, 30], [(0,), (1,), (2,)], -40 / 60),
    ],
    ids=["into the set", "within the piece", "into two labels at once", "into two pieces at once"],
)
def test_of_the_border_of_a_piece_each_point_counts_once_outwards_or_into_the_set(
    smooth, border, sizes, pieces, expected
):
    # 20 points more are presumed, which go nowhere.
    cloud, _ = scene()
    goes_on, rows = np.array(smooth, float), [np.arange(size) for size in sizes]
    sheets = Sheets(goes_on, goes_on, np.array(border, float), rows, cloud, 0.6, 0.09)
    assert sheets._outwards(pieces)[0] == pytest.approx(expected)


def test_what_lies_in_the_page_does_not_stand_on_it():
    assert not on_table(mug=0.01).standing([(PAGE,), (MUG,)]).any()


@pytest.mark.parametrize(("mug", "stands"), [(0.028, False), (0.032, True)])
def test_what_stands_on_a_page_rises_from_it_by_more_than_the_noise_of_points(mug, stands):
    sheets = replace(on_table(mug=mug), height=0.0)
    assert sheets.standing([(PAGE,), (MUG,)]).tolist() == [False, stands]


def test_a_page_lies_in_nothing_smaller():
    assert not on_table(table=0.26).standing([(PAGE,), (MUG,)]).any()


def test_a_threshold_of_one_finds_no_sheets():
    assert not on_table(flush=1.0).standing([(PAGE,), (MUG,)]).any()


def test_the_order_of_the_pieces_does_not_matter():
    assert on_table().standing([(MUG,), (PAGE,)]).tolist() == [True, False]


@pytest.mark.parametrize(("flush", "agreement"), [(0.6, 0.45), (1.0, 1.0)])
def test_views_that_show_page_and_mug_as_one_show_a_group(flush, agreement):
    cloud, labels = scene()
    pose = np.diag([1.0, -1, -1, 1])
    pose[:3, 3] = (0, 0, 2)
    seen = np.bincount(labels.label)[1:].astype(np.int32)
    both = np.array([[0, seen[1], seen[2]]], np.int32)
    view = Tally("a", np.arange(1, 4, dtype=np.int32), seen, both, np.zeros((3, 3), np.int32), np.ones(1, np.float32))
    params = HierarchyParams(prior=0.0, contact=0.0, apart=0.0, flush=flush)
    tree = hierarchy(cloud, one_camera(pose), [], labels, [view], params=params)
    assert tree.parent.tolist() == [0, 4, 4, 0]
    assert tree.agreement[3] == pytest.approx(agreement)


def test_a_page_lies_in_its_table_and_a_mug_does_not():
    sheets = on_table()
    assert sheets.lies_in((PAGE,), (TABLE,)) and not sheets.lies_in((MUG,), (PAGE,))
    assert not on_table(page=0.05).lies_in((PAGE,), (TABLE,))
    assert not sheets.lies_in((MUG,), (TABLE,))  # they do not touch
