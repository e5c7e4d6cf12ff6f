"""Poses that are off show in a few pairs of photos, and in depth; refined ones are used only where both agree."""

from dataclasses import replace

import numpy as np
import pytest
from generated_views import compared, jittered, looking_at
from hypothesis import given
from hypothesis import strategies as st

from ss_flow.tasks.artifacts import Cameras
from ss_flow.tasks.capture.epipolar import sampson_distance
from ss_flow.tasks.capture.pose_fit import (
    PoseFit,
    PoseFitParams,
    better_poses,
    matches_that_fit,
    pose_fit,
    pose_pairs,
)


@pytest.fixture(scope="module")
def scene():
    return compared()


def test_exact_poses_fit_and_jittered_ones_do_not(scene):
    cameras, *seen = scene
    exact = pose_fit(cameras, *seen)
    assert exact.distance < PoseFitParams().least_distance / 2
    assert exact.depth < 0.005
    off = [pose_fit(jittered(cameras, 0.03 * by, by), *seen) for by in (0.5, 1.0)]
    assert PoseFitParams().certain(exact) and not any(PoseFitParams().certain(one) for one in off)
    assert PoseFitParams().least_distance < off[0].distance < off[1].distance
    assert exact.depth < off[0].depth < off[1].depth


def test_without_depth_or_matches_nothing_is_told(scene):
    cameras, pairs, photos, matches, depths = scene
    assert np.isnan(pose_fit(cameras, pairs, photos, matches, []).depth)
    few = [replace(m, first=m.first * 0, pair=m.pair[:5]) for m in matches]
    untold = pose_fit(cameras, pairs, photos, few, depths)
    assert np.isnan(untold.distance) and not PoseFitParams().certain(untold)
    unknown = [replace(depth, depth=0 * depth.depth) for depth in depths]
    assert np.isnan(pose_fit(cameras, pairs, photos, matches, unknown).depth)


def test_matches_fit_the_poses_that_they_come_from_bent_lines_and_all(scene):
    cameras, _, photos, matches, _ = scene
    total = sum(len(found.pair) for found in matches)
    fit, of = matches_that_fit(cameras, photos, matches)
    assert of == total > 100 and fit > 0.97 * total
    assert matches_that_fit(jittered(cameras, 0.03, 1.0), photos, matches)[0] < 0.8 * fit
    # What a lens with k1 = 1 would have shown: a point 0.4 from the axis lies 0.4 (1 + 0.16) from it.
    bent = replace(cameras, radial=np.ones(len(cameras)))
    pulled = [replace(photo, points=_bent(photo.points, cameras.intrinsics[0], 1.0)) for photo in photos]
    assert matches_that_fit(bent, pulled, matches)[0] == pytest.approx(fit, abs=5)
    assert matches_that_fit(cameras, pulled, matches)[0] < fit - 20
    placed = cameras.names.index(photos[0].name)
    others = [row for row in range(len(cameras)) if row != placed]
    assert matches_that_fit(_of(cameras, others), photos, matches)[1] < total


def _bent(points, intrinsics, k1):
    away = (points - intrinsics[2:]) / intrinsics[:2]
    away = away * (1 + k1 * (away**2).sum(axis=1, keepdims=True))
    return (away * intrinsics[:2] + intrinsics[2:]).astype(np.float32)


def _of(cameras, rows):
    """The cameras of some rows."""
    return replace(
        cameras,
        names=tuple(cameras.names[row] for row in rows),
        sizes=cameras.sizes[rows],
        intrinsics=cameras.intrinsics[rows],
        world_to_camera=cameras.world_to_camera[rows],
    )


def looking_along_x(places):
    """Cameras on a line, each of which looks along x or against it."""
    poses = [looking_at(np.array([0.0, y, 0.0]), np.array([way, y, 0.0])) for y, way in places]
    return Cameras(
        names=tuple(f"view{i}" for i in range(len(poses))),
        sizes=np.full((len(poses), 2), 100, np.int32),
        intrinsics=np.full((len(poses), 4), 50.0),
        world_to_camera=np.stack(poses),
        metric=True,
    )


