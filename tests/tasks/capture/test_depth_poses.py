"""Frames of a depth sensor are placed by what it measured: at its scale, and only where depth does not contradict."""

from dataclasses import replace

import numpy as np
import pytest
from generated_views import views
from numpy.testing import assert_array_equal

from ss_flow.errors import InputError
from ss_flow.tasks.artifacts import DepthMap
from ss_flow.tasks.capture.depth_poses import placed_by_depth
from ss_flow.tasks.capture.features import features
from ss_flow.tasks.capture.matches import match

EYES = [(x, y, 0.1 * x) for x in (-0.9, -0.3, 0.3, 0.9) for y in (-0.3, 0.3)]
ASKED = {"min_matches": 15, "min_registered": 0.5}


@pytest.fixture(scope="module")
def scene():
    """Features, cameras, depth of half the photos' size that is off by one per cent, matches."""
    frames, cameras, exact = views(EYES, width=320, height=240, focal=300.0)
    photos = [features(frame) for frame in frames]
    noise = np.random.default_rng(0)
    depths = [
        DepthMap(frame.name, (depth[::2, ::2] * noise.normal(1, 0.01, (120, 160))).astype(np.float32), "sensor")
        for frame, depth in zip(frames, exact, strict=True)
    ]
    return photos, cameras, depths, tuple(match(photo, photos[:row]) for row, photo in enumerate(photos))


def unposed(cameras):
    return replace(cameras, world_to_camera=np.tile(np.eye(4), (len(cameras), 1, 1)))


def errors(found, true):
    """Of the views relative to each other, the largest: of the direction in degrees, and of the distance in per cent of
    the largest."""
    rows = [true.names.index(name) for name in found.names]
    poses, right = found.world_to_camera, true.world_to_camera[rows]
    turned, apart = [], []
    for a in range(len(rows)):
        for b in range(a):
            one, other = (p[a] @ np.linalg.inv(p[b]) for p in (poses, right))
            cosine = (np.trace(one[:3, :3] @ other[:3, :3].T) - 1) / 2
            turned.append(np.degrees(np.arccos(np.clip(cosine, -1, 1))))
            apart.append((np.linalg.norm(one[:3, 3]), np.linalg.norm(other[:3, 3])))
    found_apart, true_apart = np.transpose(apart)
    return max(turned), 100 * np.abs(found_apart - true_apart).max() / true_apart.max()


def test_frames_are_placed_at_the_scale_of_their_depth(scene):
    photos, true, depths, matches = scene
    found = placed_by_depth(photos, unposed(true), depths, matches, **ASKED)
    assert (found.names, found.metric) == (true.names, True)
    turned, apart = errors(found, true)
    assert turned < 0.3
    assert apart < 1.0
    doubled = [replace(depth, depth=2 * depth.depth) for depth in depths]
    larger = placed_by_depth(photos, unposed(true), doubled, matches, **ASKED)
    twice = replace(true, world_to_camera=true.world_to_camera * [*[(1, 1, 1, 2)] * 3, (1, 1, 1, 1)])
    assert max(errors(larger, twice)) < 1.0
    assert_array_equal(found.world_to_camera, placed_by_depth(photos, true, depths, matches, **ASKED).world_to_camera)


def test_a_frame_without_depth_is_placed_by_that_of_others(scene):
    photos, true, depths, matches = scene
    blind = [*depths[:5], replace(depths[5], depth=np.zeros_like(depths[5].depth)), *depths[6:]]
    found = placed_by_depth(photos, unposed(true), blind, matches, **ASKED)
    assert found.names == true.names
    assert errors(found, true)[1] < 1.0


def test_a_pose_that_the_depth_of_its_frame_contradicts_is_not_taken(scene):
    photos, true, depths, matches = scene
    elsewhere = [*depths[:5], replace(depths[5], depth=1.5 * depths[5].depth), *depths[6:]]
    found = placed_by_depth(photos, unposed(true), elsewhere, matches, **ASKED)
    assert found.names == tuple(name for row, name in enumerate(true.names) if row != 5)
    assert errors(found, true)[1] < 1.0


@pytest.mark.parametrize("lacking", ["matches", "depth"])
def test_too_few_placed_frames_end_the_run_with_one_sentence(scene, lacking):
    photos, true, depths, matches = scene
    if lacking == "matches":
        matches = ()
    else:
        depths = [replace(depth, depth=np.zeros_like(depth.depth)) for depth in depths]
    with pytest.raises(InputError, match="only 1 of 8 frames found their place by what the depth sensor measured"):
        placed_by_depth(photos, unposed(true), depths, matches, **ASKED)


def test_where_all_cannot_be_adjusted_together_the_poses_of_the_sensor_stay_with_a_warning(scene, monkeypatch):
    photos, true, depths, matches = scene
    monkeypatch.setattr("ss_flow.tasks.capture.refine_poses._LEAST_POINTS", 10**9)
    with pytest.warns(UserWarning, match="Poses stay as the depth sensor gave them"):
        found = placed_by_depth(photos, unposed(true), depths, matches, **ASKED)
    assert errors(found, true)[1] < 5
