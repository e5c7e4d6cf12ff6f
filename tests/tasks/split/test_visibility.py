from dataclasses import replace

import box_scene
import numpy as np
from clouds import even_cloud
from hypothesis import given, settings
from hypothesis import strategies as st

from ss_flow.tasks.artifacts import Cameras, DepthMap
from ss_flow.tasks.geometry.cameras import camera_of
from ss_flow.tasks.geometry.visibility import VisibilityParams
from ss_flow.tasks.split.visibility import visibility


def cloud(points, unit=1.0):
    points = np.asarray(points, np.float32)
    return even_cloud(points, np.zeros((len(points), 3), np.uint8), unit, 0.01)


def one_camera(depth):
    """A 4 x 2 camera at the origin, focal length 2, with the given depth everywhere."""
    cameras = Cameras(("a",), np.array([[4, 2]], np.int32), np.array([[2.0, 2.0, 2.0, 1.0]]), np.eye(4)[None], True)
    return cameras, DepthMap("a", np.full((2, 4), depth, np.float32), "sensor")


def test_only_points_on_the_measured_surface_are_visible():
    cameras, depth = one_camera(1.0)
    points = cloud(
        [
            [0.1, 0.1, 1.0],  # on the surface: pixel (2, 1)
            [-0.6, -0.3, 1.01],  # within tau: pixel (0, 0)
            [0.1, 0.1, 1.03],  # behind it
            [0.1, 0.1, 0.97],  # in front of it
            [0.1, 0.1, -1.0],  # behind the camera
            [1.2, 0.1, 1.0],  # right of the image: u = 4.4
        ]
    )
    seen = visibility(points, camera_of(cameras, 0), depth, params=VisibilityParams(0.02))
    assert seen.point_index.tolist() == [0, 1]
    assert seen.pixel.tolist() == [1 * 4 + 2, 0]
    np.testing.assert_allclose(seen.depth, [1.0, 1.01])
    assert (seen.height, seen.width, seen.name) == (2, 4, "a")


def test_unknown_depth_shows_nothing_even_close_to_the_camera():
    cameras, depth = one_camera(0.0)
    assert not len(
        visibility(cloud([[0, 0, 0.01]]), camera_of(cameras, 0), depth, params=VisibilityParams(0.02)).point_index
    )


def test_the_tolerance_grows_with_the_noise_of_the_depth():
    cameras, depth = one_camera(10.0)
    points = cloud([[0, 0, 10.25]])
    params = VisibilityParams(0.02, 0, deviations=150)
    for noise, seen in ((0.0, 0), (0.008, 0), (0.009, 1)):
        noisy = replace(points, noise=noise)
        assert len(visibility(noisy, camera_of(cameras, 0), depth, params=params).pixel) == seen
        assert not len(visibility(noisy, camera_of(cameras, 0), depth, params=replace(params, deviations=0)).pixel)


def test_the_tolerance_grows_with_the_unit_and_with_depth():
    cameras, depth = one_camera(10.0)
    points = cloud([[0, 0, 10.05]])
    assert not len(visibility(points, camera_of(cameras, 0), depth, params=VisibilityParams(0.02, 0)).pixel)
    assert len(visibility(points, camera_of(cameras, 0), depth, params=VisibilityParams(0.02, 0.5)).pixel)
    assert len(
        visibility(
            cloud([[0, 0, 10.05]], unit=3.0), camera_of(cameras, 0), depth, params=VisibilityParams(0.02, 0)
        ).pixel
    )


def test_depth_that_errs_by_a_share_of_itself_is_seen_in_a_hall_as_in_a_room():
    pixels = np.stack(np.meshgrid([0.5, 1.5, 2.5, 3.5], [0.5, 1.5]), axis=-1).reshape(-1, 2)
    rays = np.column_stack([(pixels - (2, 1)) / 2, np.ones(8)])
    for metres in (2.0, 20.0):
        cameras, depth = one_camera(metres)
        wrong = replace(depth, depth=depth.depth * np.float32([[1.004, 0.996] * 2] * 2))
        seen = visibility(cloud(rays * metres), camera_of(cameras, 0), wrong, params=VisibilityParams())
        assert len(seen.pixel) == 8, metres
        behind = visibility(cloud(rays * metres * 1.04), camera_of(cameras, 0), wrong, params=VisibilityParams())
        assert not len(behind.pixel), metres


@settings(deadline=None, max_examples=20)
@given(st.integers(0, box_scene.VIEWS - 1), st.integers(0, 100))
def test_it_agrees_with_equations_1_and_2_point_by_point(view, seed):
    points = cloud(np.random.default_rng(seed).uniform((-1, -1, -0.01), (1, 1, 0.02), (300, 3)))
    cameras, depth = box_scene.cameras(), box_scene.depths()[view]
    camera = camera_of(cameras, view)
    expected = []
    for i, p in enumerate(points.points):
        x, y, z = camera.world_to_camera[:3, :3] @ p + camera.world_to_camera[:3, 3]
        w, h = int(np.floor(camera.fx * x / z + camera.cx)), int(np.floor(camera.fy * y / z + camera.cy))
        inside = z > 0 and 0 <= w < camera.width and 0 <= h < camera.height
        if inside and depth.depth[h, w] > 0 and abs(depth.depth[h, w] - z) < 0.02:
            expected.append((i, h * camera.width + w))
    seen = visibility(points, camera_of(cameras, view), depth, params=VisibilityParams(0.02, 0))
    assert list(zip(seen.point_index.tolist(), seen.pixel.tolist(), strict=True)) == expected


@settings(deadline=None, max_examples=20)
@given(st.integers(0, box_scene.VIEWS - 1), st.integers(0, 100), st.lists(st.floats(1e-4, 1.0), min_size=2, max_size=2))
def test_raising_the_threshold_removes_no_point(view, seed, thresholds):
    points = cloud(np.random.default_rng(seed).uniform((-1, -1, -0.1), (1, 1, 0.1), (300, 3)))
    cameras, depth = box_scene.cameras(), box_scene.depths()[view]
    few, many = (
        visibility(points, camera_of(cameras, view), depth, params=VisibilityParams(tau, 0))
        for tau in sorted(thresholds)
    )
    assert set(zip(few.point_index.tolist(), few.pixel.tolist(), strict=True)) <= set(
        zip(many.point_index.tolist(), many.pixel.tolist(), strict=True)
    )
