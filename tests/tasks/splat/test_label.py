"""Labels of given Gaussians: votes of the pixels that they show in, and what becomes of those that show nowhere."""

from __future__ import annotations

from dataclasses import fields, replace

import box_scene
import numpy as np
import pytest
from clouds import even_cloud
from hypothesis import given
from hypothesis import strategies as st
from made_gaussians import made_cameras, made_gaussians

from ss_flow.tasks.artifacts import Gaussians, LabelMap, PointLabels, PointParts
from ss_flow.tasks.gaussians.initialise import concatenate, initialise, select
from ss_flow.tasks.gaussians.render import render, shares
from ss_flow.tasks.geometry.cameras import backproject, camera_of
from ss_flow.tasks.geometry.images import encode_png
from ss_flow.tasks.splat.label import LabelParams, ViewVotes, label, own_gaussians, vote

CAMERAS = [camera_of(box_scene.cameras(), view) for view in range(box_scene.VIEWS)]
FRAMES = box_scene.frames()
TRUE = [LabelMap(frame.name, box_scene.cast(view)[1].astype(np.uint16)) for view, frame in enumerate(FRAMES)]
NO_CLOUD = (
    even_cloud(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8), 1.0, 0.01),
    PointLabels(*(np.zeros(0, kind) for kind in (np.int32, np.float32)), 0, *(np.zeros(0, np.int32),) * 3),
    PointParts(np.zeros(0, np.int32)),
)


@pytest.fixture(scope="module")
def boxes() -> tuple[Gaussians, np.ndarray]:
    """The boxes and their floor as opaque Gaussians that have no labels, and the true ones."""
    points, ids = [], []
    for view, camera in enumerate(CAMERAS):
        depth, of_pixel = box_scene.cast(view)
        points.append(backproject(depth, camera)[::3])
        ids.append(of_pixel.ravel()[::3])
    places, true = np.concatenate(points).astype(np.float32), np.concatenate(ids)
    made = initialise(places, box_scene.COLORS[true], 0, 0.0, opacity=0.95)
    return replace(made, log_scales=np.full_like(made.log_scales, np.log(0.012))), true


def labelled(scene: Gaussians, maps=TRUE, params: LabelParams = LabelParams(), cloud=NO_CLOUD) -> Gaussians:
    votes = [vote.function(scene, *of_view) for of_view in zip(FRAMES, CAMERAS, maps, strict=True)]
    return label.function(scene, votes, *cloud, params=params)


def votes_of(*rows: tuple[int, int, int]) -> ViewVotes:
    gaussian, of_label, weight = np.array(sorted(rows), np.int32).reshape(-1, 3).T
    return ViewVotes("0", gaussian, of_label, weight.astype(np.float32))


def line(count: int, gap: float = 0.01) -> Gaussians:
    places = np.zeros((count, 3), np.float32)
    places[:, 0] = gap * np.arange(count)
    return initialise(places, np.zeros((count, 3), np.uint8), 0, 0.0)


def test_gaussians_take_the_label_of_the_box_that_they_lie_on_and_keep_all_else(boxes):
    scene, true = boxes
    found = labelled(scene)
    voted = found.instance_conf > 0
    assert voted.mean() > 0.9
    assert (found.instance_id == true).mean() > 0.97
    for item in fields(Gaussians):
        if item.name not in ("instance_id", "instance_conf", "part_id"):
            np.testing.assert_array_equal(getattr(found, item.name), getattr(scene, item.name))


def test_pixels_that_a_frame_does_not_count_have_no_vote(boxes):
    scene, _ = boxes
    nothing = encode_png(np.zeros((box_scene.HEIGHT, box_scene.WIDTH), np.uint8))
    masked = vote.function(scene, replace(FRAMES[0], valid=nothing), CAMERAS[0], TRUE[0])
    assert not len(masked.gaussian)


def test_the_votes_of_a_view_are_its_pixels_shared_out_by_weight(boxes):
    scene, _ = boxes
    votes = vote.function(scene, FRAMES[0], CAMERAS[0], TRUE[0])
    alpha = render(scene, CAMERAS[0]).alpha
    for one in (0, 1, 2, 3):
        given_out = votes.weight[votes.label == one].sum()
        assert given_out == pytest.approx(alpha[TRUE[0].ids == one].sum(), rel=0.01)
    top = render(scene, CAMERAS[0]).top_contributor
    assert np.isin(top[top >= 0], votes.gaussian).all()


