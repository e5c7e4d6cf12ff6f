"""Things that have no label, since few views have a mask of them."""

from __future__ import annotations

import importlib
from dataclasses import replace

import numpy as np
import pytest
from box_scene import row_of_points
from clouds import even_cloud
from labelled_points import labels_of, lying, one_camera

from ss_flow.tasks.artifacts import Frame, PointCloud, PromptedMasks, Visibility
from ss_flow.tasks.masks.pool import mask_set
from ss_flow.tasks.models.catalogue import Model
from ss_flow.tasks.models.sam import EmbeddedPhoto, Embedding
from ss_flow.tasks.packed import Masks
from ss_flow.tasks.split.overlooked import OverlookedParams, asked, claimed, confirmed, overlooked, with_answers
from ss_flow.tasks.split.reprompt import RepromptParams

reprompting = importlib.import_module("ss_flow.tasks.split.reprompt")
STEP = 0.01
ABOVE = one_camera(np.array([[1.0, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 2], [0, 0, 0, 1]]))
FLOOR = lying(0.4, 0.4, step=STEP)
DOT = np.hypot(FLOOR[:, 0] - 0.1, FLOOR[:, 1]) < 0.04


def jar(x: float = -0.1, *, height: int = 8) -> np.ndarray:
    """A small block that stands on the floor."""
    return np.concatenate([np.add(lying(0.04, 0.04, (z + 1) * STEP, STEP), (x, 0, 0)) for z in range(height)])


def scene(*things: np.ndarray) -> tuple[PointCloud, np.ndarray]:
    """The floor, with label 1, and things on it without a label: the cloud, and which thing each point is of."""
    points = np.concatenate([FLOOR, *things]).astype(np.float32)
    of = np.repeat(np.arange(len(things) + 1), [len(FLOOR), *map(len, things)])
    return even_cloud(points, np.zeros(points.shape, np.uint8), 1.0, STEP), of


def seeing(rows: np.ndarray) -> Visibility:
    """A view of these points, in a row."""
    index = np.flatnonzero(rows).astype(np.int32)
    return Visibility("0", index, np.arange(len(index), dtype=np.int32), np.ones(len(index), np.float32), 1, len(index))


def found(cloud: PointCloud, label: np.ndarray, views: list[Visibility], **params: float) -> np.ndarray:
    return overlooked(cloud, ABOVE, views, labels_of(label), params=OverlookedParams(**params)).label


def above(cloud: PointCloud, rows: np.ndarray) -> np.ndarray:
    """Those of some points that are not so near to the floor that they count as lying on it."""
    return rows & (cloud.points[:, 2] > 1.5 * STEP)


def test_what_rises_from_a_surface_and_has_no_label_is_found_and_the_largest_comes_first():
    cloud, of = scene(jar(-0.1), jar(0.1, height=12))
    label = (of == 0).astype(np.int32)
    things = found(cloud, label, [seeing(of >= 0)] * 3)
    assert np.array_equal(things, np.choose(of, [0, 2, 1]))


def test_what_has_the_label_of_the_surface_on_which_it_stands_is_found():
    cloud, of = scene(jar())
    views = [seeing(of >= 0)] * 3
    for label in (1, np.where(cloud.points[:, 0] < -0.15, 2, 1)):
        assert np.array_equal(found(cloud, np.full(len(of), label), views) > 0, above(cloud, of == 1))


def test_what_stands_on_a_chest_is_found_but_not_its_front():
    front = lying(0.4, 0.1, step=STEP)[:, [0, 2, 1]] + np.array([0, -0.2, -0.06])
    cloud, of = scene(front, jar(0.05))
    assert np.array_equal(found(cloud, np.ones(len(of)), [seeing(of >= 0)] * 3) > 0, above(cloud, of == 2))


@pytest.mark.parametrize(("label", "rise", "is_found"), [(0, 3, True), (0, 4, False), (1, 6, True), (1, 8, False)])
def test_what_stands_on_a_label_needs_to_rise_half_as_far(label, rise, is_found):
    """Half of the block is 3.5 steps high or more; of what counts as standing on the floor, 4."""
    cloud, of = scene(jar(height=6))
    things = found(cloud, np.where(of == 0, 1, label), [seeing(of >= 0)] * 3, rise=rise)
    assert things.any() == is_found


