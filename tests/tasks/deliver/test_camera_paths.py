"""The cameras of films."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from made_gaussians import made_cameras, made_gaussians

from ss_flow.tasks.deliver.camera_paths import along, round_instance, round_scene
from ss_flow.tasks.geometry.cameras import looking, project

CIRCLE = made_cameras(tuple((3 * np.cos(a), 3 * np.sin(a), 1.0) for a in np.linspace(0, 5, 8)))


def is_rigid(pose: np.ndarray) -> bool:
    rotation = pose[:3, :3]
    return np.allclose(rotation @ rotation.T, np.eye(3)) and np.linalg.det(rotation) > 0


def test_a_path_of_no_count_is_the_input_views():
    path = along(CIRCLE, frames=0)
    for view, camera in enumerate(path):
        np.testing.assert_array_equal(camera.world_to_camera, CIRCLE.world_to_camera[view])


def test_a_path_goes_through_the_input_views_and_is_smooth_between():
    cameras = CIRCLE
    path = along(cameras, frames=10 * (len(cameras) - 1) + 1)
    assert all(is_rigid(camera.world_to_camera) for camera in path)
    for view in range(len(cameras)):
        np.testing.assert_allclose(path[10 * view].world_to_camera, cameras.world_to_camera[view], atol=1e-9)
    steps = np.diff([camera.center for camera in path], axis=0)
    turns = np.linalg.norm(np.diff(steps, axis=0), axis=1)
    assert turns.max() < 0.2 * np.linalg.norm(steps, axis=1).mean()


def test_photos_of_another_shape_are_fitted_into_the_film_and_not_stretched():
    upright = CIRCLE.sizes.copy()
    upright[:] = 96, 54
    upright[3] = 54, 96
    middles = CIRCLE.intrinsics.copy()
    middles[:, 2:] = upright / 2
    path = along(replace(CIRCLE, sizes=upright, intrinsics=middles), frames=len(CIRCLE))
    assert {(camera.width, camera.height) for camera in path} == {(96, 54)}
    assert all(camera.fx == camera.fy for camera in path)
    # All that the upright photo shows is in the picture: it is 96 rows high, which 54 rows now show.
    assert path[3].fy == pytest.approx(CIRCLE.intrinsics[3, 1] * 54 / 96) and (path[3].cx, path[3].cy) == (48, 27)
    assert [camera.fx for camera in path if camera is not path[3]] == CIRCLE.intrinsics[
        [0, 1, 2, 4, 5, 6, 7], 0
    ].tolist()


def test_a_single_view_is_its_own_path():
    one = made_cameras(((0, -3, 0),))
    assert len(along(one, frames=30)) == 1


@pytest.mark.parametrize("elevation", [-30.0, 0.0, 60.0])
def test_an_orbit_round_an_instance_shows_all_of_it_from_that_height(elevation):
    own = made_gaussians(400, 0)
    cameras = CIRCLE
    path = round_instance(own, cameras, frames=7, elevation_deg=elevation)
    up = -cameras.world_to_camera[:, 1, :3].mean(axis=0)
    up /= np.linalg.norm(up)
    for camera in path:
        uv, depth = project(own.means, camera)
        assert (depth > 0).all() and (uv > 0).all() and (uv < (camera.width, camera.height)).all()
        outwards = camera.center / np.linalg.norm(camera.center)
        assert abs(np.degrees(np.arcsin(outwards @ up)) - elevation) < 6
    assert len({tuple(np.round(camera.center, 6)) for camera in path}) == 7


def test_an_orbit_of_the_scene_keeps_the_height_and_distance_of_the_input_views_and_looks_where_they_look():
    scene, cameras = made_gaussians(400, 0), CIRCLE
    path = round_scene(scene, cameras, frames=12)
    assert all(is_rigid(camera.world_to_camera) for camera in path)
    for camera in path:
        assert abs(np.linalg.norm(camera.center[:2]) - 3) < 0.15 and abs(camera.center[2] - 1) < 0.15
        uv, depth = project(np.zeros((1, 3)), camera)
        assert depth[0] > 2 and np.abs(uv[0] - (camera.cx, camera.cy)).max() < 10


def test_views_side_by_side_still_have_something_to_go_round():
    eyes = [(x, 0.0, -4.0) for x in np.linspace(-1, 1, 5)]
    poses = np.tile(np.eye(4), (5, 1, 1))
    poses[:, :3, 3] = -np.array(eyes)
    parallel = replace(made_cameras(tuple(eyes)), world_to_camera=poses)
    path = round_scene(made_gaussians(400, 0), parallel, frames=4)
    uv, depth = project(np.zeros((1, 3)), path[0])
    assert depth[0] > 1 and np.isfinite(uv).all()


def test_an_orbit_round_what_was_photographed_straight_down_from_all_sides_is_a_level_circle():
    eyes = ((1.0, 0, 4), (0, 1.0, 4), (-1.0, 0, 4), (0, -1.0, 4))
    cameras = made_cameras(eyes)
    for pose, eye in zip(cameras.world_to_camera, eyes, strict=True):
        pose[:] = looking(np.array(eye), np.array([0.0, 0, -1]), np.array([-eye[0], -eye[1], 0]))
    path = round_scene(made_gaussians(400, 0), cameras, frames=8)
    centers = np.array([camera.center for camera in path])
    np.testing.assert_allclose(centers[:, 2], 4, atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(centers[:, :2] - centers[:, :2].mean(axis=0), axis=1), 1, atol=0.1)


def azimuths(path) -> np.ndarray:
    return np.unwrap([np.arctan2(camera.center[1], camera.center[0]) for camera in path])


@pytest.mark.parametrize("first", [0.0, 2.9])  # the second arc lies across the seam of the angles
def test_an_orbit_of_what_was_taken_from_one_side_swings_over_that_side_and_back(first):
    taken = first + np.radians([0, 17, 39])
    cameras = made_cameras(tuple((3 * np.cos(a), 3 * np.sin(a), 1.0) for a in taken))
    found = azimuths(round_scene(made_gaussians(400, 0), cameras, frames=12))
    np.testing.assert_allclose([found[0], found[6]], [taken[0], taken[-1]], atol=0.05)
    np.testing.assert_allclose(found[7:], found[5:0:-1], atol=1e-9)


def test_an_orbit_goes_all_round_where_no_gap_is_large():
    found = azimuths(round_scene(made_gaussians(400, 0), CIRCLE, frames=12))
    np.testing.assert_allclose(np.diff(found), np.pi / 6, atol=0.1)


def test_an_orbit_of_a_single_view_swings_a_little_to_both_sides_of_it():
    cameras = made_cameras(((3.0, 0.0, 1.0),))
    found = azimuths(round_scene(made_gaussians(400, 0), cameras, frames=12))
    np.testing.assert_allclose(found[6] - found[0], np.radians(30), atol=0.1)
    np.testing.assert_allclose((found[0] + found[6]) / 2, 0, atol=0.05)