@given(st.lists(st.tuples(st.integers(-50, 50), st.sampled_from([-1, 1])), min_size=1, max_size=40))
def test_each_pair_is_of_nearest_views_that_look_the_same_way(placed):
    few, found = (2 * pose_pairs(looking_along_x(placed)))[:2]
    assert sorted(set(found.pair.ravel().tolist())) == list(range(len(found.view)))
    assert len(found.pair) <= 12
    assert len(few.pair) <= min(4, len(found.pair))
    for a, b in found.view[found.pair].tolist():
        assert a < b
        assert placed[a][1] == placed[b][1]

        def nearest(view):
            return min(
                abs(x - placed[view][0]) for i, (x, way) in enumerate(placed) if i != view and way == placed[view][1]
            )

        assert abs(placed[a][0] - placed[b][0]) in (nearest(a), nearest(b))


def test_sampson_distance_is_that_of_the_nearest_exact_match_for_small_errors():
    """The definition: the least movement of both points together that brings them onto each other's lines."""
    rng = np.random.default_rng(0)
    fundamental = np.array([[0, -1e-4, 0.01], [2e-4, 0, -0.1], [-0.02, 0.08, 1]])
    first = rng.uniform(0, 300, (5, 2))
    lines = np.column_stack([first, np.ones(5)]) @ fundamental.T
    foot = -lines[:, :2] * lines[:, 2:] / (lines[:, :2] ** 2).sum(axis=1, keepdims=True)  # on the line, near the corner
    second = foot + 0.1 * rng.normal(size=(5, 2))

    def least_movement(a, b):
        from scipy.optimize import minimize

        def off_line(at):
            return np.append(b + at[2:], 1) @ fundamental @ np.append(a + at[:2], 1)

        found = minimize(lambda at: at @ at, np.zeros(4), constraints={"type": "eq", "fun": off_line}, tol=1e-14)
        return np.sqrt(found.fun)

    expected = [least_movement(a, b) for a, b in zip(first, second, strict=True)]
    np.testing.assert_allclose(sampson_distance(fundamental, first, second), expected, rtol=0.02, atol=1e-4)


@pytest.mark.parametrize(
    ("after", "used"),
    [
        (PoseFit(0.0005, 0.004), True),
        (PoseFit(0.0005, np.nan), True),
        (PoseFit(0.0018, 0.004), False),  # photos gain too little
        (PoseFit(0.0005, 0.008), False),  # depth fits less well
        (PoseFit(np.nan, 0.004), False),
    ],
)
def test_refined_poses_are_used_where_photos_fit_clearly_better_and_depth_no_worse(scene, after, used):
    cameras = scene[0]
    refined = jittered(cameras, 0.01, 0.1)
    with pytest.warns(UserWarning, match="refined ones are used" if used else "refined ones fit no better"):
        chosen = better_poses(cameras, refined, PoseFit(0.002, 0.005), after)
    assert chosen is (refined if used else cameras)


def test_refined_poses_that_fit_better_but_not_well_are_not_used(scene):
    cameras = scene[0]
    before, after = PoseFit(0.23472, 0.0933), PoseFit(0.03994, 0.0769)
    with pytest.warns(UserWarning, match="do not fit its photos, nor do refined ones, so the given ones are kept"):
        assert better_poses(cameras, jittered(cameras, 0.01, 0.1), before, after) is cameras


def test_of_poses_that_could_not_be_refined_nothing_is_compared(scene):
    cameras, fit = scene[0], PoseFit(0.002, 0.005)
    with pytest.warns(UserWarning, match=r"may not be exact: matched points lie 2\.00 thousandths of") as said:
        assert better_poses(cameras, replace(cameras), fit, fit) is cameras
    assert "instead of" not in str(said[0].message)
