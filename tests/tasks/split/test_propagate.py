"""Labels of a scene of boxes: right for true masks, and the same however masks, views and units are given."""

from dataclasses import replace

import box_scene
import numpy as np
import pytest
from box_scene import mask_set, permuted, true_masks
from hypothesis import given, settings
from hypothesis import strategies as st
from labelled_rows import BARE, run
from scipy.optimize import linear_sum_assignment

from ss_flow.tasks.capture.views import unit
from ss_flow.tasks.geometry.cameras import camera_of
from ss_flow.tasks.geometry.visibility import VisibilityParams
from ss_flow.tasks.split.dense import DenseParams, dense
from ss_flow.tasks.split.observe import ClusterParams, ObserveParams
from ss_flow.tasks.split.propagate import PropagateParams
from ss_flow.tasks.split.visibility import visibility
from ss_flow.tasks.split.votes.at_once import MaskClusteringParams
from ss_flow.tasks.split.votes.in_turn import SequentialParams


@pytest.fixture(scope="module")
def boxes():
    cameras, depths = box_scene.cameras(), box_scene.depths()
    cloud = dense(box_scene.frames(), cameras, depths, unit(cameras, depths), params=DenseParams())
    seen = tuple(visibility(cloud, camera_of(cameras, k), d, params=VisibilityParams()) for k, d in enumerate(depths))
    return cloud, seen


def degraded(seed):
    """True masks of the boxes with ragged borders, halves in some views, and one that covers two boxes."""
    random = np.random.default_rng(seed)
    sets = []
    for pool in true_masks():
        masks = list(pool.dense())
        if random.random() < 0.5:
            i = int(random.integers(len(masks)))
            _, u = np.nonzero(masks[i])
            left = masks[i].copy()
            left[:, int(np.median(u)) :] = False
            masks.append(left)
        noise = random.random((len(masks), *masks[0].shape)) < 0.02
        sets.append(mask_set(np.stack(masks) ^ (noise & np.stack(masks)), pool.name))
    first = sets[0].dense()
    sets[0] = mask_set(np.concatenate([first, (first[0] | first[1])[None]]), "0")
    return tuple(sets)


DEFAULTS = (
    (PropagateParams(), ObserveParams()),
    (PropagateParams(views="in_turn", in_turn=SequentialParams(passes=2)), ObserveParams()),
    (PropagateParams(views="in_turn"), ObserveParams(nested=True)),
)


@pytest.mark.parametrize("params", DEFAULTS)
def test_true_masks_give_each_box_one_label_in_all_views(boxes, params):
    cloud, seen = boxes
    result = run(cloud, seen, true_masks(), *params)
    for number, (low, high) in enumerate(box_scene.BOXES, start=1):
        inner = ((cloud.points > low + 0.03 * (low > 0)) & (cloud.points < high + 0.01)).all(axis=1)
        inner &= (cloud.points[:, 2] > 0.05) & (cloud.points[:, 0] > low[0] - 0.01)
        labels, counts = np.unique(result.label[inner], return_counts=True)
        assert counts.max() / counts.sum() > 0.9, number
        assert labels[counts.argmax()] > 0
    assert len(np.unique(result.label)) == 4


@settings(deadline=None, max_examples=8)
@given(seed=st.integers(0, 1000))
@pytest.mark.parametrize("params", DEFAULTS)
def test_permuting_the_masks_of_every_view_changes_no_label(boxes, params, seed):
    cloud, seen = boxes
    masks = degraded(seed)
    random = np.random.default_rng(seed)
    shuffled = tuple(permuted(m, random.permutation(len(m))) for m in masks)
    a, b = (run(cloud, seen, m, *params) for m in (masks, shuffled))
    assert a.label.tobytes() == b.label.tobytes()
    assert a.confidence.tobytes() == b.confidence.tobytes()


