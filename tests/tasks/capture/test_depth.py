from dataclasses import replace

import numpy as np
import pytest
from generated_views import around, views

from ss_flow.errors import InputError
from ss_flow.tasks.artifacts import DepthMap
from ss_flow.tasks.capture.depth import AgreementParams, SweepParams, agree, sweep
from ss_flow.tasks.capture.views import unit
from ss_flow.tasks.geometry.cameras import cameras_by_view
from ss_flow.tasks.geometry.images import encode_png

EYES = [(0, 0, 0), (0.35, 0, 0), (-0.35, 0.1, 0), (0, 0.35, 0), (0.1, -0.35, 0.1)]


@pytest.fixture(scope="module")
def scene():
    return views(EYES)


@pytest.fixture(scope="module")
def swept(scene):
    return tuple(swept_view(scene, k) for k in range(len(EYES)))


def swept_view(scene, view, **options):
    frames, cameras, _ = scene
    return sweep(around(frames, view), around(cameras_by_view(cameras), view), **options)


def agreed_view(scene, maps, view, **params):
    cameras = cameras_by_view(scene[1])
    return agree(around(maps, view), around(cameras, view), params=AgreementParams(**params))


def test_more_agreement_than_views_that_are_asked_is_refused():
    with pytest.raises(InputError, match="min_views is 9 but only 8 neighbors are asked"):
        AgreementParams(min_views=9)


def test_swept_depth_is_right_within_a_percent_without_knowing_its_range(scene, swept):
    frames, _, depth = scene
    for k in range(len(EYES)):
        result = agreed_view(scene, swept, k)
        known = result.depth > 0
        error = np.abs(result.depth - depth[k])[known] / depth[k][known]
        assert result.name == frames[k].name
        assert known.mean() > 0.6
        assert np.median(error) < 0.005
        assert np.quantile(error, 0.95) < 0.02


def test_only_depths_of_the_span_are_tried(scene):
    _, _, depth = scene
    found = swept_view(scene, 0, span=(1.8, 3.1)).depth
    assert found[found > 0].min() >= 1.8 and found.max() <= 3.1
    on_square = (found > 0) & (depth[0] < 2.6)
    assert np.median(np.abs(found - depth[0])[on_square]) < 0.03


def test_ignored_pixels_have_no_depth_and_do_not_harm_others(scene):
    frames, cameras, depth = scene
    keep = np.ones((120, 160), np.uint8)
    keep[:, :40] = 0
    masked = tuple(replace(f, valid=encode_png(keep * 255)) for f in frames)
    found = swept_view((masked, cameras, depth), 0, params=SweepParams(planes=64)).depth
    assert not found[:, :40].any()
    known = found > 0
    assert np.median(np.abs(found - depth[0])[known] / depth[0][known]) < 0.01


def test_depth_maps_may_be_smaller_than_frames(scene):
    _, _, depth = scene
    found = swept_view(scene, 0, params=SweepParams(max_side=80)).depth
    assert found.shape == (60, 80)
    true = depth[0][1::2, 1::2]
    assert np.median(np.abs(found - true)[found > 0] / true[found > 0]) < 0.02


def test_a_view_that_no_other_overlaps_has_no_depth(scene):
    frames, cameras, _ = scene
    away = cameras.world_to_camera.copy()
    away[1:, :3, 3] += (0, 0, -1000)
    found = swept_view((frames, replace(cameras, world_to_camera=away), None), 0)
    assert found.depth.shape == (120, 160) and not found.depth.any()


def test_depth_that_no_view_confirms_is_unknown(scene, swept):
    empty = [DepthMap(m.name, np.zeros_like(m.depth), "mvs") for m in swept[1:]]
    assert not agreed_view(scene, (swept[0], *empty), 0).depth.any()


def test_depth_that_one_view_alone_confirms_is_dropped_when_two_must(scene, swept):
    empty = [DepthMap(m.name, np.zeros_like(m.depth), "mvs") for m in swept[2:]]
    assert (agreed_view(scene, (*swept[:2], *empty), 0, min_views=1).depth > 0).mean() > 0.5
    assert not agreed_view(scene, (*swept[:2], *empty), 0, min_views=2).depth.any()


def test_of_two_views_one_confirms_the_other(scene, swept):
    _, cameras, _ = scene
    both = agree(swept[:2], cameras_by_view(cameras)[:2], params=AgreementParams(min_views=2))
    assert (both.depth > 0).mean() > 0.5


def test_views_that_were_compared_without_any_result_are_refused(scene, swept):
    empty = tuple(DepthMap(m.name, np.zeros_like(m.depth), "mvs") for m in swept)
    with pytest.raises(InputError, match="no depth is found in any of the 5 views"):
        unit(scene[1], empty)


def test_sweeping_twice_gives_the_same_bits(scene, swept):
    np.testing.assert_array_equal(swept_view(scene, 0).depth, swept[0].depth)


@pytest.mark.parametrize("metric", [True, False])
def test_a_scene_so_small_that_renderers_would_cut_it_off_is_refused(scene, metric):
    frames, cameras, _ = scene
    cameras = replace(cameras, metric=metric)

    def flat(away):
        return tuple(DepthMap(frame.name, np.full((6, 8), away, np.float32), "sensor") for frame in frames)

    assert unit(cameras, flat(0.03)).length == pytest.approx(1.0 if metric else 0.015)
    said = r"is 0\.0076 units away from them \(median\), .* nearer than 0\.01; .* depth, by 1000\."
    with pytest.raises(InputError, match=said):
        unit(cameras, flat(0.0076))
