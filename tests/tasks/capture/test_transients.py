"""What only one photo shows at a place through which the others see is ignored; all that stands still stays."""

import warnings
from dataclasses import replace

import numpy as np
import pytest
from generated_views import jittered, views

from ss_flow.tasks.artifacts import DepthMap
from ss_flow.tasks.capture.transients import TransientParams, transients, without_transients
from ss_flow.tasks.geometry.images import decode_valid, encode_valid

EYES = [(x, y, 0.1 * x) for x in (-0.9, -0.3, 0.3, 0.9) for y in (-0.3, 0.3)]
HAND = (slice(20, 60), slice(90, 150))
"""Rows and columns of 120 x 160."""
VIEW = 3


@pytest.fixture(scope="module")
def scene():
    return views(EYES)


def measured(depths, names):
    return tuple(DepthMap(name, depth.astype(np.float32), "sensor") for name, depth in zip(names, depths, strict=True))


def with_hand(depths, near=1.5, view=VIEW):
    """The depth of all views, in one of which something stands close before the camera."""
    changed = [depth.copy() for depth in depths]
    changed[view][HAND] = near
    return changed


def found(cameras, depths, **params):
    return transients(cameras, measured(depths, cameras.names), params=TransientParams(**params))


def still(cameras, depths, **params):
    """Whether nothing moves, and nothing is said."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        return not len(found(cameras, depths, **params).view)


def test_a_hand_before_one_camera_is_found_where_it_is_and_told(scene):
    _, cameras, depths = scene
    with pytest.warns(UserWarning, match=r"^In 1 of 8 views something moves, .*: 1\d\.\d% of their pixels .* in view3"):
        moving = found(cameras, with_hand(depths))
    assert moving.view.tolist() == [VIEW]
    true = np.zeros((120, 160), bool)
    true[HAND] = True
    mask = moving.mask(0)
    assert mask[true].mean() > 0.95 and mask[~true].mean() < 0.05


def test_the_frame_keeps_its_photo_and_what_a_mask_left_out_before(scene):
    frames, cameras, depths = scene
    before = np.ones((120, 160), bool)
    before[100:] = False
    with pytest.warns(UserWarning, match="something moves"):
        moving = found(cameras, with_hand(depths))
    frame = without_transients(replace(frames[VIEW], valid=encode_valid(before)), moving, view=VIEW)
    valid = decode_valid(frame)
    assert not valid[100:].any() and valid[before & ~moving.mask(0)].all() and not valid[moving.mask(0)].any()
    np.testing.assert_array_equal(frame.encoded, frames[VIEW].encoded)


def test_a_scene_that_stands_still_stays(scene):
    _, cameras, depths = scene
    assert still(cameras, depths)
    noise = np.random.default_rng(0)
    assert still(cameras, [depth * noise.normal(1, 0.01, depth.shape) for depth in depths])


def test_what_many_views_see_is_no_hand(scene):
    """The square stands before the wall, which views see beside it."""
    _, cameras, depths = scene
    assert depths[VIEW].min() < 2.8 < 3.5 < depths[VIEW].max()
    assert still(cameras, depths, views=1)


def test_what_lies_farther_than_the_rest_is_no_hand(scene):
    """Others see no farther than the wall: nothing tells what lies behind."""
    _, cameras, depths = scene
    assert still(cameras, with_hand(depths, near=7.0))


def test_what_has_no_depth_stays(scene):
    _, cameras, depths = scene
    assert still(cameras, with_hand(depths, near=0.0))


def test_small_and_thin_pieces_stay(scene):
    _, cameras, depths = scene
    changed = [depth.copy() for depth in depths]
    changed[VIEW][20:100, 40:45] = 1.5
    changed[VIEW][50:57, 120:127] = 1.5
    assert still(cameras, changed)


def test_fewer_views_than_asked_for_tell_nothing(scene):
    _, cameras, depths = scene
    changed = with_hand(depths)
    assert still(cameras, changed, views=8)


def test_a_view_with_a_wrong_pose_has_nothing_that_moves(scene):
    _, cameras, depths = scene
    poses = cameras.world_to_camera.copy()
    poses[VIEW] = jittered(cameras, 0.6, 25.0).world_to_camera[VIEW]
    assert still(replace(cameras, world_to_camera=poses), depths)
