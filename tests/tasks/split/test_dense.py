from dataclasses import replace

import box_scene
import numpy as np
import pytest

from ss_flow.errors import InputError
from ss_flow.tasks.artifacts import ColourTransform, DepthMap, SceneUnit
from ss_flow.tasks.capture.views import unit
from ss_flow.tasks.geometry.images import encode_png
from ss_flow.tasks.split.dense import DenseParams, dense, depth_samples, voxel_side


def fuse(**changes):
    return dense(
        box_scene.frames(), box_scene.cameras(), box_scene.depths(), SceneUnit(1.0), params=DenseParams(**changes)
    )


def test_dense_points_lie_on_the_surfaces_with_their_colours():
    cloud = fuse()
    assert len(cloud.points) > 2000
    # Two samples of one voxel average to a point inside a convex edge, at most half a voxel deep.
    assert box_scene.distance_to_scene(cloud.points).max() < 0.02
    top = np.abs(cloud.points[:, 2] - 0.7) < 0.004
    assert top.sum() > 50
    np.testing.assert_array_equal(np.median(cloud.colors[top], axis=0), box_scene.COLORS[2])


def test_points_have_the_colours_of_the_scene_where_photos_differ():
    frames, cameras, depths = box_scene.frames(), box_scene.cameras(), box_scene.depths()
    half = np.concatenate([0.5 * np.eye(3), np.zeros((3, 1))], axis=1)
    dark = tuple(ColourTransform(frame.name, frames[0].name, half) for frame in frames)
    same = tuple(ColourTransform(frame.name, "", np.eye(4)[:3]) for frame in frames)
    given, halved, kept = (
        dense(frames, cameras, depths, SceneUnit(1.0), looks, params=DenseParams()) for looks in ((), dark, same)
    )
    np.testing.assert_array_equal(kept.colors, given.colors)
    np.testing.assert_array_equal(halved.points, given.points)
    np.testing.assert_allclose(halved.colors, given.colors / 2, atol=1)


def test_points_are_as_far_apart_as_they_tell():
    from scipy.spatial import cKDTree

    cloud = fuse(voxel=0.1, voxel_pixels=1)
    nearest = cKDTree(cloud.points).query(cloud.points, k=2)[0][:, 1]
    for spacing in np.unique(cloud.spacing):
        own = cloud.spacing == spacing
        if own.sum() > 100:
            assert np.median(nearest[own]) == pytest.approx(spacing, rel=0.3)


def test_a_cube_holds_pixels_as_the_nearest_view_shows_them():
    assert fuse(voxel_pixels=4).spacing.min() == 2 * fuse(voxel_pixels=2).spacing.min()


def test_no_more_points_remain_than_asked_for():
    assert 500 < len(fuse(max_points=1000).points) <= 1000


def test_a_far_background_leaves_the_near_surface_its_points():
    def near_points(far):
        frames, cameras, depths = box_scene.frames(), box_scene.cameras(), []
        for depth in box_scene.depths():
            values = np.where(np.arange(depth.depth.shape[1]) < 20, np.float32(far), depth.depth)
            depths.append(replace(depth, depth=values))
        params = DenseParams(max_points=3000)
        cloud = dense(frames, cameras, tuple(depths), SceneUnit(1.0), params=params)
        return int((box_scene.distance_to_scene(cloud.points) < 0.05).sum())

    alone, beside = near_points(0), near_points(400)
    assert alone > 2000 and beside > 0.4 * alone


def sides_of(depth):
    """[H, W] the least sides of cubes of one pixel that view 0 asks for, its focal length 90 pixels."""
    seen = DepthMap("0", depth.astype(np.float32), "sensor")
    return depth_samples(box_scene.frames()[0], box_scene.cameras(), 0, seen, (), 1.0).side.reshape(depth.shape)