def test_a_part_of_what_has_no_large_side_or_a_large_part_is_no_thing():
    cloud, of = scene(jar())
    cloud.points[of == 0, 2] -= np.random.default_rng(0).uniform(0, 0.4, len(FLOOR))
    assert not found(cloud, np.ones(len(of)), [seeing(of >= 0)] * 3).any()
    cloud, of = scene(jar(height=40))
    assert 0.25 * len(of) < (of > 0).sum() < 0.4 * len(of)
    assert not found(cloud, np.ones(len(of)), [seeing(of >= 0)] * 3).any()


def test_of_very_many_things_the_largest_are_asked_for():
    tufts = [jar(height=9 if n % 4 == 3 else 8) + np.array([0.2 * (n % 12), 0.2 * (n // 12), 0]) for n in range(100)]
    points = np.concatenate(tufts).astype(np.float32)
    of = np.repeat(np.arange(100), [len(tuft) for tuft in tufts])
    cloud = even_cloud(points, np.zeros(points.shape, np.uint8), 1.0, STEP)
    things = found(cloud, np.zeros(len(points)), [seeing(np.ones(len(points), bool))] * 3)
    assert things.max() == 30 and {3, 7, 99} < set(of[things > 0].tolist())


def test_a_dot_in_the_surface_is_no_thing():
    cloud, of = scene(jar())
    label = (of == 0).astype(np.int32)
    label[: len(FLOOR)][DOT] = 0
    views = [seeing(of >= 0)] * 3
    assert np.array_equal(found(cloud, label, views) > 0, of == 1)
    assert np.array_equal(found(cloud, label, views, rise=0.0) > 0, label == 0)


def test_what_is_flat_or_small_is_no_thing():
    cloud, of = scene(jar(height=2), jar(0.1)[:40])
    label = (of == 0).astype(np.int32)
    views = [seeing(of >= 0)] * 3
    assert not found(cloud, label, views, min_points=41).any()
    assert np.array_equal(found(cloud, label, views, min_points=20, rise=1.0) > 0, of > 0)


def test_what_stands_on_nothing_is_a_thing():
    points = jar().astype(np.float32)
    cloud = even_cloud(points, np.zeros(points.shape, np.uint8), 1.0, STEP)
    assert found(cloud, np.zeros(len(points)), [seeing(np.ones(len(points), bool))] * 3).all()


def test_of_what_two_views_see_nobody_can_say_that_masks_are_missing():
    cloud, of = scene(jar())
    label = (of == 0).astype(np.int32)
    views = [seeing(of >= 0), seeing(of >= 0), seeing(of == 0)]
    assert not found(cloud, label, views).any()


HEIGHT, WIDTH = 200, 300
ROW, COLUMN = np.indices((HEIGHT, WIDTH))


class Scripted:
    """A segmenter that answers with a square of 20 pixels in the corner, quite sure."""

    def __init__(self, model: Model) -> None: ...

    def image(self, embedding, *, few):
        return self

    def predict_prompt(self, *_: object) -> tuple[np.ndarray, float]:
        return (ROW < 20) & (COLUMN < 20), 0.9


def answered(monkeypatch: pytest.MonkeyPatch, thing: np.ndarray, *, least: float = 0.8) -> PromptedMasks:
    """What that segmenter answers about these pixels [H, W], with a point at each pixel."""
    monkeypatch.setattr(reprompting, "Sam", Scripted)
    monkeypatch.setattr(reprompting, "decode_valid", lambda frame: np.ones((HEIGHT, WIDTH), bool))
    every = np.arange(HEIGHT * WIDTH, dtype=np.int32)
    frame = Frame("0", WIDTH, HEIGHT, b"", None, WIDTH, HEIGHT)
    return asked(
        EmbeddedPhoto(frame, Embedding(np.zeros((1, 256, 64, 64), np.float32), HEIGHT, WIDTH)),
        Visibility("0", every, every, np.ones(len(every), np.float32), HEIGHT, WIDTH),
        labels_of(thing.ravel()),
        params=RepromptParams(),
        pred_iou=least,
        model=Model("absent", "sam", (), (), ()),
    )


@pytest.mark.parametrize(("columns", "least", "shows"), [(20, 0.8, True), (20, 0.95, False), (8, 0.8, False)])
def test_an_answer_that_is_not_the_thing_or_not_sure_is_empty(monkeypatch, columns, least, shows):
    answer = answered(monkeypatch, (ROW < 20) & (columns > COLUMN), least=least)
    assert answer.label.tolist() == [1]
    assert answer.areas().tolist() == [400 * shows]


@pytest.mark.parametrize(("rows", "columns", "is_asked_for"), [(20, 31, 0), (20, 30, 1), (5, 6, 1), (5, 5, 0)])
def test_what_is_no_small_part_of_a_photo_or_a_tiny_one_is_not_asked_for(monkeypatch, rows, columns, is_asked_for):
    assert len(answered(monkeypatch, (rows > ROW) & (columns > COLUMN)).label) == is_asked_for


def test_what_a_view_was_shown_of_the_things_is_a_mask_of_it(monkeypatch):
    """One that it has already is not there twice, and the other one lies in the mask that holds it."""
    corner, left = (ROW < 20) & (COLUMN < 20), COLUMN < 100
    shown = answered(monkeypatch, corner)
    for own, together in ([left], [left, corner]), ([left, corner], [left, corner]):
        masks = mask_set("0", np.stack(own), np.full(len(own), 0.8, np.float32), "grid")
        more = with_answers(masks, shown, labels_of([0, 1]), grid=3, max_iou=0.8, contained=0.9)
        np.testing.assert_array_equal(more.dense(), np.stack(together))
        assert more.parent.tolist() == [-1, 0]
        assert more.grid.tolist() == [0, 0 if len(own) == 2 else 3]
        assert more.predicted_iou.tolist() == pytest.approx([0.8, 0.8 if len(own) == 2 else 0.9])
    nothing = answered(monkeypatch, corner, least=0.95)
    for given, things in (nothing, [0, 1]), (shown, [0, 0]):
        assert with_answers(masks, given, labels_of(things, 1), grid=3, max_iou=0.8, contained=0.9) is masks


def answers(*shown: list[int] | None) -> list[PromptedMasks]:
    """Of one view each, which of eight pixels it was shown of thing 1; None where it was not asked."""
    return [
        PromptedMasks(
            **vars(Masks.of([np.isin(np.arange(8), pixels)[None] for pixels in given])),
            name="0",
            height=1,
            width=8,
            label=np.ones(len(given), np.int32),
            predicted_iou=np.full(len(given), 0.9, np.float32),
        )
        for given in ([] if pixels is None else [pixels] for pixels in shown)
    ]


def claimed_of(label: list[int], thing: list[int], *shown: list[int] | None, min_points: int = 1):
    """Eight points, which all views see in a row."""
    views = [row_of_points(list(range(8)))[0] for _ in shown]
    given = answers(*shown)
    things = confirmed(labels_of(np.isin(np.arange(8), thing)), given)
    return claimed(views, labels_of(label), things, given, tau_label=0.7, min_points=min_points)


NONE, OWN = [0] * 8, [2, 3]


def test_a_thing_that_half_of_the_views_show_has_a_label_of_its_own():
    done = claimed_of([5, 5, 0, 0, 0, 0, 0, 0], OWN, [2, 3], [2, 3], [], [], None)
    assert done.label.tolist() == [5, 5, 6, 6, 0, 0, 0, 0] and done.num_labels == 6
    assert done.confidence.tolist() == [1, 1, 1, 1, 1, 1, 1, 1]


@pytest.mark.parametrize("shown", [([2, 3], [2, 3], [], [], []), ([2, 3], []), ([2, 3],), (None, None)])
def test_a_thing_that_fewer_show_or_one_alone_has_none(shown):
    done = claimed_of(NONE, OWN, *shown)
    assert not done.label.any() and done.num_labels == 0


def test_what_most_of_the_views_hold_under_its_mask_is_the_things_whatever_label_it_had():
    shown = [[1, 2, 3], [1, 2, 3], [1, 2, 3, 4], [2, 3, 4], []]
    done = claimed_of([7, 7, 0, 0, 7, 0, 0, 0], OWN, *shown)
    assert done.label.tolist() == [7, 8, 8, 8, 7, 0, 0, 0]
    np.testing.assert_allclose(done.confidence[1:4], [0.75, 1, 1])


def test_a_label_of_which_hardly_anything_is_left_goes():
    done = claimed_of([7, 7, 0, 0, 9, 9, 9, 9], OWN, [1, 2, 3], [1, 2, 3], min_points=2)
    assert done.label.tolist() == [0, 10, 10, 10, 9, 9, 9, 9]


def test_how_masks_were_matched_stays():
    labels = replace(labels_of(NONE), match_view=np.array([0]), match_mask=np.array([3]), match_label=np.array([0]))
    views = [row_of_points(list(range(8)))[0]] * 2
    done = claimed(views, labels, labels_of(np.isin(np.arange(8), OWN)), answers(OWN, OWN), tau_label=0.7, min_points=1)
    assert done.match_mask.tolist() == [3]
