from dataclasses import replace

import numpy as np
import pytest
from clouds import even_cloud
from labelled_points import labels_of, lying, one_camera

from ss_flow.tasks.artifacts import Cameras, PointCloud, PointLabels, Tally
from ss_flow.tasks.split.hierarchy import HierarchyParams, hierarchy
from ss_flow.tasks.split.stuff import StuffParams
from ss_flow.tasks.split.supports import Supports, find_supports

STEP = 0.01
TABLE, BODY, HANDLE, BOOK = range(4)
MUG = (BODY, HANDLE)


def block(width: float, depth: float, height: float) -> np.ndarray:
    """[N, 3] the top and the sides of a block about the z axis."""
    top = lying(width, depth, height)
    rim = top[(np.abs(top[:, :2]) > (width / 2 - 1.5 * STEP, depth / 2 - 1.5 * STEP)).any(axis=1)]
    return np.concatenate([top, *(rim * (1, 1, 0) + (0, 0, z) for z in np.arange(STEP, height, STEP))])


def scene(pieces: list[np.ndarray], turn: float = 0.0) -> tuple[PointCloud, Cameras, PointLabels]:
    """Pieces with labels 1.., seen by an upright camera before and above them; turn: of the pieces about x, radians."""
    c, s = np.cos(turn), np.sin(turn)
    places = np.concatenate(pieces) @ np.array([[1, 0, 0], [0, c, -s], [0, s, c]]).T
    label = np.repeat(np.arange(1, len(pieces) + 1, dtype=np.int32), [len(piece) for piece in pieces])
    down = np.array([0, -np.sqrt(0.5), -np.sqrt(0.5)])  # of the camera, which looks along (0, 1, -1)
    pose = np.eye(4)
    pose[:3, :3] = [(1, 0, 0), down, np.cross((1, 0, 0), down)]
    pose[:3, 3] = -pose[:3, :3] @ (0, -2, 2)
    colors = np.array([(118, 76, 46), (45, 85, 200), (240, 238, 230), (205, 40, 40)], np.uint8)[label - 1]
    return even_cloud(places.astype(np.float32), colors, 1.0, STEP), one_camera(pose), labels_of(label)


def table_with(*pieces: np.ndarray, turn: float = 0.0) -> Supports:
    """A table, but where the others stand on it, and these."""
    top = lying(0.8, 0.8)
    for piece in pieces:
        if piece[:, 2].min() < 0:
            continue
        low, high = piece[:, :2].min(axis=0) - STEP / 2, piece[:, :2].max(axis=0) + STEP / 2
        top = top[~((top[:, :2] >= low) & (top[:, :2] <= high)).all(axis=1)]
    cloud, cameras, labels = scene([top, *pieces], turn)
    return find_supports(cloud, cameras, labels, height=0.09)


def mug() -> list[np.ndarray]:
    """A body, and a handle beside it that starts above the table."""
    return [block(0.08, 0.08, 0.1), block(0.03, 0.02, 0.06) + np.array([0.055, 0, 0.02])]


def test_a_mug_stands_on_a_table_in_whatever_pieces_it_is():
    supports = table_with(*mug())
    assert supports.levels((TABLE,)) == [(TABLE,)]
    assert supports.hold((TABLE,), (BODY,)) and supports.hold((TABLE,), MUG)


def test_a_table_is_level_though_it_is_one_with_its_legs():
    legs = np.concatenate([block(0.05, 0.05, 0.7) + np.array([x, y, -0.75]) for x in (-0.3, 0.3) for y in (-0.3, 0.3)])
    supports = table_with(block(0.08, 0.08, 0.1), legs)
    assert (0,) in supports.levels((0, 2)) and (2,) not in supports.levels((0, 2))
    assert supports.hold((0,), (1,)) and not supports.hold((0,), (2,))


