import numpy as np
import pytest
from generated_views import views

from ss_flow.tasks.geometry.cameras import Camera, backproject, camera_of, looking, project
from ss_flow.tasks.geometry.plane_sweep import (
    SweepView,
    agreeing_depth,
    best_views,
    cheapest_depth,
    inverse_depth_planes,
    matching_cost,
    smooth_cost,
    typical_depth,
    view_scores,
)

EYES = [(0, 0, 0), (0.35, 0, 0), (-0.35, 0.1, 0), (0, 0.35, 0), (0.1, -0.35, 0.1)]


def gray_view(frames, cameras, view):
    import cv2

    gray = cv2.cvtColor(cv2.imdecode(frames[view].encoded, cv2.IMREAD_COLOR), cv2.COLOR_BGR2GRAY)
    return SweepView(gray.astype(np.float32), np.ones(gray.shape, bool), camera_of(cameras, view))


def translated(x: float) -> Camera:
    pose = np.eye(4)
    pose[0, 3] = -x
    return Camera(40, 30, 30.0, 30.0, 20.0, 15.0, pose)


def test_the_matching_cost_is_least_at_the_true_depth_and_the_depth_is_found_within_a_percent():
    frames, cameras, depth = views(EYES)
    planes = inverse_depth_planes(1.5, 8.0, 64)
    seen = [gray_view(frames, cameras, k) for k in range(len(EYES))]
    cost = matching_cost(seen[0], seen[1:], planes, window=7, best=2)
    found, _ = cheapest_depth(smooth_cost(cost, seen[0].gray, 0.02, 0.15), planes)
    error = np.abs(found - depth[0])[6:-6, 6:-6] / depth[0][6:-6, 6:-6]
    assert cost.shape == (120, 160, 64)
    assert np.median(error) < 0.005
    assert np.mean(error < 0.02) > 0.9


def test_a_known_pixel_shift_costs_nothing_at_the_depth_that_explains_it():
    random = np.random.default_rng(0)
    wide = random.uniform(0, 255, (30, 50)).astype(np.float32)
    # Focal 30 and baseline 1: a shift of 5 pixels is a depth of 6.
    left = SweepView(wide[:, :40].copy(), np.ones((30, 40), bool), translated(0.0))
    right = SweepView(wide[:, 5:45].copy(), np.ones((30, 40), bool), translated(1.0))
    cost = matching_cost(left, [right], np.array([1 / 12, 1 / 6, 1 / 4]), window=5, best=1)
    inside = cost[4:-4, 10:-4]
    assert inside[..., 1].max() < 0.001
    assert inside[..., 0].min() > 0.05
    assert inside[..., 2].min() > 0.05


def test_what_no_source_sees_costs_as_much_as_what_is_unrelated():
    gray = np.random.default_rng(0).uniform(0, 255, (30, 40)).astype(np.float32)
    here = SweepView(gray, np.ones((30, 40), bool), translated(0.0))
    away = SweepView(gray, np.ones((30, 40), bool), translated(1000.0))
    masked = SweepView(gray, np.zeros((30, 40), bool), translated(0.0))
    assert (matching_cost(here, [away, masked], np.array([0.5, 1.0]), 5, 1) == 0.5).all()


def test_brightness_and_contrast_of_a_source_do_not_matter():
    frames, cameras, _ = views(EYES[:2])
    one, other = (gray_view(frames, cameras, k) for k in (0, 1))
    planes = inverse_depth_planes(2.0, 6.0, 8)
    changed = SweepView(other.gray * 0.7 + 40, other.valid, other.camera)
    plain = matching_cost(one, [other], planes, 7, 1)
    assert np.abs(plain - matching_cost(one, [changed], planes, 7, 1)).mean() < 0.01


def test_smoothing_agrees_with_a_slow_recursion_along_every_direction():
    random = np.random.default_rng(3)
    cost = random.random((5, 6, 4)).astype(np.float32)
    guide = random.uniform(0, 30, (5, 6)).astype(np.float32)
    small, large = 0.1, 0.4
    expected = np.zeros(cost.shape)
    for dv, du in [(0, 1), (0, -1), (1, 0), (-1, 0), (1, 1), (1, -1), (-1, 1), (-1, -1)]:
        paths = {}
        for v in range(5) if dv >= 0 else range(4, -1, -1):
            for u in range(6) if du >= 0 else range(5, -1, -1):
                before = paths.get((v - dv, u - du))
                for d in range(4):
                    step = 0.0
                    if before is not None:
                        jump = max(large / (1 + abs(guide[v, u] - guide[v - dv, u - du]) / 10), small)
                        reach = [before[d], min(before) + jump]
                        reach += [before[e] + small for e in (d - 1, d + 1) if 0 <= e < 4]
                        step = min(reach) - min(before)
                    paths.setdefault((v, u), [0.0] * 4)[d] = cost[v, u, d] + step
        for (v, u), values in paths.items():
            expected[v, u] += values
    np.testing.assert_allclose(smooth_cost(cost, guide, small, large), expected / 8, rtol=1e-4)