@pytest.mark.parametrize("degrees", [0, 45, 60])
def test_a_pixel_covers_more_of_what_is_looked_at_from_the_side(degrees):
    row = np.arange(box_scene.HEIGHT) + 0.5 - box_scene.HEIGHT / 2
    tilted = 2 / (1 + np.tan(np.radians(degrees)) * row / 90)
    depth = np.repeat(np.clip(tilted, 1, 4)[:, None], box_scene.WIDTH, axis=1)
    middle = sides_of(depth)[box_scene.HEIGHT // 2, box_scene.WIDTH // 2]
    assert middle == pytest.approx(2 / 90 / np.cos(np.radians(degrees)), rel=0.05)


def test_no_side_reaches_across_from_one_surface_to_another():
    depth = np.full((box_scene.HEIGHT, box_scene.WIDTH), 2.0)
    depth[:, 40:] = 4
    np.testing.assert_allclose(sides_of(depth), depth / 90, rtol=1e-4)


def test_one_view_less_leaves_the_cubes_where_they_are():
    fine = DenseParams(voxel=1.0)  # the footprint of a pixel decides
    every = box_scene.depths()
    fewer = (*every[:-1], replace(every[-1], depth=np.zeros_like(every[-1].depth)))
    sides = [voxel_side(box_scene.cameras(), depths, SceneUnit(1.0), fine) for depths in (every, fewer)]
    assert sides[0] == sides[1]


def moved(by):
    """The scene's points after the whole world was moved, along one axis."""
    cameras = box_scene.cameras()
    poses = cameras.world_to_camera.copy()
    poses[:, :3, 3] -= poses[:, :3, :3] @ np.array([0.0, by, 0.0])
    far = replace(cameras, world_to_camera=poses)
    return dense(box_scene.frames(), far, box_scene.depths(), SceneUnit(1.0), params=DenseParams())


def test_a_world_so_far_from_its_origin_that_things_fall_on_one_place_is_refused():
    near, far = moved(0), moved(1_000_000)  # steps of 0.0625
    assert abs(len(far.points) - len(near.points)) < 0.05 * len(near.points)
    with pytest.raises(InputError, match=r"3,000,000 world units .* steps of 0\.25, .* subtract one offset"):
        moved(3_000_000)


def test_the_same_input_gives_the_same_bits():
    a, b = fuse(), fuse()
    assert a.points.tobytes() == b.points.tobytes()
    assert a.colors.tobytes() == b.colors.tobytes()


def test_flying_pixels_of_one_view_are_dropped():
    depths = list(box_scene.depths())
    wrong = depths[0].depth.copy()
    wrong[30:40, 40:50] *= 0.6
    depths[0] = DepthMap("0", wrong, "sensor")
    cloud = dense(box_scene.frames(), box_scene.cameras(), tuple(depths), SceneUnit(1.0), params=DenseParams())
    assert (box_scene.distance_to_scene(cloud.points) > 0.1).mean() < 0.002


def test_pixels_that_a_frame_masks_out_give_no_points():
    nothing = encode_png(np.zeros((box_scene.HEIGHT, box_scene.WIDTH), np.uint8))
    frames = tuple(replace(frame, valid=nothing) for frame in box_scene.frames())
    one_left = (*frames[:-1], replace(frames[-1], valid=np.zeros(0, np.uint8)))
    cloud = dense(one_left, box_scene.cameras(), box_scene.depths(), SceneUnit(1.0), params=DenseParams())
    assert len(cloud.points) <= box_scene.WIDTH * box_scene.HEIGHT


def test_the_unit_is_a_metre_or_half_the_median_depth():
    cameras = box_scene.cameras()
    assert unit(cameras, box_scene.depths()).length == 1.0
    maps = tuple(DepthMap("x", np.array([[0, d]], np.float32), "mvs") for d in (2.0, 6.0, 8.0))
    assert unit(replace(cameras, metric=False), maps).length == 3.0


def test_depth_that_is_unknown_everywhere_is_bad_input():
    blind = tuple(DepthMap(d.name, np.zeros_like(d.depth), "sensor") for d in box_scene.depths())
    with pytest.raises(InputError, match="known depth"):
        unit(box_scene.cameras(), blind)


def test_depth_of_no_view_gives_no_points_and_says_no_more_than_that(recwarn):
    # As where a given splat shows nothing, and sparse points alone tell the unit.
    blind = tuple(DepthMap(d.name, np.zeros_like(d.depth), "rendered") for d in box_scene.depths())
    with pytest.raises(InputError, match="agree in no point"):
        dense(box_scene.frames(), box_scene.cameras(), blind, SceneUnit(1.0), params=DenseParams())
    assert not recwarn.list


def test_depth_that_never_agrees_is_bad_input():
    # Two cameras face each other, 10 m apart, and each looks through what the other measures.
    away = np.diag([-1.0, 1.0, -1.0, 1.0])
    away[2, 3] = 10
    cameras = box_scene.cameras()
    cameras = replace(
        cameras,
        names=("a", "b"),
        sizes=cameras.sizes[:2],
        intrinsics=cameras.intrinsics[:2],
        world_to_camera=np.stack([np.eye(4), away]),
    )
    near, far = np.zeros((2, box_scene.HEIGHT, box_scene.WIDTH), np.float32)
    near[28:44, 40:56] = 1.0
    far[35:37, 47:49] = 9.2
    depths = (DepthMap("a", near, "sensor"), DepthMap("b", far, "sensor"))
    with pytest.raises(InputError, match="agree in no point"):
        dense(box_scene.frames()[:2], cameras, depths, SceneUnit(1.0), params=DenseParams())
