from dataclasses import replace

import numpy as np
import pytest
from generated_views import views

from ss_flow.errors import InputError
from ss_flow.tasks.artifacts import DepthMap
from ss_flow.tasks.capture.depth import AgreementParams, SweepParams, agree, sweep
from ss_flow.tasks.geometry.images import encode_png

EYES = [(0, 0, 0), (0.35, 0, 0), (-0.35, 0.1, 0), (0, 0.35, 0), (0.1, -0.35, 0.1)]


@pytest.fixture(scope="module")
def scene():
    return views(EYES)


@pytest.fixture(scope="module")
def swept(scene):
    frames, cameras, _ = scene
    return tuple(sweep(frames, cameras, view=k) for k in range(len(EYES)))


def test_swept_depth_is_right_within_a_percent_without_knowing_its_range(scene, swept):
    frames, cameras, depth = scene
    result = agree(swept, cameras)
    for k in range(len(EYES)):
        known = result[k].depth > 0
        error = np.abs(result[k].depth - depth[k])[known] / depth[k][known]
        assert result[k].name == frames[k].name
        assert known.mean() > 0.6
        assert np.median(error) < 0.005
        assert np.quantile(error, 0.95) < 0.02


def test_the_range_comes_from_sparse_points_where_there_are_any(scene):
    frames, cameras, depth = scene
    random = np.random.default_rng(0)
    sparse = np.column_stack([random.uniform(-0.7, 0.7, (100, 2)), np.full(100, 2.5)]).astype(np.float32)
    found = sweep(frames, replace(cameras, sparse_points=sparse), view=0).depth
    assert found.max() <= 2.5 * 1.25
    on_square = (found > 0) & (depth[0] < 2.6)
    assert np.median(np.abs(found - depth[0])[on_square]) < 0.03


def test_ignored_pixels_have_no_depth_and_do_not_harm_others(scene):
    frames, cameras, depth = scene
    keep = np.ones((120, 160), np.uint8)
    keep[:, :40] = 0
    masked = tuple(replace(f, valid=encode_png(keep * 255)) for f in frames)
    found = sweep(masked, cameras, view=0, params=SweepParams(planes=64)).depth
    assert not found[:, :40].any()
    known = found > 0
    assert np.median(np.abs(found - depth[0])[known] / depth[0][known]) < 0.01


def test_depth_maps_may_be_smaller_than_frames(scene):
    frames, cameras, depth = scene
    found = sweep(frames, cameras, view=0, params=SweepParams(max_side=80)).depth
    assert found.shape == (60, 80)
    true = depth[0][1::2, 1::2]
    assert np.median(np.abs(found - true)[found > 0] / true[found > 0]) < 0.02


def test_a_view_that_no_other_overlaps_has_no_depth(scene):
    frames, cameras, _ = scene
    away = cameras.world_to_camera.copy()
    away[1:, :3, 3] += (0, 0, -1000)
    found = sweep(frames, replace(cameras, world_to_camera=away), view=0)
    assert found.depth.shape == (120, 160) and not found.depth.any()


def test_depth_that_no_view_confirms_is_refused(scene, swept):
    _, cameras, _ = scene
    empty = [DepthMap(m.name, np.zeros_like(m.depth), "mvs") for m in swept[1:]]
    with pytest.raises(InputError, match="no depth is found in any of the 5 views"):
        agree((swept[0], *empty), cameras)


def test_depth_that_one_view_alone_confirms_is_dropped_when_two_must(scene, swept):
    _, cameras, _ = scene
    empty = [DepthMap(m.name, np.zeros_like(m.depth), "mvs") for m in swept[2:]]
    one = agree((*swept[:2], *empty), cameras, params=AgreementParams(min_views=1))
    assert (one[0].depth > 0).mean() > 0.5
    with pytest.raises(InputError):
        agree((*swept[:2], *empty), cameras, params=AgreementParams(min_views=2))


def test_sweeping_twice_gives_the_same_bits(scene, swept):
    frames, cameras, _ = scene
    np.testing.assert_array_equal(sweep(frames, cameras, view=0).depth, swept[0].depth)