def test_a_parabola_finds_the_depth_between_planes():
    planes = inverse_depth_planes(1.0, 10.0, 10)
    true = planes[4] + 0.3 * (planes[1] - planes[0])
    cost = ((planes - true) ** 2)[None, None].astype(np.float32)
    depth, margin = cheapest_depth(cost, planes)
    assert depth[0, 0] == pytest.approx(1 / true, rel=1e-3)
    assert margin[0, 0] > 0.9


def test_depth_stays_only_where_enough_other_views_agree():
    _, cameras, depth = views(EYES)
    maps = [(d.astype(np.float32), camera_of(cameras, k)) for k, d in enumerate(depth)]
    wrong = maps[0][0].copy()
    wrong[40:60, 50:70] *= 1.2
    kept = agreeing_depth(wrong, maps[0][1], maps[1:], 1.0, 0.01, 2)
    assert (kept[42:58, 52:68] == 0).mean() > 0.98
    right = np.ones(wrong.shape, bool)
    right[40:60, 50:70] = False
    assert (kept[right] > 0).mean() > 0.75
    error = np.abs(kept - depth[0])[right & (kept > 0)] / depth[0][right & (kept > 0)]
    assert error.max() < 0.01
    assert not agreeing_depth(wrong, maps[0][1], maps[1:2], 1.0, 0.01, 2).any()


def score_of(camera: Camera, other: Camera, depth: float) -> float:
    """What `view_scores` gives for one view, pixel by pixel."""
    cosines = []
    for point in backproject(np.full((6, 8), depth, np.float32), camera.scaled(8, 6)):
        ((u, v),), (z,) = project(point[None], other)
        if z > 0 and 0 <= u < other.width and 0 <= v < other.height:
            a, b = point - camera.center, point - other.center
            cosines.append(a @ b / np.linalg.norm(a) / np.linalg.norm(b))
    if not cosines:
        return 0.0
    angle = np.degrees(np.arccos(np.clip(np.median(cosines), -1, 1)))
    return len(cosines) / 48 * np.exp(-0.5 * ((angle - 6) / (3 if angle < 6 else 10)) ** 2)


def test_the_scores_of_all_views_at_once_are_those_of_each():
    rng = np.random.default_rng(0)
    cameras = []
    for _ in range(40):
        eye = rng.uniform(-2, 2, 3) * (1, 1, 0.3)
        pose = looking(eye, rng.normal((0, 0, 1), 0.3), np.array([0.0, -1, 0]))
        cameras.append(Camera(*(40, 30) if rng.random() < 0.5 else (30, 40), *rng.uniform(25, 35, 2), 17, 18, pose))
    scores = view_scores(cameras[0], cameras[1:], 4.0)
    np.testing.assert_allclose(scores, [score_of(cameras[0], other, 4.0) for other in cameras[1:]], atol=1e-9)
    assert 0 < np.count_nonzero(scores) < len(scores)
    assert len(view_scores(cameras[0], [], 4.0)) == 0


def test_the_best_views_have_parallax_and_see_the_same():
    reference = translated(0.0)
    others = [translated(0.001), translated(0.5), translated(4.0), translated(100.0)]
    assert best_views(reference, others, depth=5.0, count=4)[0] == 1
    assert 3 not in best_views(reference, others, depth=5.0, count=4)
    assert 0 not in best_views(reference, others, depth=5.0, count=1)


def test_cameras_around_a_thing_tell_how_far_it_is():
    around = [(3 * np.sin(a), 0.0, 3.5 - 3 * np.cos(a)) for a in np.linspace(0, 2, 8)]
    _, cameras, _ = views(around, width=16, height=12)
    assert typical_depth([camera_of(cameras, k) for k in range(8)]) == pytest.approx(3.0, rel=0.05)
