import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ss_flow.tasks.artifacts import Cameras
from ss_flow.tasks.deliver.point_view import draw_points, orbit_camera
from ss_flow.tasks.gaussians.native_pass import NEAR_PLANE
from ss_flow.tasks.geometry.cameras import Camera, project

FRONT = Camera(64, 48, 50.0, 50.0, 32.0, 24.0, np.eye(4))


@given(st.integers(0, 50), st.floats(1e-4, 100))
def test_the_orbit_camera_sees_nearly_all_points(seed, size):
    rng = np.random.default_rng(seed)
    points = (rng.uniform(-1, 1, (300, 3)) * [1, 0.5, 2] * size + 7 * min(size, 1)).astype(np.float32)
    camera = orbit_camera(points)
    uv, z = project(points, camera)
    inside = (z > 0) & (uv >= 0).all(axis=1) & (uv < [camera.width, camera.height]).all(axis=1)
    assert inside.mean() > 0.9
    assert (z > NEAR_PLANE).all()
    assert np.ptp(uv, axis=0).max() > 0.3 * camera.height
    np.testing.assert_allclose(camera.world_to_camera[:3, :3] @ camera.world_to_camera[:3, :3].T, np.eye(3), atol=1e-9)
    assert np.linalg.det(camera.world_to_camera[:3, :3]) == pytest.approx(1)


def test_up_is_where_the_photos_have_it():
    points = np.random.default_rng(0).uniform(-1, 1, (200, 3)).astype(np.float32)
    pose = np.eye(4)
    pose[:3, :3] = [[1, 0, 0], [0, 0, -1], [0, 1, 0]]
    cameras = Cameras(("a",), np.array([[9, 9]], np.int32), np.ones((1, 4)), pose[None], True)
    camera = orbit_camera(points, cameras)
    low, high = project(np.array([[0, 0, -0.5], [0, 0, 0.5]]), camera)[0]
    assert high[1] < low[1] and high[0] == pytest.approx(low[0], abs=1)
    assert camera.center[2] > 0


def test_what_was_photographed_from_one_side_is_shown_from_there():
    points = np.random.default_rng(0).uniform(-1, 1, (200, 3)).astype(np.float32)
    turns = np.radians([-20, 0, 35])
    poses = np.tile(np.eye(4), (3, 1, 1))
    for pose, turn in zip(poses, turns, strict=True):
        level = [np.cos(turn), np.sin(turn), 0]  # looks along +x, z is up
        pose[:3, :3] = [np.cross(level, [0, 0, 1]), [0, 0, -1], level]
    cameras = Cameras(("a", "b", "c"), np.full((3, 2), 9, np.int32), np.ones((3, 4)), poses, True)
    front, behind = (orbit_camera(points, cameras, azimuth_deg=turn).center for turn in (0, 180))
    assert front[0] < -1 < 1 < behind[0] and abs(front[1]) < 0.2 * abs(front[0]) and front[2] > 0


def test_without_cameras_a_room_stands_on_its_floor():
    rng = np.random.default_rng(0)
    floor = np.column_stack([rng.uniform(-3, 3, (2000, 2)), np.zeros(2000)])
    wall = np.column_stack([rng.uniform(-3, 3, 800), np.full(800, 3.0), rng.uniform(0, 1.5, 800)])
    camera = orbit_camera(np.concatenate([floor, wall]).astype(np.float32))
    assert camera.center[2] > 1


def test_a_near_point_hides_a_far_one():
    points = np.array([[0, 0, 2], [0, 0, 1]], np.float32)
    colors = np.array([[255, 0, 0], [0, 0, 255]], np.uint8)
    for order in ([0, 1], [1, 0]):
        picture = draw_points(points[order], colors[order], FRONT, 0.001)
        np.testing.assert_array_equal(picture[24, 32], [0, 0, 255])


def test_a_point_covers_as_many_pixels_as_its_spacing():
    one, color = np.array([[0, 0, 1]], np.float32), np.array([[9, 9, 9]], np.uint8)
    drawn = draw_points(one, color, FRONT, 0.12)
    assert (drawn == 9).all(axis=2).sum() == 7 * 7


def test_points_behind_or_beside_the_camera_are_left_out():
    points = np.array([[0, 0, -1], [5, 0, 1]], np.float32)
    picture = draw_points(points, np.zeros((2, 3), np.uint8), FRONT, 0.01)
    assert picture.shape == (48, 64, 3) and picture.min() > 200


def test_depth_edges_are_shaded():
    x, y = np.meshgrid(np.linspace(-1, 1, 200), np.linspace(-1, 1, 200))
    near = np.column_stack([x.ravel() * 0.2, y.ravel() * 0.2, np.full(x.size, 1.0)])
    far = np.column_stack([x.ravel() * 2, y.ravel() * 2, np.full(x.size, 3.0)])
    points = np.concatenate([near, far]).astype(np.float32)
    picture = draw_points(points, np.full((len(points), 3), 200, np.uint8), FRONT, 0.01)
    assert picture[24, 32, 0] == 200 and picture[2, 2, 0] == 200
    assert picture[24, :, 0].min() < 130