@pytest.mark.parametrize("degree", [0, 2])
def test_what_a_gaussian_shows_of_an_id_is_its_mask_channel_there(degree):
    """The weights of one Gaussian in the pixels of an id: the mask image of a label that only this Gaussian has."""
    scene, camera = made_gaussians(12, degree), camera_of(made_cameras(), 0)
    ids = np.add.outer(np.arange(camera.height) // 30, np.arange(camera.width) // 40) % 5 - 1
    found = shares(scene, camera, ids)
    assert np.unique(found.id).tolist() == [0, 1, 2, 3] and (np.diff(found.id * 12 + found.row) > 0).all()
    alone = replace(scene, instance_id=np.arange(12, dtype=np.int32))
    images = render(alone, camera, label_ids=range(12)).label_masks
    weights = np.zeros((4, 12), np.float32)
    weights[found.id, found.row] = found.weight
    for one in range(4):
        np.testing.assert_allclose(weights[one], images[:, ids == one].sum(axis=1), rtol=1e-4, atol=1e-4)


def test_the_label_with_most_votes_over_all_views_wins_and_the_lower_one_of_equals():
    views = [votes_of((0, 7, 3), (1, 2, 5)), votes_of((0, 4, 2), (1, 5, 5)), votes_of((0, 4, 2))]
    found = label.function(line(2), views, *NO_CLOUD, params=LabelParams())
    assert found.instance_id.tolist() == [4, 2]
    np.testing.assert_allclose(found.instance_conf, [4 / 7, 0.5])


def test_a_gaussian_without_votes_takes_its_neighbours_label_and_is_marked_by_no_confidence():
    views = [votes_of((0, 3, 9), (1, 3, 1), (3, 8, 4), (4, 3, 4))]
    found = label.function(line(5), views, *NO_CLOUD, params=LabelParams(neighbours=3))
    assert found.instance_id.tolist() == [3, 3, 3, 8, 3]
    assert found.instance_conf.tolist() == [1, 1, 0, 1, 1]


def test_a_gaussian_far_from_all_that_have_votes_is_background():
    views = [votes_of((0, 3, 9))]
    found = label.function(line(3, gap=0.08), views, *NO_CLOUD, params=LabelParams(reach=0.1))
    assert found.instance_id.tolist() == [3, 3, 0]


def test_a_scene_of_which_nothing_is_voted_for_is_background(monkeypatch):
    said: list[str] = []
    monkeypatch.setattr("ss_flow.tasks.splat.label.warn", said.append)
    found = label.function(line(3), [votes_of()], *NO_CLOUD, params=LabelParams())
    assert not found.instance_id.any() and not found.instance_conf.any()
    assert len(said) == 1


@given(seed=st.integers(0, 20), count=st.integers(1, 30))
def test_the_order_of_the_views_changes_nothing(seed, count):
    rng = np.random.default_rng(seed)
    views = []
    for _ in range(4):
        pairs = {(int(g), int(i)) for g, i in rng.integers(0, (count, 4), (20, 2))}
        views.append(votes_of(*((g, i, int(rng.integers(1, 9))) for g, i in pairs)))
    scene = line(count)
    first = label.function(scene, views, *NO_CLOUD, params=LabelParams())
    other = label.function(scene, views[::-1], *NO_CLOUD, params=LabelParams())
    np.testing.assert_array_equal(first.instance_id, other.instance_id)
    np.testing.assert_array_equal(first.instance_conf, other.instance_conf)


def test_parts_are_those_of_the_nearest_point_of_the_same_instance():
    points = np.zeros((4, 3), np.float32)
    points[:, 0] = (0.0, 0.011, 0.012, 0.03)
    cloud = replace(NO_CLOUD[0], points=points, colors=np.zeros((4, 3), np.uint8))
    ids, parts = np.array([3, 3, 8, 3], np.int32), np.array([1, 2, 5, 4], np.int32)
    known = replace(NO_CLOUD[1], label=ids, confidence=np.ones(4, np.float32), num_labels=8)
    views = [votes_of((0, 3, 1), (1, 3, 1), (2, 0, 1))]
    found = label.function(line(3), views, cloud, known, PointParts(parts), params=LabelParams())
    assert found.part_id.tolist() == [1, 2, 0]


def test_the_gaussians_of_an_instance_are_its_rows(boxes):
    scene, _ = boxes
    found = labelled(scene)
    other = concatenate([own_gaussians.function(found, _Instance(i)) for i in (0, 1, 2, 3)])
    assert len(other) == len(found)
    np.testing.assert_array_equal(
        own_gaussians.function(found, _Instance(2)).means, select(found, found.instance_id == 2).means
    )


class _Instance:
    """As much of an instance as is asked for."""

    def __init__(self, instance_id: int) -> None:
        self.instance_id = instance_id
