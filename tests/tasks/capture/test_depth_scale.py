"""Depth of another scale than the poses is found and brought to theirs; depth of the same scale is left alone."""

from dataclasses import replace

import numpy as np
import pytest
from generated_views import views

from ss_flow.tasks.artifacts import DepthMap
from ss_flow.tasks.capture.depth_scale import DepthScale, depth_scale, rescaled

EYES = [(x, y, 0.5 * x + y) for x in (-0.9, 0.0, 0.9) for y in (-0.3, 0.3)]
"""Some nearer than others: along a wall no step tells how far it is."""


@pytest.fixture(scope="module")
def scene():
    """Cameras, and depth with a noise of half a per cent."""
    frames, cameras, exact = views(EYES)
    noise = np.random.default_rng(0)
    maps = [(depth * noise.normal(1, 0.005, depth.shape)).astype(np.float32) for depth in exact]
    return cameras, [DepthMap(frame.name, depth, "sensor") for frame, depth in zip(frames, maps, strict=True)]


@pytest.mark.parametrize("off", [0.95, 1.02, 1.05])
def test_the_scale_of_the_poses_is_found_and_said(scene, off):
    cameras, right = scene
    wrong = [replace(depth, depth=depth.depth * np.float32(off)) for depth in right]
    with pytest.warns(UserWarning, match=r"multiplied by [01][.]\d\d\d, so that it fits the poses: .* 0\.\d+% instead"):
        found = depth_scale(cameras, wrong)
    assert found.counts
    assert found.factor == pytest.approx(1 / off, rel=0.006)
    np.testing.assert_allclose(rescaled(wrong[0], factor=found.factor).depth, right[0].depth, rtol=0.006)


def test_depth_of_the_right_scale_stays_without_a_word(scene, recwarn):
    found = depth_scale(*scene)
    assert found.factor == pytest.approx(1, abs=0.003)
    assert not found.counts
    assert not recwarn.list


def test_views_of_which_no_other_shows_the_same_tell_nothing(scene, recwarn):
    cameras, depths = scene
    blind = [replace(depth, depth=np.zeros_like(depth.depth)) for depth in depths]
    for given in (blind, [*depths[:1], *blind[1:]]):
        found = depth_scale(cameras, given)
        assert (found.factor, found.counts) == (1.0, False)
    assert not recwarn.list


@pytest.mark.parametrize("unit", [0.5, 1.2, 1000])
def test_another_unit_is_left_alone(scene, unit, recwarn):
    cameras, depths = scene
    assert not depth_scale(cameras, [replace(d, depth=d.depth * np.float32(unit)) for d in depths]).counts
    assert not recwarn.list


def test_a_factor_counts_from_a_clear_gain_on():
    assert DepthScale(0.98, 0.01, 0.009).counts
    assert not DepthScale(0.98, 0.01, 0.0095).counts
