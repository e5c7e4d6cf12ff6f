import tracemalloc

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ss_flow.tasks.artifacts import Cameras, DepthMap
from ss_flow.tasks.geometry import fusion
from ss_flow.tasks.geometry.fusion import VoxelSums, consistent_points, depth_at, depth_noise, finest, sum_by_voxel


def samples(points, color=0.0, side=0.0):
    points = np.asarray(points, float)
    return VoxelSums(points, np.full((len(points), 3), color), np.ones(len(points)), np.full(len(points), side))


def test_points_of_one_voxel_are_averaged_by_weight():
    once = sum_by_voxel([samples([[-0.4, 0.1, 0.1], [-0.2, 0.1, 0.1], [1.0, 0, 0]], 30)], 1.0)
    twice = sum_by_voxel([once, samples([[0.3, 0.1, 0.1]], 90)], 1.0)
    position, color = twice.means()
    np.testing.assert_allclose(position, [[-0.1, 0.1, 0.1], [1.0, 0, 0]])
    np.testing.assert_allclose(color, [[50] * 3, [30] * 3])
    assert twice.weight.tolist() == [3, 1]


def test_many_views_are_added_up_as_they_come_and_never_held_at_once(monkeypatch):
    def views():
        for seed in range(60):
            yield samples(np.random.default_rng(seed).uniform(-5, 5, (4000, 3)), seed)

    whole = sum_by_voxel(list(views()), 1.0)
    monkeypatch.setattr(fusion, "_AT_ONCE", 6000)
    tracemalloc.start()
    found = sum_by_voxel(views(), 1.0)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 60 * 4000 * 64 / 4
    np.testing.assert_allclose(found.position, whole.position, atol=1e-9)
    np.testing.assert_allclose(found.color, whole.color)
    assert found.weight.tolist() == whole.weight.tolist()


@settings(deadline=None)
@given(st.integers(0, 1000), st.floats(0.05, 3.0))
def test_summing_agrees_with_a_dictionary_of_voxels(seed, voxel):
    points = np.random.default_rng(seed).normal(0, 2, (60, 3))
    cells = {}
    for p in points:
        cells.setdefault(tuple(np.floor(p / voxel + 0.5).astype(int)), []).append(p)
    expected = sorted(tuple(np.mean(c, axis=0)) for c in cells.values())
    found = sorted(map(tuple, sum_by_voxel([samples(points)], voxel).means()[0]))
    np.testing.assert_allclose(found, expected)


def test_points_that_are_to_have_larger_cubes_have_them_and_follow_the_others():
    near = samples(np.array([[0.1, 0, 0], [-0.2, 0, 0], [1.2, 0, 0]]), side=1.9)
    far = samples(np.array([[4.4, 0, 0], [5.1, 0, 0], [8.0, 0, 0]]), side=4.1)
    found = sum_by_voxel([far, near], 1.0)
    np.testing.assert_allclose(found.means()[0][:, 0], [-0.05, 1.2, 4.75, 8.0])
    assert found.weight.tolist() == [2, 1, 2, 1]
    again = sum_by_voxel([found], 1.0)
    np.testing.assert_allclose(again.position, found.position)
    coarse = sum_by_voxel([found], 8.0)  # now all fit the same size
    assert coarse.weight.tolist() == [3, 3]


def test_where_a_view_was_near_the_larger_cubes_of_far_views_are_left_out():
    near = samples([[0.1, 0, 0], [1.2, 0, 0]], side=1.0)
    far = samples([[0.9, 0, 0], [8.0, 0, 0], [30.0, 0, 0]], side=4.0)  # the first lies in a cube with both near ones
    farther = samples([[9.0, 0, 0], [70.0, 0, 0]], side=16.0)
    found = finest(sum_by_voxel([near, far, farther], 1.0), 1.0)
    assert found.means()[0][:, 0].tolist() == [0.1, 1.2, 8.0, 30.0, 70.0]
    assert found.sides(1.0).tolist() == [1, 1, 4, 4, 16]


def test_depth_of_a_smaller_map_is_read_at_the_pixel_centre():
    depth = DepthMap("0", np.array([[1.0, 2.0], [3.0, 4.0]], np.float32), "sensor")
    column, row = np.array([0, 1, 2, 3, 1]), np.array([0, 0, 0, 3, 2])
    assert depth_at(depth, column, row, 4, 4).tolist() == [1, 1, 2, 4, 3]


def test_a_pixel_centre_between_two_pixels_of_the_map_is_in_the_second():
    depth = DepthMap("0", np.arange(30, dtype=np.float32)[None], "sensor")
    row, column = np.zeros(11, int), np.arange(11)
    assert depth_at(depth, column, row, 11, 1)[5] == 15  # 5.5 * 30 / 11 = 15


def four_equal_views(distances):
    """Cameras at the same place that measure a wall at different distances."""
    k = len(distances)
    cameras = Cameras(
        tuple("abcd"[:k]),
        np.full((k, 2), 10, np.int32),
        np.tile([10.0, 10.0, 5.0, 5.0], (k, 1)),
        np.tile(np.eye(4), (k, 1, 1)),
        True,
    )
    return cameras, tuple(DepthMap("x", np.full((10, 10), d, np.float32), "sensor") for d in distances)


def test_a_point_that_the_other_views_look_through_is_dropped():
    cameras, depths = four_equal_views([1.0, 3.0, 3.0])
    points = np.array([[0.0, 0, 1.0], [0, 0, 3.0]])
    kept = consistent_points(points, cameras, depths, tau=0.02, tau_relative=0, min_views=2)
    assert kept.tolist() == [False, True]


def test_a_point_that_only_one_view_sees_needs_no_second():
    cameras, depths = four_equal_views([3.0, 1.0, 0.0])
    kept = consistent_points(np.array([[0.0, 0, 3.0]]), cameras, depths, tau=0.02, tau_relative=0, min_views=2)
    assert kept.tolist() == [True]


def test_a_point_that_no_view_confirms_is_dropped():
    cameras, depths = four_equal_views([0.0])
    kept = consistent_points(np.array([[0.0, 0, 3.0]]), cameras, depths, tau=0.02, tau_relative=0, min_views=2)
    assert kept.tolist() == [False]


def test_the_noise_of_depth_is_a_share_of_it_and_leaves_out_other_surfaces_and_unknown_depth():
    cameras, _ = four_equal_views([2.0, 2.0])
    rng = np.random.default_rng(0)
    pixel = np.arange(10) + 0.5
    points = np.stack([*np.meshgrid((pixel - 5) / 5, (pixel - 5) / 5), np.full((10, 10), 2.0)], axis=-1).reshape(-1, 3)
    noisy = [(2 + rng.normal(0, 0.02, (10, 10))).astype(np.float32) for _ in range(2)]
    noisy[0][:3], noisy[1][:2] = 1.5, 0  # something before the wall; nothing measured
    depths = tuple(DepthMap("x", depth, "sensor") for depth in noisy)
    assert depth_noise(points, cameras, depths) == pytest.approx(0.01, rel=0.2)
    exact = tuple(DepthMap("x", np.full((10, 10), 2, np.float32), "sensor") for _ in range(2))
    assert depth_noise(points, cameras, exact) == pytest.approx(0, abs=1e-6)
    assert depth_noise(points[:0], cameras, exact) == 0
