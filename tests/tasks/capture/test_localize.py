"""Photos that are kept back come to where the others, whose poses are right, see the same points."""

from dataclasses import replace

import numpy as np
import pytest
from generated_views import jittered, views

from ss_flow.tasks.capture.features import Features, features
from ss_flow.tasks.capture.localize import localized
from ss_flow.tasks.capture.matches import match

EYES = [(x, y, 0.1 * x) for x in (-0.9, -0.3, 0.3, 0.9) for y in (-0.3, 0.3)]
BETWEEN = [(0.0, 0.1, 0.0), (0.6, -0.1, 0.1)]


@pytest.fixture(scope="module")
def compared():
    """Trained photos with their cameras and matches, and the same of photos between them."""
    every, cameras, _ = views([*EYES, *BETWEEN], width=320, height=240, focal=300.0)
    photos = [features(frame) for frame in every]
    own, beside = photos[: len(EYES)], photos[len(EYES) :]
    trained, kept = rows(cameras, slice(0, len(EYES))), rows(cameras, slice(len(EYES), None))
    matches = tuple(match(photo, own[:row]) for row, photo in enumerate(own))
    return trained, own, matches, kept, beside, [match(photo, own) for photo in beside]


def rows(cameras, some):
    arrays = {name: getattr(cameras, name)[some] for name in ("names", "sizes", "intrinsics", "world_to_camera")}
    return replace(cameras, **arrays)


def off(cameras, true):
    """[K] how far each camera stands from its true place, and by how many degrees it is turned."""
    between = cameras.world_to_camera @ np.linalg.inv(true.world_to_camera)
    turned = np.degrees(np.arccos(np.clip((np.trace(between[:, :3, :3], axis1=1, axis2=2) - 1) / 2, -1, 1)))
    return np.linalg.norm(between[:, :3, 3], axis=1), turned


def test_poses_that_are_off_come_near_the_true_ones(compared):
    trained, own, matches, true, beside, found = compared
    given = jittered(true, 0.08, 3.0)
    with pytest.warns(UserWarning, match=r"^2 of 2 views that were kept back moved by 0\.\d+ .* have them\.$"):
        placed = localized(given, beside, found, trained, own, matches)
    for before, after in zip(off(given, true), off(placed, true), strict=True):
        assert (after < before / 5).all()
    assert placed.names == true.names
    np.testing.assert_array_equal(placed.intrinsics, given.intrinsics)


def test_they_may_be_called_like_photos_that_are_trained_on(compared):
    trained, own, matches, true, beside, found = compared
    given = jittered(true, 0.08, 3.0)
    names = {name: trained.names[row] for row, name in enumerate(true.names)}
    alike = [replace(photo, name=names[photo.name]) for photo in beside]
    with pytest.warns(UserWarning, match="2 of 2 views"):
        placed = localized(given, beside, found, trained, own, matches)
        again = localized(
            replace(given, names=tuple(names.values())),
            alike,
            [replace(one, name=names[one.name]) for one in found],
            trained,
            own,
            matches,
        )
    np.testing.assert_array_equal(again.world_to_camera, placed.world_to_camera)


def test_a_photo_that_shares_nothing_keeps_its_pose_and_is_named(compared):
    trained, own, matches, true, beside, found = compared
    given = jittered(true, 0.08, 3.0)
    empty = Features(beside[1].name, 320, 240, np.zeros((0, 2), np.float32), np.zeros((0, 128), np.uint8))
    with pytest.warns(UserWarning, match=f"^1 of 2 views .* keep their poses: {empty.name}\\.$"):
        placed = localized(given, [beside[0], empty], [found[0], match(empty, own)], trained, own, matches)
    np.testing.assert_array_equal(placed.world_to_camera[1], given.world_to_camera[1])
    assert not np.array_equal(placed.world_to_camera[0], given.world_to_camera[0])


def test_where_no_photo_shares_anything_all_keep_their_poses(compared):
    trained, own, matches, true, *_ = compared
    empty = [
        Features(name, 320, 240, np.zeros((0, 2), np.float32), np.zeros((0, 128), np.uint8)) for name in true.names
    ]
    with pytest.warns(UserWarning, match="^None of 2 views"):
        placed = localized(true, empty, [match(one, own) for one in empty], trained, own, matches)
    np.testing.assert_array_equal(placed.world_to_camera, true.world_to_camera)
