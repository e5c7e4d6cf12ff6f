from dataclasses import replace

import numpy as np
import pytest
from generated_views import around, views
from native_builds import skip_without
from patchmatch_reference import Reference

from ss_flow.tasks.artifacts import DepthMap
from ss_flow.tasks.capture.depth import SweepParams, agree, photo_at_size, sweep
from ss_flow.tasks.capture.patchmatch import PatchMatchParams, Source, improved, patchmatch, stereo_identity
from ss_flow.tasks.capture.stereo import StereoParams, carried, stereo
from ss_flow.tasks.gaussians import library
from ss_flow.tasks.geometry.cameras import camera_of, cameras_by_view
from ss_flow.tasks.geometry.images import encode_png

EYES = [(0, 0, 0), (0.35, 0, 0), (-0.35, 0.1, 0), (0, 0.35, 0), (0.1, -0.35, 0.1)]


@pytest.fixture(scope="module")
def scene():
    return views(EYES)


@pytest.fixture(scope="module")
def swept(scene):
    frames, cameras = scene[0], cameras_by_view(scene[1])
    params = SweepParams(planes=48)
    return tuple(sweep(around(frames, k), around(cameras, k), params=params) for k in range(len(EYES)))


@pytest.fixture(scope="module")
def agreed(scene, swept):
    return agreed_views(scene, swept)


def agreed_views(scene, maps):
    cameras = cameras_by_view(scene[1])
    return tuple(agree(around(maps, k), around(cameras, k)) for k in range(len(maps)))


def refined(scene, swept, agreed, view, params=StereoParams()):
    """The view's depth by `stereo`, all others being its neighbours."""
    frames, cameras = around(scene[0], view), around(cameras_by_view(scene[1]), view)
    return stereo(frames, cameras, swept[view], around(agreed, view), params=params)


@pytest.fixture(scope="module")
def small():
    """A small photo, sources whose depth is known in part, one of them with a border that does not count, and planes
    that are off by some percent."""
    frames, cameras, depth = views(EYES, width=46, height=33, focal=43)
    photos = [photo_at_size(frames[k], camera_of(cameras, k), 46) for k in range(len(EYES))]
    half = np.arange(46) < 23
    photos[2].valid[:, 30:] = False
    sources = [Source(p, np.where(half, d, 0).astype(np.float32)) for p, d in zip(photos[1:], depth[1:], strict=True)]
    random = np.random.default_rng(0)
    planes = np.zeros((3, 33, 46), np.float32)
    planes[0] = 1 / (depth[0] * random.uniform(0.9, 1.1, depth[0].shape))
    planes[1:] = random.uniform(-0.002, 0.002, (2, 33, 46))
    return photos[0], sources, planes


@pytest.fixture(params=library.BUILDS)
def build(request, monkeypatch):
    """Each instruction set of this machine, one after the other."""
    skip_without(request.param)
    monkeypatch.setattr("ss_flow.tasks.capture.patchmatch.library", lambda: library.library(request.param))


def test_the_cost_of_planes_is_that_of_the_reference(small, build):
    photo, sources, planes = small
    params = PatchMatchParams(turns=0, window=7)
    cost = improved(photo, sources, planes.copy(), 0, params)
    expected = Reference(photo, sources, planes, params).cost
    assert np.ptp(expected) > 0.3 and (expected == 0.5).any()
    np.testing.assert_allclose(cost, expected, atol=2e-4)


def test_a_turn_leaves_the_planes_that_the_reference_finds(small, build):
    photo, sources, planes = small
    params = PatchMatchParams(turns=2, window=5)
    reference, found = Reference(photo, sources, planes, params), planes.copy()
    for turn in range(2):
        reference.improve(turn, seed=5)
    cost = improved(photo, sources, found, 5, params)
    same = np.abs(found[0] / reference.planes[0] - 1) < 1e-4
    assert same.mean() > 0.97  # where two planes are nearly as good, rounding decides
    np.testing.assert_allclose(cost[same], reference.cost[same], atol=1e-3)
    assert np.mean(np.abs(found[0] / planes[0] - 1) > 1e-3) > 0.9


