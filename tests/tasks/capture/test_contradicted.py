"""Photos that were taken for ones of a twin elsewhere are placed anew by what the others tell, or left out.

A hall of random points and ten photos along it, by hand: no picture, exact matches but for noise.
"""

from dataclasses import replace

import numpy as np
import pytest
from generated_views import looking_at

from ss_flow.tasks.artifacts import Cameras
from ss_flow.tasks.capture.contradicted import contradicted
from ss_flow.tasks.capture.features import Features
from ss_flow.tasks.capture.matches import Matches
from ss_flow.tasks.capture.sfm import sfm

PHOTOS, SIZE, FOCAL = 10, (640, 480), 576.0
LAST = f"{PHOTOS - 1}"
UNCALIBRATED = 3


def hall(twins=0, dense=0):
    """Cameras, photos and matches.

    Photos see the points within 3 m of them along the hall. At its end there are `dense` points more, at its beginning
    twice as many. The last photo has `twins` features that match with the first four photos, as if it stood there.
    """
    rng = np.random.default_rng(5)
    eyes = np.stack([np.linspace(0, 9, PHOTOS), rng.uniform(-0.5, 0.5, PHOTOS), rng.uniform(-0.5, 0.5, PHOTOS)], axis=1)
    aims = eyes + np.stack([rng.uniform(-0.3, 0.3, PHOTOS), np.zeros(PHOTOS), np.full(PHOTOS, 4)], axis=1)
    poses = np.stack([looking_at(eye, aim) for eye, aim in zip(eyes, aims, strict=True)])
    world = rng.uniform((-3, -2, 2.5), (12, 2, 6), (400, 3))
    ends = [rng.uniform((x, -1.2, 3), (x + 3, 1.2, 6), (count, 3)) for x, count in ((0, 2 * dense), (7.5, dense))]
    world = np.concatenate([world, *ends])
    twin = rng.uniform((-0.5, -1.2, 3), (3.5, 1.2, 6), (twins, 3))
    of_twin = looking_at(np.array([1.5, 0.2, -0.4]), (1.7, 0, 4))
    points, ids = [], []
    for row, pose in enumerate(poses):
        near = np.flatnonzero(np.abs(world[:, 0] - eyes[row, 0]) < 3)
        seen = [seen_from(pose, world[near])]
        known = [near]
        if twins and row in (0, 1, 2, 3, PHOTOS - 1):
            seen.append(seen_from(of_twin if row == PHOTOS - 1 else pose, twin))
            known.append(len(world) + np.arange(twins))
        seen, known = np.concatenate(seen), np.concatenate(known)
        inside = ((seen > 0) & (seen < SIZE)).all(axis=1)
        points.append((seen + rng.normal(0, 0.3, seen.shape))[inside].astype(np.float32))
        ids.append(known[inside])
    photos = [Features(f"{i}", *SIZE, p, np.zeros((len(p), 128), np.uint8)) for i, p in enumerate(points)]
    cameras = Cameras(
        names=tuple(photo.name for photo in photos),
        sizes=np.tile(np.array(SIZE, np.int32), (PHOTOS, 1)),
        intrinsics=np.tile((FOCAL, FOCAL, SIZE[0] / 2, SIZE[1] / 2), (PHOTOS, 1)),
        world_to_camera=poses,
        metric=False,
    )
    return cameras, photos, [matches_of(row, photos, ids) for row in range(PHOTOS)]


def seen_from(pose, points):
    local = points @ pose[:3, :3].T + pose[:3, 3]
    return FOCAL * local[:, :2] / local[:, 2:] + np.array(SIZE) / 2


def matches_of(row, photos, ids):
    """A photo's matches with those before it: the same point, or its twin."""
    found = {}
    for other in range(row):
        _, first, second = np.intersect1d(ids[row], ids[other], return_indices=True)
        if len(first) >= 15:
            found[f"{other}"] = np.stack([first, second], axis=1).astype(np.int32)
    pairs = list(found.values())
    return Matches(
        name=photos[row].name,
        others=tuple(found),
        configuration=np.full(len(pairs), UNCALIBRATED, np.int32),
        fundamental=np.zeros((len(pairs), 3, 3)),
        first=np.cumsum([0, *map(len, pairs)]).astype(np.int32),
        pair=np.concatenate([np.zeros((0, 2), np.int32), *pairs]),
    )


