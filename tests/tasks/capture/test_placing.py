"""What a sensor measured of features, and photos that are placed by it, from others whose poses are known."""

import numpy as np
import pytest
from generated_views import views
from numpy.testing import assert_array_equal

from ss_flow.tasks.artifacts import DepthMap
from ss_flow.tasks.capture import placing
from ss_flow.tasks.capture.features import features
from ss_flow.tasks.capture.matches import match
from ss_flow.tasks.capture.placing import places

EYES = [(x, y, 0.1 * x) for x in (-0.9, 0.0, 0.9) for y in (-0.3, 0.3)]


@pytest.fixture(scope="module")
def scene():
    frames, cameras, exact = views(EYES, width=320, height=240, focal=300.0)
    photos = [features(frame) for frame in frames]
    depths = [
        DepthMap(frame.name, depth.astype(np.float32), "sensor") for frame, depth in zip(frames, exact, strict=True)
    ]
    return photos, cameras, depths, tuple(match(photo, photos[:row]) for row, photo in enumerate(photos))


def test_depth_between_two_surfaces_or_among_unknown_pixels_counts_as_unknown():
    depth = np.full((9, 9), 2, np.float32)
    depth[:, 4:] = 3
    depth[4, 1] = 0
    depth[6:, :3] = 0
    depth[8, 0] = 2
    points = np.array([(2.5, 2.5), (3.5, 4.5), (6.2, 4.5), (1.5, 4.5), (1.5, 7.5)])
    assert_array_equal(placing._depth_at(points, depth), [2, np.nan, 3, 2, np.nan])


def test_photos_find_their_places_in_the_world_of_known_poses(scene):
    photos, cameras, depths, matches = scene
    known = {row: cameras.world_to_camera[row] for row in (1, 4)}
    found = places(photos, depths, cameras, matches, min_matches=10, known=known)
    assert sorted(found) == list(range(6))
    for row, pose in known.items():
        assert_array_equal(found[row], pose)
    np.testing.assert_allclose([found[row] for row in range(6)], cameras.world_to_camera, atol=0.01)


def test_a_photo_that_matches_none_of_the_known_ones_has_no_place(scene):
    photos, cameras, depths, matches = scene
    known = {1: cameras.world_to_camera[1]}
    assert list(places(photos, depths, cameras, matches[:1], min_matches=10, known=known)) == [1]