def test_planes_come_to_the_truth_from_a_guess_that_is_off_by_several_percent(scene):
    frames, cameras, depth = scene
    photos = [photo_at_size(frames[k], camera_of(cameras, k), 160) for k in range(len(EYES))]
    unknown = np.zeros_like(photos[0].gray)
    guess = (depth[0] * np.random.default_rng(0).uniform(0.92, 1.08, depth[0].shape)).astype(np.float32)
    params = PatchMatchParams(smoothness=0.1, gray_scale=12)
    found, cost = patchmatch(photos[0], [Source(p, unknown) for p in photos[1:]], guess, 0, params)
    error = np.abs(found / depth[0] - 1)
    assert np.median(error) < 0.006 < 0.03 < np.median(np.abs(guess / depth[0] - 1))
    assert np.median(cost) < 0.08


def test_more_pixels_are_right_after_refinement_than_after_the_sweep(scene, swept, agreed):
    depth = scene[2]
    again = agreed_views(scene, [refined(scene, swept, agreed, k) for k in range(len(EYES))])
    for k, (before, after) in enumerate(zip(agreed, again, strict=True)):
        errors = [np.where(m.depth > 0, np.abs(m.depth / depth[k] - 1), np.inf) for m in (before, after)]
        assert np.mean(errors[1] < 0.005) > np.mean(errors[0] < 0.005)
        assert np.mean(errors[1] < 0.01) > 0.65
        assert after.source == "mvs"


def test_a_view_without_depth_of_its_own_gets_it_from_the_others(scene, swept, agreed):
    depth = scene[2]
    wrong = replace(swept[0], depth=np.full_like(swept[0].depth, 9.0))
    nothing = replace(agreed[0], depth=np.zeros_like(agreed[0].depth))
    found = refined(scene, (wrong, *swept[1:]), (nothing, *agreed[1:]), 0)
    error = np.abs(found.depth / depth[0] - 1)[found.depth > 0]
    assert (found.depth > 0).mean() > 0.8
    assert np.mean(error < 0.01) > 0.8


def test_the_result_is_of_the_size_asked_for_and_twice_the_same(scene, swept, agreed):
    depth = scene[2]
    first, second = (refined(scene, swept, agreed, 1, StereoParams(max_side=80)) for _ in "ab")
    assert first.depth.shape == (60, 80)
    np.testing.assert_array_equal(first.depth, second.depth)
    true = depth[1][1::2, 1::2]
    assert np.median(np.abs(first.depth / true - 1)[first.depth > 0]) < 0.01


def test_ignored_pixels_have_no_depth_and_do_not_harm_others(scene, swept, agreed):
    frames, cameras, depth = scene
    keep = np.ones((120, 160), np.uint8)
    keep[:, :40] = 0
    masked = tuple(replace(f, valid=encode_png(keep * 255)) for f in frames)
    found = refined((masked, cameras, depth), swept, agreed, 0).depth
    assert not found[:, :40].any()
    known = found > 0
    assert known.mean() > 0.6
    assert np.median(np.abs(found - depth[0])[known] / depth[0][known]) < 0.01


def test_a_view_that_no_other_overlaps_or_that_has_nothing_to_start_from_has_no_depth(scene, swept, agreed):
    frames, cameras, _ = scene
    away = cameras.world_to_camera.copy()
    away[1:, :3, 3] += (0, 0, -1000)
    alone = refined((frames, replace(cameras, world_to_camera=away), None), swept, agreed, 0)
    none = tuple(DepthMap(m.name, np.zeros_like(m.depth), "mvs") for m in swept)
    blank = refined(scene, none, none, 0)
    for found in (alone, blank):
        assert found.depth.shape == (120, 160) and not found.depth.any()


def test_depth_is_carried_to_another_view_with_the_nearest_in_front(scene):
    _, cameras, depth = scene
    maps = [(d.astype(np.float32), camera_of(cameras, k)) for k, d in enumerate(depth)]
    shown = carried(maps[1:], camera_of(cameras, 0))
    known = shown > 0
    assert known.mean() > 0.9
    assert np.mean(np.abs(shown / depth[0] - 1)[known] < 0.02) > 0.95
    nearer = [(maps[1][0] * np.float32(0.5), maps[1][1])]
    assert (carried(maps[1:] + nearer, camera_of(cameras, 0)) <= np.where(known, shown, np.inf)).all()


def test_the_instruction_set_counts_in_the_key():
    assert stereo_identity()["rasterizer"].split()[-1] in library.BUILDS
