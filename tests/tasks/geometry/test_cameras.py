"""Where points fall in a camera's image, and where the borders of its photo are."""

from __future__ import annotations

import numpy as np
import pytest

from ss_flow.tasks.artifacts import Cameras
from ss_flow.tasks.geometry.cameras import (
    Camera,
    backproject,
    looking,
    nearest_views,
    pixels_in_view,
    project,
    surface_of_pixels,
)


def turned() -> Camera:
    """Turned by a fifth of a right angle about y, and off the origin."""
    angle = 0.1 * np.pi
    pose = np.eye(4)
    pose[:3, :3] = [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
    pose[:3, 3] = 0.1, -0.2, 2.0
    return Camera(40, 30, 33.0, 35.0, 19.0, 16.0, pose)


@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_points_fall_where_the_pinhole_formula_says(kind):
    camera = turned()
    points = np.random.default_rng(0).normal(size=(300, 3)).astype(kind) * 2
    expected = []
    for number, point in enumerate(points.astype(np.float64)):
        x, y, z = camera.world_to_camera[:3] @ [*point, 1]
        u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
        if z > 0 and 0 <= u < 40 and 0 <= v < 30:
            expected.append((number, int(u), int(v), z))
    rows, column, row, z = pixels_in_view(points, camera)
    assert 30 < len(rows) < 200 and {a.dtype for a in (rows, column, row)} == {np.dtype(np.int32)}
    assert list(zip(rows, column, row, strict=True)) == [e[:3] for e in expected]
    np.testing.assert_allclose(z, [e[3] for e in expected])
    uv, depth = project(points, camera)
    assert uv.shape == (300, 2)
    np.testing.assert_array_equal(np.floor(uv[rows]).astype(int).T, [column, row])
    np.testing.assert_array_equal(depth[rows], z)
    assert [len(a) for a in pixels_in_view(points[:0], camera)] == [0, 0, 0, 0]


def test_the_surface_of_pixels_falls_on_their_centres():
    camera = turned()
    rng = np.random.default_rng(1)
    column, row, depth = rng.integers(0, 40, 50), rng.integers(0, 30, 50), rng.uniform(1, 5, 50).astype(np.float32)
    uv, z = project(surface_of_pixels(column, row, depth, camera), camera)
    np.testing.assert_allclose(uv, np.stack([column, row], axis=-1) + 0.5)
    np.testing.assert_allclose(z, depth)
    image = np.zeros((30, 40), np.float32)
    image[row, column] = depth
    world = backproject(image, camera).reshape(30, 40, 3)
    kept = image[row, column] == depth
    np.testing.assert_array_equal(world[row, column][kept], surface_of_pixels(column, row, depth, camera)[kept])
    np.testing.assert_allclose(world[image == 0], np.broadcast_to(camera.center, world[image == 0].shape))


def test_borders_are_the_slopes_of_the_rays_through_them():
    camera = Camera(40, 30, 20.0, 25.0, 15.0, 20.0, np.eye(4))
    assert camera.borders == pytest.approx((-0.75, -0.8, 1.25, 0.4))


def test_a_crop_keeps_the_borders_of_its_photo():
    camera = Camera(40, 30, 20.0, 25.0, 15.0, 20.0, np.eye(4))
    assert camera.cropped(20, 3, 38, 12).scaled(5, 7).cropped(1, 1, 3, 4).borders == camera.borders
    assert camera.scaled(80, 15).borders == pytest.approx(camera.borders)
    assert camera.scaled(80, 15).photo_borders is None


def test_the_nearest_views_are_other_ones_that_look_within_45_degrees_of_the_same_way():
    places = [(0.0, 0), (2.0, 0), (-1.0, 44), (0.5, 46), (3.0, -44), (0.1, 180)]
    ways = np.radians([turn for _, turn in places])
    poses = [
        looking(np.array([x, 0, 0]), np.array([np.sin(way), 0, np.cos(way)]), np.array([0, 1, 0]))
        for (x, _), way in zip(places, ways, strict=True)
    ]
    names, k = tuple("abcdef"), len(poses)
    cameras = Cameras(names, np.full((k, 2), 9, np.int32), np.ones((k, 4)), np.array(poses), True)
    assert nearest_views(cameras, 0, 2) == [2, 1] and nearest_views(cameras, 0, 9) == [2, 1, 4]
    assert nearest_views(cameras, 5, 9) == []
