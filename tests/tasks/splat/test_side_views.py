"""What instances should cover from where no photo was taken."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from ball_and_box import BALL as CENTRE
from ball_and_box import RADIUS, SmallScene
from scipy.ndimage import binary_erosion

from ss_flow.tasks.artifacts import Bool
from ss_flow.tasks.gaussians.initialise import concatenate, initialise, neighbour_spread
from ss_flow.tasks.gaussians.native_pass import NEAR_PLANE
from ss_flow.tasks.gaussians.views import SceneViews
from ss_flow.tasks.geometry.cameras import Camera, backproject, pixels_in_view, project
from ss_flow.tasks.geometry.sampling import first_of_each_cube, sphere
from ss_flow.tasks.geometry.visibility import VisibilityParams
from ss_flow.tasks.splat.side_views import (
    FEWEST,
    GAP,
    MOST_PLACES,
    RIM,
    cameras_around,
    empty,
    hidden,
    shown_surfaces,
    side_views,
)

BOX, BALL = 1, 2


def compared(small: SmallScene) -> SceneViews:
    return small.views.compared(VisibilityParams())


def distance_of_rays(camera: Camera, place: np.ndarray) -> np.ndarray:
    """[h, w] how far the ray through each pixel passes by a place."""
    towards = backproject(np.ones((camera.height, camera.width), np.float32), camera) - camera.center
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    away = place - camera.center
    return np.linalg.norm(away - (towards @ away)[:, None] * towards, axis=1).reshape(camera.height, camera.width)


def test_what_lies_beyond_the_rim_of_points_is_empty_from_all_directions():
    ball = (0.5 * sphere(2000)).astype(np.float32)
    spacing = float(np.median(neighbour_spread(ball)))
    cameras = list(cameras_around(ball, spacing, 6))
    assert len({tuple(np.round(camera.center, 6)) for camera in cameras}) == 6
    for camera in cameras:
        passes = distance_of_rays(camera, np.zeros(3))
        assert np.linalg.norm(camera.center) == pytest.approx(4 * (np.sqrt(3) * 0.5 + GAP * spacing), rel=0.01)
        free = empty(camera, ball, spacing)
        assert not free[passes < 0.5].any()
        assert free[passes > 0.5 + (RIM + 1) * spacing].all()  # pixels are half a spacing wide
        assert free[[0, 0, -1, -1], [0, -1, 0, -1]].all()


def test_a_few_points_far_away_hardly_move_the_cameras_back():
    ball = (0.5 * sphere(2000)).astype(np.float32)
    strays = np.array([9.0, 0, 0], np.float32) + 0.1 * ball[::40]
    spacing = float(np.median(neighbour_spread(ball)))
    both = np.concatenate([ball, strays])
    for alone, camera in zip(cameras_around(ball, spacing, 6), cameras_around(both, spacing, 6), strict=True):
        assert camera.width == pytest.approx(alone.width, rel=0.4)
        assert np.linalg.norm(camera.center) == pytest.approx(np.linalg.norm(alone.center), rel=0.4)
        free = empty(camera, both, spacing)
        passes = distance_of_rays(camera, np.zeros(3))
        assert not free[passes < 0.5].any()
        assert free[passes > 0.5 + (RIM + 1.5) * spacing].mean() > 0.9  # a stray may stand before or behind


@pytest.mark.parametrize("radius", [1e-3, 1e-4])
def test_a_tiny_thing_is_seen_from_beyond_the_nearest_depth_and_as_large_as_any(radius):
    ball = sphere(2000).astype(np.float32)
    spacing = float(np.median(neighbour_spread(ball)))
    tiny = zip(cameras_around(radius * ball, radius * spacing, 6), cameras_around(ball, spacing, 6), strict=True)
    for camera, usual in tiny:
        uv, z = project(radius * ball, camera)
        assert z.min() > NEAR_PLANE
        np.testing.assert_allclose(np.ptp(uv, axis=0), np.ptp(project(ball, usual)[0], axis=0), rtol=0.05)


@pytest.mark.parametrize(("width", "closed"), [(1.5 * GAP, True), (3 * GAP, False)])
def test_narrow_gaps_between_points_close_and_wide_ones_stay_empty(width, closed):
    across, up = (axis.ravel() for axis in np.meshgrid(np.arange(-20, 21), np.arange(-20, 21)))
    sheet = np.stack([across, up, np.zeros(len(up))], axis=1).astype(np.float32)
    sheet = sheet[np.abs(sheet[:, 0]) >= width / 2]
    pose = np.diag([1.0, -1.0, -1.0, 1.0])
    pose[2, 3] = 60
    above = Camera(120, 120, 120.0, 120.0, 60.0, 60.0, pose)
    assert empty(above, sheet, 1.0)[40:80, 60].any() != closed


def test_a_surface_is_what_a_good_part_of_the_pixels_there_shows(small):
    found = shown_surfaces(compared(small), small.maps, 0.03)
    off = np.abs(np.linalg.norm(found[BALL] - CENTRE, axis=1) - RADIUS)
    assert off.max() < 1e-3
    assert len(found[BALL]) > 200
    missed = [replace(m, ids=np.where(m.ids == BALL, 0, m.ids)) if k % 4 == 0 else m for k, m in enumerate(small.maps)]
    wrong = [replace(m, ids=np.where(m.ids == BALL, BOX, m.ids)) if k == 0 else m for k, m in enumerate(small.maps)]
    assert len(shown_surfaces(compared(small), missed, 0.03)[BALL]) > 0.75 * len(found[BALL])
    more = len(shown_surfaces(compared(small), wrong, 0.03)[BOX]) - len(found[BOX])
    assert more < 0.4 * len(found[BALL])


def test_a_cube_with_a_single_pixel_tells_nothing(small):
    assert shown_surfaces(compared(small), small.maps, 1e-5) == {}


def test_what_is_far_behind_an_edge_is_no_surface_of_the_thing_in_front(small):
    views = compared(small)
    in_front = [view for view, ids in enumerate(small.ids) if (ids == BALL).sum() > 120]
    assert len(in_front) >= 4
    for view in in_front:
        one = replace(views, cameras=views.cameras[view : view + 1], depths=views.depths[view : view + 1])
        wide = np.pad(small.ids[view] == BALL, 1)
        wide = wide[:-2, 1:-1] | wide[2:, 1:-1] | wide[1:-1, :-2] | wide[1:-1, 2:] | wide[1:-1, 1:-1]
        mask = replace(small.maps[view], ids=np.where(wide, BALL, 0).astype(np.uint16))
        surface = shown_surfaces(one, [mask], 0.05)[BALL]
        off = np.abs(np.linalg.norm(surface - CENTRE, axis=1) - RADIUS)
        assert len(surface) > 10 and off.max() < 0.15  # the floor and the box where they touch it


def test_what_no_view_sees_through_may_be_the_thing(small):
    views, ball = compared(small), small.instance(BALL).points
    ball = np.concatenate([ball, 2 * np.float32(CENTRE) - ball])  # with the underside, so that the box holds it all
    places = hidden(views, ball, 0.02)
    away = np.linalg.norm(places - CENTRE, axis=1)
    inside = 0.02**3 * len(places[away < RADIUS - 0.02])
    assert inside == pytest.approx(4 / 3 * np.pi * (RADIUS - 0.02) ** 3, rel=0.1)  # all of its inside
    assert not (
        (away > RADIUS + 0.02) & (places[:, 0] > CENTRE[0]) & (places[:, 2] > CENTRE[2])
    ).any()  # but nothing in plain view
    assert (np.abs(places - CENTRE) <= RADIUS + 1e-3).all()
    unknown = [replace(depth, depth=np.zeros_like(depth.depth)) for depth in views.depths]
    assert len(hidden(replace(views, depths=unknown), ball, 0.02)) > 1.5 * len(places)


def test_large_things_have_no_more_hidden_places(small):
    views, ball = compared(small), small.instance(BALL).points
    unknown = [replace(depth, depth=np.zeros_like(depth.depth)) for depth in views.depths]
    blind = replace(views, depths=unknown)
    for spacing in (1e-3, 0.0):
        places = hidden(blind, ball, spacing)
        assert 0.7 * MOST_PLACES < len(places) <= MOST_PLACES
        assert np.ptp(places, axis=0) == pytest.approx(
            np.ptp(np.quantile(ball, (0.01, 0.99), axis=0), axis=0), rel=0.05
        )


def test_unknown_depth_shows_no_surface(small):
    blind = [replace(depth, depth=np.zeros_like(depth.depth)) for depth in small.depths]
    assert shown_surfaces(replace(compared(small), depths=blind), small.maps, 0.03) == {}


def test_an_instance_with_much_unknown_depth_has_no_known_surface(small):
    def found(share: float) -> set[int]:
        depths = []
        for depth, ids in zip(small.depths, small.ids, strict=True):
            z, (row, column) = depth.depth.copy(), np.nonzero(ids == BALL)
            lost = np.arange(len(row)) < share * len(row)
            z[row[lost], column[lost]] = 0
            depths.append(replace(depth, depth=z))
        return set(shown_surfaces(replace(compared(small), depths=depths), small.maps, 0.03))

    assert found(0.05) == {0, BOX, BALL}
    assert found(0.2) == {0, BOX}


def test_single_pixels_and_thin_strips_without_depth_leave_a_surface_known(small):
    """As depth cameras lose them; but the depth of what lies around a thing does not tell where that ends."""

    def found(lost: Callable[[Bool], Bool]) -> set[int]:
        depths = [
            replace(depth, depth=np.where(lost(ids == BALL), 0, depth.depth))
            for depth, ids in zip(small.depths, small.ids, strict=True)
        ]
        return set(shown_surfaces(replace(compared(small), depths=depths), small.maps, 0.03))

    every_second = np.indices(small.ids[0].shape).sum(axis=0) % 2 == 0
    assert found(lambda ball: ball & every_second) == {0, BOX, BALL}
    assert found(lambda ball: ball & ~binary_erosion(ball)) == {0, BOX, BALL}
    assert found(lambda ball: ball & ~binary_erosion(ball, iterations=5)) == {0, BOX}


def test_only_instances_that_have_a_shape_are_looked_at(small):
    few, many = (small.points[small.labels == i] for i in (BOX, BALL))
    few, many = few[: FEWEST - 1], many[first_of_each_cube(many, 0.03)]
    scene = concatenate([
        initialise(points, np.zeros((len(points), 3), np.uint8), i, 1.0)
        for i, points in ((0, small.points[small.labels == 0][::50]), (BOX, few), (BALL, many))
    ])  # fmt: skip
    found = side_views(compared(small), scene, small.maps, 8, 100)
    assert len(side_views(compared(small), scene, small.maps, 8, 5)) == 5
    assert [(view.start, view.stop) for view in found] == 8 * [(len(scene) - len(many), len(scene))]
    for view in found:
        passes = distance_of_rays(view.target.camera, CENTRE)
        _, column, row, _ = pixels_in_view(many, view.target.camera)
        assert not view.target.judged[row, column].any()
        assert (view.target.judged[passes > RADIUS + 0.1] == np.float32(1 / view.target.judged.size)).all()
        assert not view.target.inside.any() and not view.target.counted.any() and not view.target.known.any()


def test_a_scene_of_background_alone_has_no_sides(small):
    floor = small.points[small.labels == 0][::50]
    scene = initialise(floor, np.zeros((len(floor), 3), np.uint8), 0, 1.0)
    assert side_views(compared(small), scene, small.maps, 4, 100) == []
