import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree

from ss_flow.tasks.geometry.clustering import dbscan, main_clusters, nearest_spacing, nearest_within


def slow_dbscan(points, eps, min_samples):
    """The definition, point by point, with our rule for border points: the lowest cluster in reach."""
    reach = np.broadcast_to(eps, len(points))
    near = np.linalg.norm(points[:, None] - points[None], axis=-1) <= np.maximum(reach[:, None], reach)
    core = near.sum(axis=1) >= min_samples
    cluster = np.full(len(points), -1)
    number = 0
    for start in range(len(points)):
        if core[start] and cluster[start] < 0:
            stack = [start]
            while stack:
                p = stack.pop()
                if cluster[p] < 0:
                    cluster[p] = number
                    stack += [q for q in np.flatnonzero(near[p] & core) if cluster[q] < 0]
            number += 1
    for p in np.flatnonzero(~core):
        reachable = cluster[near[p] & core]
        cluster[p] = reachable.min() if len(reachable) else -1
    return cluster


@settings(deadline=None, max_examples=60)
@given(st.integers(0, 10_000), st.integers(0, 60), st.integers(1, 6), st.floats(0.05, 0.5))
def test_dbscan_agrees_with_its_definition(seed, count, min_samples, eps):
    points = np.random.default_rng(seed).random((count, 3))
    assert dbscan(points, eps, min_samples).tolist() == slow_dbscan(points, eps, min_samples).tolist()


@settings(deadline=None, max_examples=60)
@given(st.integers(0, 10_000), st.integers(0, 60), st.integers(1, 6), st.floats(0.05, 0.5))
def test_of_two_points_the_farther_reach_counts(seed, count, min_samples, eps):
    random = np.random.default_rng(seed)
    points, reach = random.random((count, 3)), np.float32(eps) * 2.0 ** random.integers(-1, 2, count, np.int32)
    assert dbscan(points, reach, min_samples).tolist() == slow_dbscan(points, reach, min_samples).tolist()


@settings(deadline=None, max_examples=60)
@given(st.integers(0, 10_000), st.integers(1, 60), st.integers(1, 5))
def test_the_points_within_reach_of_each_place_are_those_of_the_definition(seed, count, asked):
    random = np.random.default_rng(seed)
    points, places = random.random((count, 3)), random.random((7, 3))
    reach = random.random(7).astype(np.float32)
    distance = np.linalg.norm(places[:, None] - points, axis=-1)
    order = np.argsort(distance, axis=1)[:, :asked]
    expected = np.full((7, asked), count)
    expected[:, : order.shape[1]] = np.where(np.take_along_axis(distance, order, axis=1) < reach[:, None], order, count)
    assert nearest_within(cKDTree(points), places, asked, reach).tolist() == expected.tolist()


def two_blobs():
    random = np.random.default_rng(0)
    large = random.normal(0, 0.05, (300, 3))
    small = random.normal((3, 0, 0), 0.05, (40, 3))
    return np.concatenate([large, small, [[10.0, 0, 0]]])


def test_main_clusters_keep_what_has_its_share_and_always_the_largest():
    blobs = two_blobs()
    both = main_clusters(blobs, 0.2, 5, 0.1)
    assert both[:340].sum() >= 338
    assert not both[340]
    only_large = main_clusters(blobs, 0.2, 5, 1.0)
    assert only_large[:300].sum() >= 298
    assert not only_large[300:].any()


def test_all_points_are_kept_where_there_are_more_clusters_than_allowed():
    blobs = two_blobs()
    assert main_clusters(blobs, 0.2, 5, 1.0, max_clusters=1).all()
    assert not main_clusters(blobs, 0.2, 5, 1.0, max_clusters=2)[300:].any()


def test_points_too_sparse_for_any_cluster_are_all_kept():
    assert main_clusters(np.eye(3) * 5, 0.1, 2, 0.1).all()
    assert main_clusters(np.zeros((0, 3)), 0.1, 2, 0.1).shape == (0,)


def test_spacing_of_a_grid_is_its_step():
    grid = np.stack(np.meshgrid(range(5), range(5), [0]), axis=-1).reshape(-1, 3) * 0.25
    assert nearest_spacing(grid) == pytest.approx(0.25)
    assert nearest_spacing(grid[:1]) == 0.0
