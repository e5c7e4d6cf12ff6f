import numpy as np
import pytest
from generated_views import views

from ss_flow.tasks.capture.features import Features, features
from ss_flow.tasks.capture.matches import descriptor_matches, match, near_epipolar_lines

EYES = [(-0.6, -0.3, 0.0), (-0.2, 0.3, 0.1), (0.5, 0.0, -0.1)]


@pytest.fixture(scope="module")
def scene():
    frames, cameras, _ = views(EYES, width=320, height=240, focal=300.0)
    return [features(frame) for frame in frames], cameras


def unit(rng, count):
    rows = rng.normal(size=(count, 128))
    return np.abs(np.round(512 * rows / np.linalg.norm(rows, axis=1, keepdims=True))).astype(np.float32)


def slow_matches(a, b):
    """The definition, row by row."""
    found = []
    angle = np.arccos(np.minimum(a.astype(float) @ b.T.astype(float) / 512**2, 1))
    for i, row in enumerate(angle):
        first, second = np.argsort(row, kind="stable")[:2]
        if row[first] <= 0.7 and row[first] < 0.8 * row[second] and angle[:, first].argmin() == i:
            found.append((i, int(first)))
    return found


def true_fundamental(cameras, a, b):
    """F of two views by their true cameras (Hartley and Zisserman, Eq. 9.1)."""

    def matrix(k):
        fx, fy, cx, cy = cameras.intrinsics[k]
        return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])

    relative = cameras.world_to_camera[b] @ np.linalg.inv(cameras.world_to_camera[a])
    x, y, z = relative[:3, 3]
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.linalg.inv(matrix(b)).T @ cross @ relative[:3, :3] @ np.linalg.inv(matrix(a))


def off_line(points_a, points_b, fundamental):
    """Distance of points b from the lines of points a, in pixels."""
    lines = np.column_stack([points_a, np.ones(len(points_a))]) @ fundamental.T
    reach = (np.column_stack([points_b, np.ones(len(points_b))]) * lines).sum(axis=1)
    return np.abs(reach) / np.linalg.norm(lines[:, :2], axis=1)


def test_matches_are_mutual_and_pass_the_ratio_test():
    rng = np.random.default_rng(0)
    a = unit(rng, 700)
    b = np.concatenate([np.round(a[:400] + rng.normal(0, 8, (400, 128))), unit(rng, 200)]).astype(np.float32)
    b = np.maximum(b[rng.permutation(600)], 0)
    assert descriptor_matches(a, b).tolist() == [list(pair) for pair in slow_matches(a, b)]
    assert len(descriptor_matches(a, b)) > 300


def test_a_feature_that_stands_twice_in_the_other_photo_matches_neither():
    a = unit(np.random.default_rng(1), 5)
    twice = np.concatenate([a, a[:1]])
    assert descriptor_matches(a, twice)[:, 0].tolist() == [1, 2, 3, 4]


def test_a_photo_without_features_has_no_matches(scene):
    photos, _ = scene
    none = Features("blank", 320, 240, np.zeros((0, 2), np.float32), np.zeros((0, 128), np.uint8))
    for found in (match(none, photos[:2]), match(photos[0], [none])):
        assert found.others == ()
        assert found.pair.shape == (0, 2)
        assert found.first.tolist() == [0]


def test_matches_of_two_views_lie_on_their_epipolar_lines(scene):
    photos, cameras = scene
    found = match(photos[2], photos[:2])
    assert found.others == ("view0", "view1")
    for i, k in enumerate((0, 1)):
        pairs = found.pairs_with(i)
        assert len(pairs) > 100
        own, other = photos[2].points[pairs[:, 0]], photos[k].points[pairs[:, 1]]
        assert np.median(off_line(own, other, true_fundamental(cameras, 2, k))) < 1.0
        assert np.median(off_line(own, other, found.fundamental[i])) < 1.0


def test_guided_matching_finds_more_that_is_right(scene):
    photos, cameras = scene
    plain, guided = match(photos[2], photos[:1]), match(photos[2], photos[:1], guided=True)
    assert len(guided.pair) > len(plain.pair)
    own, other = photos[2].points[guided.pair[:, 0]], photos[0].points[guided.pair[:, 1]]
    assert len(np.unique(guided.pair[:, 1])) == len(guided.pair)
    assert (off_line(own, other, true_fundamental(cameras, 2, 0)) < 4).mean() > 0.95


def test_points_near_epipolar_lines_are_those_of_sampsons_distance(scene):
    photos, cameras = scene
    fundamental = true_fundamental(cameras, 0, 1)
    a, b = photos[0].points[:30].astype(float), photos[1].points[:40].astype(float)
    allowed = near_epipolar_lines(a, b, fundamental)(slice(10, 30))
    for i in range(20):
        for j in range(40):
            x, y = np.append(a[10 + i], 1), np.append(b[j], 1)
            line, back = fundamental @ x, fundamental.T @ y
            sampson = (y @ line) ** 2 / (line[0] ** 2 + line[1] ** 2 + back[0] ** 2 + back[1] ** 2)
            assert allowed[i, j] == (sampson <= 16)
    assert 0 < allowed.mean() < 0.5


def test_two_matchings_agree_to_the_bit(scene):
    photos, _ = scene
    once, again = match(photos[2], photos[:2]), match(photos[2], photos[:2])
    np.testing.assert_array_equal(once.pair, again.pair)
    np.testing.assert_array_equal(once.fundamental, again.fundamental)
