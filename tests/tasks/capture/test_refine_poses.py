"""Poses that were jittered must come back near the true ones, in the world and at the scale that were given."""

from dataclasses import replace

import numpy as np
import pytest
from generated_views import jittered, views

from ss_flow.errors import InputError
from ss_flow.tasks.artifacts import DepthMap
from ss_flow.tasks.capture import refine_poses
from ss_flow.tasks.capture.features import Features, features
from ss_flow.tasks.capture.matches import match
from ss_flow.tasks.capture.refine_poses import RefinePosesParams, refined_cameras

EYES = [(x, y, 0.1 * x) for x in (-0.9, -0.3, 0.3, 0.9) for y in (-0.3, 0.3)]


@pytest.fixture(scope="module")
def scene():
    frames, cameras, _ = views(EYES, width=320, height=240, focal=300.0)
    photos = [features(frame) for frame in frames]
    return photos, cameras, tuple(match(photo, photos[:row]) for row, photo in enumerate(photos))


def relative_errors(cameras, true):
    """Median error of the poses of views relative to each other: of the direction in degrees, and of the place."""
    turned, moved = [], []
    for a in range(len(true)):
        for b in range(a):
            one, other = (c.world_to_camera[a] @ np.linalg.inv(c.world_to_camera[b]) for c in (cameras, true))
            off = one @ np.linalg.inv(other)
            turned.append(np.degrees(np.arccos(np.clip((np.trace(off[:3, :3]) - 1) / 2, -1, 1))))
            moved.append(np.linalg.norm(one[:3, 3] - other[:3, 3]))
    return float(np.median(turned)), float(np.median(moved))


def test_jittered_poses_come_back_near_the_true_ones(scene):
    photos, true, matches = scene
    given = jittered(true, 0.03, 1.0)
    with pytest.warns(UserWarning, match="Bundle adjustment moves the given poses of 8 of 8 views") as told:
        refined = refined_cameras(photos, given, matches)
    before, after = relative_errors(given, true), relative_errors(refined, true)
    assert before[0] > 0.8
    assert after[0] < before[0] / 8
    assert after[1] < before[1] / 4
    assert (refined.names, refined.metric) == (true.names, True)
    assert len(refined.sparse_points) > 300
    np.testing.assert_array_equal(refined.intrinsics, true.intrinsics)
    assert "points are seen 0." in str(told[0].message)


def test_the_world_stays_where_the_given_poses_have_it(scene):
    photos, true, matches = scene
    moved = np.array([[0, -2, 0, 5], [2, 0, 0, -3], [0, 0, 2, 1], [0, 0, 0, 1]], float)  # turned, doubled, shifted

    def elsewhere(cameras):
        poses = cameras.world_to_camera @ np.linalg.inv(moved)
        poses[:, :3] *= 2
        return replace(cameras, world_to_camera=poses)

    given = jittered(true, 0.03, 1.0)
    with pytest.warns(UserWarning, match="Bundle adjustment moves"):
        here, there = refined_cameras(photos, given, matches), refined_cameras(photos, elsewhere(given), matches)
    np.testing.assert_allclose(there.world_to_camera, elsewhere(here).world_to_camera, atol=0.02)


def test_exact_poses_hardly_move(scene):
    photos, true, matches = scene
    with pytest.warns(UserWarning, match="Bundle adjustment moves"):
        refined = refined_cameras(photos, true, matches)
    turned, moved = relative_errors(refined, true)
    assert turned < 0.1
    assert moved < 0.02


def test_a_photo_that_shares_nothing_keeps_its_given_pose(scene):
    photos, true, matches = scene
    empty = Features("view8", 320, 240, np.zeros((0, 2), np.float32), np.zeros((0, 128), np.uint8))
    more = replace(
        true,
        names=(*true.names, "view8"),
        sizes=np.concatenate([true.sizes, true.sizes[:1]]),
        intrinsics=np.concatenate([true.intrinsics, true.intrinsics[:1]]),
        world_to_camera=np.concatenate([true.world_to_camera, true.world_to_camera[:1]]),
    )
    given = jittered(more, 0.03, 1.0)
    with pytest.warns(UserWarning, match="of 8 of 9 views"):
        refined = refined_cameras([*photos, empty], given, matches)
    np.testing.assert_array_equal(refined.world_to_camera[8], given.world_to_camera[8])
    assert np.abs(refined.world_to_camera[:8] - given.world_to_camera[:8]).max() > 0.01


def test_a_photo_that_sees_few_points_is_placed_by_the_depth_of_a_sensor(scene):
    photos, true, _ = scene
    _, _, exact = views(EYES, width=320, height=240, focal=300.0)
    depths = [DepthMap(name, z.astype(np.float32), "sensor") for name, z in zip(true.names, exact, strict=True)]
    few = replace(photos[7], points=photos[7].points[:45], descriptors=photos[7].descriptors[:45])
    photos = [*photos[:7], few]
    matches = tuple(match(photo, photos[:row]) for row, photo in enumerate(photos))
    given = jittered(true, 0.03, 1.0)
    with pytest.warns(UserWarning, match=r"of 7 of 8 views.* Photos with too little in common .* keep theirs: view7\."):
        without = refined_cameras(photos, given, matches)
    with pytest.warns(UserWarning, match=r"of 8 of 8 views by .*medians\)\.$"):
        refined = refined_cameras(photos, given, matches, depths)
    np.testing.assert_array_equal(without.world_to_camera[7], given.world_to_camera[7])

    def off(cameras):
        """Of the last view, as seen from the one before it."""
        one, other = (c.world_to_camera[7] @ np.linalg.inv(c.world_to_camera[6]) for c in (cameras, true))
        return np.linalg.norm(one[:3, 3] - other[:3, 3])

    assert off(refined) < 0.02 < 0.04 < off(without)


def test_a_wrong_focal_length_is_refined_when_asked_for(scene):
    photos, true, matches = scene
    given = replace(true, intrinsics=true.intrinsics * (1.03, 1.03, 1, 1))
    with pytest.warns(UserWarning, match="Bundle adjustment moves"):
        refined = refined_cameras(photos, given, matches, params=RefinePosesParams(intrinsics=True))
    assert refined.intrinsics[0, 0] == pytest.approx(300, rel=0.01)


def test_photos_without_common_points_are_refused(scene):
    photos, true, _ = scene
    with pytest.raises(InputError, match="only 0 points are seen in common"):
        refined_cameras(photos, true, ())


@pytest.mark.parametrize("enough", [0, 1, 2])
def test_poses_stay_where_too_few_photos_see_enough_points(scene, enough, monkeypatch):
    photos, true, matches = scene
    monkeypatch.setattr(refine_poses, "_points", lambda model, number: 30 if number <= enough else 29)
    with pytest.raises(InputError, match="fewer than 3 photos see 30 points in common"):
        refined_cameras(photos, true, matches)
    with pytest.warns(UserWarning, match="The given poses were not refined: fewer than 3 photos see 30 points"):
        kept = refined_cameras(photos, true, matches, insist=False)
    assert kept is true


def test_cameras_in_one_place_tell_no_scale(scene):
    _, true, _ = scene
    turned = true.world_to_camera.copy()
    turned[:, :3, 3] = 0
    assert refine_poses._similarity(true.world_to_camera, turned) is None
    assert refine_poses._similarity(turned, turned) is None