@settings(deadline=None, max_examples=8)
@given(scale=st.floats(0.01, 100), seed=st.integers(0, 1000))
def test_scaling_the_world_changes_no_label(boxes, scale, seed):
    cloud, seen = boxes
    clusters = ClusterParams(eps=5.0)
    params = (
        PropagateParams(label_clusters=replace(clusters, eps=2.5, keep_share=0.05)),
        ObserveParams(clusters=clusters),
    )
    scaled = replace(cloud, points=cloud.points * np.float32(scale), unit=scale, spacing=cloud.spacing * scale)
    far = tuple(replace(v, depth=v.depth * np.float32(scale)) for v in seen)
    masks = degraded(seed)
    a, b = run(cloud, seen, masks, *params), run(scaled, far, masks, *params)
    assert (a.label == b.label).mean() > 0.999


@pytest.mark.parametrize("scale", [1 / 64, 64.0])
def test_scaling_the_world_changes_no_label_from_depth_to_labels(scale):
    labels = []
    for size in (0.5, scale):
        cameras, depths = box_scene.cameras(size), box_scene.depths(size)
        cloud = dense(box_scene.frames(), cameras, depths, unit(cameras, depths), params=DenseParams())
        seen = tuple(
            visibility(cloud, camera_of(cameras, k), d, params=VisibilityParams()) for k, d in enumerate(depths)
        )
        labels.append(run(cloud, seen, degraded(3), PropagateParams()).label)
    assert labels[0].tobytes() == labels[1].tobytes()


def test_clustering_keeps_stray_points_of_a_mask_from_voting(boxes):
    cloud, seen = boxes
    masks = list(true_masks())
    first = masks[0].dense().copy()
    first[0, :12, :12] = True  # a patch of the far floor
    masks[0] = mask_set(first, "0")
    only = (seen[0],), (masks[0],)
    cleaned = ObserveParams(clusters=ClusterParams(eps=5.0, keep_share=1.0))
    stray = (seen[0].pixel % box_scene.WIDTH < 9) & (seen[0].pixel // box_scene.WIDTH < 9)
    assert stray.any()
    rows = seen[0].point_index[stray]
    assert (run(cloud, *only, BARE).label[rows] > 0).all()
    assert (run(cloud, *only, BARE, cleaned).label[rows] == 0).all()


def test_views_without_masks_label_nothing(boxes):
    cloud, seen = boxes
    nothing = tuple(mask_set(np.zeros((0, box_scene.HEIGHT, box_scene.WIDTH), bool), v.name) for v in seen)
    result = run(cloud, seen, nothing, PropagateParams())
    assert not result.label.any()
    assert result.num_labels == 0
    assert len(result.match_mask) == 0


def relabelled(a, b):
    """Share of the points whose label in `b` is not what their label in `a` became."""
    table = np.zeros((a.max() + 1, b.max() + 1), int)
    np.add.at(table, (a, b), 1)
    rows, columns = linear_sum_assignment(-table[1:, 1:])
    return 1 - (table[1:, 1:][rows, columns].sum() + table[0, 0]) / len(a)


@settings(deadline=None, max_examples=8)
@given(seed=st.integers(0, 1000))
def test_permuting_the_views_changes_no_label(boxes, seed):
    cloud, seen = boxes
    masks = degraded(seed)
    order = np.random.default_rng(seed).permutation(len(seen))
    a = run(cloud, seen, masks, PropagateParams())
    b = run(cloud, tuple(seen[k] for k in order), tuple(masks[k] for k in order), PropagateParams())
    assert a.label.tobytes() == b.label.tobytes()


@settings(deadline=None, max_examples=8)
@given(seed=st.integers(0, 1000))
def test_seeing_every_view_twice_changes_no_label(boxes, seed):
    cloud, seen = boxes
    masks = degraded(seed)
    a, b = run(cloud, seen, masks, PropagateParams()), run(cloud, 2 * seen, 2 * masks, PropagateParams())
    assert a.label.tobytes() == b.label.tobytes()


def test_views_clustered_in_lots_give_the_same_labels(boxes):
    cloud, seen = boxes
    few = PropagateParams(at_once=MaskClusteringParams(max_views=3))
    a, b = run(cloud, seen, true_masks(), PropagateParams()), run(cloud, seen, true_masks(), few)
    assert relabelled(a.label, b.label) < 0.01
    assert set(b.match_view.tolist()) == set(range(len(seen)))