@pytest.mark.parametrize(
    "piece",
    [
        pytest.param(lying(0.1, 0.1, 0.01), id="a page"),
        pytest.param(
            block(0.08, 0.08, 0.1) + np.array([0.36, 0.36, 0]), id="what rises from a corner, as the arm of a seat"
        ),
        pytest.param(
            block(0.8, 0.05, 0.4) + np.array([0, 0.375, 0]), id="what rises along an edge, as the back of a chair"
        ),
        pytest.param(block(0.08, 0.08, 0.1) - np.array([0, 0, 0.1]), id="what hangs below"),
        pytest.param(block(0.7, 0.7, 0.3), id="what covers nearly all of it"),
        pytest.param(block(0.04, 0.04, 0.1)[:10], id="a few points"),
    ],
)
def test_no_part_of_a_table_stands_on_it(piece):
    assert not table_with(piece).hold((TABLE,), (1,))


@pytest.mark.parametrize(("turn", "holds"), [(0.0, True), (np.pi / 2, False)])
def test_a_handle_does_not_stand_on_its_door(turn, holds):
    assert table_with(block(0.08, 0.08, 0.1), turn=turn).hold((TABLE,), (1,)) == holds


def test_a_crumpled_cloth_is_nothing_to_stand_on():
    cloth = lying(0.8, 0.8)
    cloth[:, 2] = 0.05 * np.sin(40 * cloth[:, 0])
    supports = find_supports(*scene([cloth, block(0.08, 0.08, 0.2)]), height=0.09)
    assert supports.levels((0,)) == []


@pytest.mark.parametrize(
    ("width", "spacing", "is_level"),
    [
        pytest.param(0.16, STEP, True, id="a closed pot"),
        pytest.param(0.16, 2 * STEP, False, id="a pot that few points show, near the middle of which most lie"),
        pytest.param(0.5, 2 * STEP, True, id="a cushion that few points show"),
    ],
)
def test_what_lies_near_a_plane_but_no_wider_than_that_is_nothing_to_stand_on(width, spacing, is_level):
    cloud, cameras, labels = scene([block(width, width, 0.1)])
    supports = find_supports(replace(cloud, spacing=np.full_like(cloud.spacing, spacing)), cameras, labels, height=0.09)
    assert supports.levels((0,)) == ([(0,)] if is_level else [])


CHEST = block(0.8, 0.5, 0.7)


def on_chest(piece: np.ndarray) -> np.ndarray:
    return piece + np.array([0.1, 0, 0.7])


@pytest.mark.parametrize("turn", [0.0, -0.3])
def test_a_mug_stands_on_a_chest_whose_top_is_one_piece_with_its_sides(turn):
    supports = find_supports(*scene([CHEST, *map(on_chest, mug())], turn), height=0.09)
    assert supports.levels((0,)) == [(0,)]
    assert supports.hold((0,), MUG) and not supports.hold((0,), (HANDLE,))


def test_what_is_below_the_top_of_a_chest_or_ends_at_it_does_not_stand_on_it():
    drawer = block(0.3, 0.1, 0.15) + np.array([0.0, -0.3, 0.4])
    board = block(0.8, 0.03, 0.9) + np.array([0.0, 0.27, 0.0])
    supports = find_supports(*scene([CHEST, drawer, board]), height=0.09)
    assert supports.levels((0,)) == [(0,)]
    assert not supports.hold((0,), (1,)) and not supports.hold((0,), (2,))


SEAT = block(0.8, 0.5, 0.3)
BACK = block(0.8, 0.04, 0.3) + np.array([0, 0.23, 0.3])


@pytest.mark.parametrize("more", [[BACK], [lying(0.8, 0.5, 0.1)]], ids=["a back above it", "a board below it"])
def test_a_chair_or_a_shelf_of_one_piece_is_nothing_to_stand_on(more):
    assert find_supports(*scene([SEAT]), height=0.09).levels((0,)) == [(0,)]
    assert find_supports(*scene([np.concatenate([SEAT, *more])]), height=0.09).levels((0,)) == []