def off(found, true):
    """How far each photo's rotation, from the first photo's on, is from the true one, degrees."""
    rows = [true.names.index(name) for name in found.names]
    turned = [pose[:3, :3] @ found.world_to_camera[0, :3, :3].T for pose in found.world_to_camera]
    truth = [true.world_to_camera[row, :3, :3] @ true.world_to_camera[rows[0], :3, :3].T for row in rows]
    cosine = [(np.trace(a @ b.T) - 1) / 2 for a, b in zip(turned, truth, strict=True)]
    return np.degrees(np.arccos(np.clip(cosine, -1, 1)))


def turned(cameras, row, degrees=40.0):
    """The cameras, one of them turned on the spot."""
    poses = cameras.world_to_camera.copy()
    angle = np.radians(degrees)
    about = [[np.cos(angle), 0, np.sin(angle), 0], [0, 1, 0, 0], [-np.sin(angle), 0, np.cos(angle), 0], [0, 0, 0, 1]]
    poses[row] = np.array(about) @ poses[row]
    return replace(cameras, world_to_camera=poses)


@pytest.mark.parametrize("row", [0, 4, PHOTOS - 1])
def test_a_wrong_pose_is_named_and_not_those_whom_it_contradicts(row):
    cameras, photos, matches = hall()
    assert contradicted(cameras, photos, matches) == ()
    assert contradicted(turned(cameras, row), photos, matches) == (f"{row}",)


def thinned(own, count):
    """A photo's first matches with each other one."""
    pairs = [own.pairs_with(i)[:count] for i in range(len(own.others))]
    first = np.cumsum([0, *map(len, pairs)]).astype(np.int32)
    return replace(own, first=first, pair=np.concatenate([own.pair[:0], *pairs]))


def test_pairs_of_few_matches_tell_nothing():
    cameras, photos, matches = hall()
    wrong = turned(cameras, 4)
    assert contradicted(wrong, photos, [thinned(own, 30) for own in matches]) == ("4",)
    assert contradicted(wrong, photos, [thinned(own, 29) for own in matches]) == ()
    assert contradicted(wrong, photos, []) == ()


def test_where_as_much_repeats_in_all_photos_none_is_named():
    cameras, photos, matches = hall()
    rng = np.random.default_rng(0)

    def mixed(own, share):
        pair = own.pair.copy()
        for i in range(len(own.others)):
            rows = (
                own.first[i] + rng.permutation(own.first[i + 1] - own.first[i])[: int(share * len(own.pairs_with(i)))]
            )
            pair[rows, 1] = np.roll(pair[rows, 1], 1)
        return replace(own, pair=pair)

    assert contradicted(cameras, photos, [mixed(own, 0.4) for own in matches]) == ()
    assert contradicted(cameras, photos, [mixed(own, 0.6 * (own.name == LAST)) for own in matches]) == (LAST,)


def test_a_photo_that_a_twin_misplaced_is_placed_anew_where_most_of_it_says():
    true, photos, matches = hall(twins=150, dense=550)
    found = sfm(photos, tuple(matches), ())
    assert found.names == true.names
    assert off(found, true).max() < 1


def test_a_photo_that_a_twin_misplaces_twice_is_left_out():
    true, photos, matches = hall(twins=150)
    found = sfm(photos, tuple(matches), ())
    assert found.names == true.names[:-1]
    assert off(found, true).max() < 1


@pytest.mark.parametrize("twins", [{"twins": 150, "dense": 550}, {"twins": 150}])
def test_colmap_alone_leaves_it_where_the_twin_is(monkeypatch, twins):
    true, photos, matches = hall(**twins)
    monkeypatch.setattr("ss_flow.tasks.capture.sfm.contradicted", lambda *_: ())
    found = sfm(photos, tuple(matches), ())
    assert found.names == true.names
    assert np.flatnonzero(off(found, true) > 5).tolist() == [PHOTOS - 1]
