from dataclasses import replace

import box_scene
import numpy as np
import pytest
from tiny_runs import run_tiny, write_room

from ss_flow.errors import InputError
from ss_flow.tasks.capture.views import unit
from ss_flow.tasks.gaussians.objective import Objective
from ss_flow.tasks.geometry.cameras import backproject, camera_of
from ss_flow.tasks.geometry.images import encode_png
from ss_flow.tasks.split.dense import DenseParams
from ss_flow.tasks.split.dense_splatting import DenseSplattingParams, dense_splatting, with_sparse_points

STEPS = 150
COARSE = DenseParams(voxel=0.05, voxel_pixels=100)


def splatted(frames=None, cameras=None, depths=None, params=DenseParams(), **changes):
    cameras, depths = cameras or box_scene.cameras(), depths or box_scene.depths()
    return dense_splatting(
        frames or box_scene.frames(),
        cameras,
        depths,
        unit(cameras, depths),
        params=params,
        splatting=DenseSplattingParams(**{"min_iterations": STEPS, "iterations_per_view": 1, **changes}),
    )


def blind():
    return tuple(replace(d, depth=np.zeros_like(d.depth)) for d in box_scene.depths())


def on_the_surfaces(count, cameras=None):
    """So many points of the scene, spread over its views."""
    cameras = cameras or box_scene.cameras()
    points = np.concatenate(
        [
            backproject(d.depth, camera_of(cameras, k))[d.depth.ravel() > 0]
            for k, d in enumerate(box_scene.depths(1.0 if cameras.metric else 2.0))
        ]
    )
    return np.random.default_rng(0).permutation(points)[:count].astype(np.float32)


@pytest.fixture(scope="module")
def cloud():
    return splatted()


def test_centres_lie_on_the_surfaces_with_their_colours(cloud):
    off = box_scene.distance_to_scene(cloud.points)
    assert len(cloud.points) > 2000
    assert np.median(off) < 0.01 and np.quantile(off, 0.9) < 0.025
    top = np.abs(cloud.points[:, 2] - 0.7) < 0.01
    assert top.sum() > 30
    np.testing.assert_allclose(np.median(cloud.colors[top], axis=0), box_scene.COLORS[2], atol=25)


def test_the_same_input_gives_the_same_bits(cloud):
    again = splatted()
    assert again.points.tobytes() == cloud.points.tobytes()
    assert again.colors.tobytes() == cloud.colors.tobytes()


def test_points_are_sampled_one_a_voxel_in_the_order_of_the_voxels():
    points = splatted(params=COARSE).points
    cell = np.floor(points.astype(np.float64) / COARSE.voxel + 0.5).astype(int) % 2**21
    code = (cell[:, 0] * 2**21 + cell[:, 1]) * 2**21 + cell[:, 2]
    assert (np.diff(code) > 0).all()


def test_no_more_points_remain_than_asked_for():
    assert 200 < len(splatted(params=DenseParams(max_points=500)).points) <= 500


def test_the_number_of_steps_grows_with_the_views_between_two_limits():
    params = DenseSplattingParams(iterations_per_view=40, min_iterations=600, max_iterations=3000)
    assert [params.iterations(n) for n in (5, 20, 100)] == [600, 800, 3000]


def test_the_weight_of_the_depth_loss_reaches_the_training(cloud):
    heavier = splatted(objective=Objective(depth_weight_start=2.0, depth_weight_final=2.0))
    assert heavier.points.tobytes() != cloud.points.tobytes()


def test_centres_that_two_views_depth_does_not_confirm_are_dropped(cloud):
    strict = splatted(params=DenseParams(tolerance=0.003, relative_tolerance=0.0))
    assert 1000 < len(strict.points) < 0.5 * len(cloud.points)
    worst, bound = (np.quantile(box_scene.distance_to_scene(c.points), 0.9) for c in (strict, cloud))
    assert worst < 0.8 * bound


def test_sparse_points_stand_in_where_no_depth_is_known():
    cameras = box_scene.cameras()
    cloud = splatted(cameras=replace(cameras, sparse_points=on_the_surfaces(3000)), depths=blind())
    assert len(cloud.points) > 500
    assert np.median(box_scene.distance_to_scene(cloud.points)) < 0.02
    assert cloud.unit == 1.0


def test_without_depth_and_scale_the_unit_comes_from_the_sparse_points():
    cameras = box_scene.cameras(scale=2.0)
    cameras = replace(cameras, sparse_points=on_the_surfaces(3000, cameras))
    cloud = splatted(cameras=cameras, depths=blind())
    assert cloud.unit == pytest.approx(unit(cameras, box_scene.depths(2.0)).length, rel=0.1)


def test_known_depth_wins_over_sparse_points_and_the_nearest_of_these_over_others():
    cameras, depths = box_scene.cameras(), list(blind())
    camera = camera_of(cameras, 0)
    rays = np.array([[10.5 - camera.cx, 20.5 - camera.cy, camera.fx], [30.5 - camera.cx, 40.5 - camera.cy, camera.fx]])
    local = np.array([1.5 * rays[0], 1.2 * rays[0], 1.4 * rays[1]]) / camera.fx
    pose = camera.world_to_camera
    world = (local - pose[:3, 3]) @ pose[:3, :3]
    known = depths[0].depth.copy()
    known[40, 30] = 3.0
    depths[0] = replace(depths[0], depth=known)
    filled = with_sparse_points(replace(cameras, sparse_points=world.astype(np.float32)), tuple(depths))[0].depth
    assert filled[20, 10] == pytest.approx(1.2, rel=1e-5)
    assert filled[40, 30] == 3.0
    assert np.count_nonzero(filled) == 2


def test_neither_depth_nor_sparse_points_is_bad_input():
    with pytest.raises(InputError, match="known depth"):
        splatted(depths=blind())


def test_depth_only_where_frames_are_masked_out_is_bad_input():
    nothing = encode_png(np.zeros((box_scene.HEIGHT, box_scene.WIDTH), np.uint8))
    with pytest.raises(InputError, match="mask out"):
        splatted(frames=tuple(replace(frame, valid=nothing) for frame in box_scene.frames()))


def test_a_frame_that_is_masked_out_entirely_is_left_out():
    nothing = encode_png(np.zeros((box_scene.HEIGHT, box_scene.WIDTH), np.uint8))
    first, *rest = box_scene.frames()
    assert len(splatted(frames=(replace(first, valid=nothing), *rest)).points) > 1000


def test_a_splatting_in_which_nothing_is_opaque_is_bad_input():
    with pytest.raises(InputError, match="more steps"):
        splatted(min_iterations=1, max_iterations=1)


def test_a_run_takes_its_dense_points_from_the_splatting_when_asked(tmp_path):
    scene = write_room(tmp_path / "room")
    asked = [
        "split.dense_source=splatting",
        f"split.splatting.min_iterations={STEPS}",
        "splatting.iterations_per_view=1",
    ]
    called = run_tiny(scene, tmp_path / "store", "--until", "dense", *(f"--set={a}" for a in asked))
    assert called.code == 0, called.err
    assert called.computed()["split.dense_splatting"] == 1
    assert called.computed()["split.dense"] == 0