def tree(masks: list[set[int]], pieces: list[np.ndarray]) -> dict[frozenset[int], float]:
    """The agreement of each union of leaves, where four views see all pieces, none of them stuff, and have
    these masks, of labels."""
    cloud, cameras, labels = scene(pieces)
    number = np.arange(1, len(pieces) + 1, dtype=np.int32)
    size = np.array([len(piece) for piece in pieces], np.int32)
    views = []
    for k in range(4):  # each sees another part of them
        seen = size - k
        held = np.array([seen * np.isin(number, [*mask]) for mask in masks], np.int32)
        beside = np.zeros((len(pieces), len(pieces)), np.int32)
        views.append(Tally(f"{k}", number, seen, held, beside, np.full(len(masks), 0.9, np.float32)))
    found = hierarchy(cloud, cameras, [], labels, views, params=HierarchyParams(stuff=StuffParams(extent=1.0)))
    leaves = {node: frozenset({node}) for node in number.tolist()}
    for node in sorted(set(found.parent.tolist()) - {0}):
        children = found.node[found.parent == node].tolist()
        leaves[node] = frozenset().union(*(leaves[child] for child in children))
    agreement = dict(zip(found.node.tolist(), found.agreement.tolist(), strict=True))
    return {leaves[node]: agreement[node] for node in leaves if len(leaves[node]) > 1}


def test_what_stands_on_a_table_is_no_part_of_it_though_every_mask_of_it_holds_that():
    top = lying(0.8, 0.8)
    top = top[~((np.abs(top[:, :2]) < 0.04).all(axis=1))]
    found = tree([{1}, {1, 2, 3}, {2, 3}], [top, *mug()])
    assert found[frozenset({2, 3})] > 0.6
    assert found.get(frozenset({1, 2, 3}), 0) < 0.41


@pytest.mark.parametrize("edge", [0.0, 0.1], ids=["an edge under it", "an edge beside it"])
def test_what_stands_on_a_rug_is_no_part_of_it_though_that_is_in_pieces(edge):
    rug = lying(0.8, 0.8)
    rug = rug[~((np.abs(rug[:, :2]) < 0.04).all(axis=1))]
    stool = block(0.08, 0.08, 0.1)
    found = tree([{1, 2, 3}, {1}, {2}, {3}], [rug[rug[:, 0] < edge], rug[rug[:, 0] >= edge], stool])
    assert found[frozenset({1, 2})] > 0.6
    assert found.get(frozenset({1, 2, 3}), 0) <= 0.41


def test_two_things_on_a_table_are_not_one_because_a_mask_of_it_holds_both():
    top = lying(0.8, 0.8)
    book = block(0.14, 0.2, 0.04) - np.array([0.2, 0, 0])
    found = tree([{1, 2, 3, 4}, {2, 3, 4}], [top, *mug(), book])
    assert frozenset({2, 3, 4}) in found
    assert found[frozenset({2, 3, 4})] < 0.7 * 0.9


def test_things_that_touch_each_other_on_a_table_stand_on_it_though_together_they_take_half_of_it():
    sides = [block(0.1, 0.6, 0.1) + np.array([x, 0, 0]) for x in (-0.25, 0.25)]
    things = [*sides, block(0.4, 0.1, 0.1)]
    legs = [block(0.05, 0.05, 0.5) + np.array([x, y, -0.51]) for x in (-0.37, 0.37) for y in (-0.37, 0.37)]
    top = lying(0.8, 0.8)
    for thing in things:
        low, high = thing[:, :2].min(axis=0) - STEP / 2, thing[:, :2].max(axis=0) + STEP / 2
        top = top[~((top[:, :2] >= low) & (top[:, :2] <= high)).all(axis=1)]
    pieces = [np.concatenate([top, *legs]), *things]
    everything = frozenset({1, 2, 3, 4})
    assert tree([{1, 2, 3, 4}], pieces)[everything] == pytest.approx(0.41)  # a group
    lower = [piece - np.array([0, 0, 0.3]) for piece in things]  # under the table, where they do not stand on it
    assert tree([{1, 2, 3, 4}], [pieces[0], *lower])[everything] > 0.6
