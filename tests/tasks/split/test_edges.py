from dataclasses import replace

import numpy as np
import pytest
from clouds import even_cloud
from labelled_points import labels_of

from ss_flow.tasks.artifacts import Cameras, Tally, Visibility
from ss_flow.tasks.geometry.cameras import looking
from ss_flow.tasks.split.edges import convex_edges
from ss_flow.tasks.split.hierarchy import HierarchyParams, hierarchy
from ss_flow.tasks.split.votes.touching import TouchingParams, borders

SIDE = 24
"""Points along a face."""
TOP, FRONT, GROUND = 1, 2, 3


def face(origin, along, up) -> np.ndarray:
    """SIDE x SIDE points, one unit apart, of a square face."""
    i, j = np.meshgrid(np.arange(SIDE), np.arange(SIDE), indexing="ij")
    return np.array(origin) + i.reshape(-1, 1) * np.array(along) + j.reshape(-1, 1) * np.array(up)


def cameras_at(*places) -> Cameras:
    count = len(places)
    poses = [looking(np.array(place, float), np.array([0.0, 1, 0]), np.array([0.0, 0, 1])) for place in places]
    sizes, intrinsics = np.full((count, 2), 8, np.int32), np.tile([8.0, 8, 4, 4], (count, 1))
    return Cameras(tuple("abc"[:count]), sizes, intrinsics, np.array(poses), True)


def scene():
    """A box's top and front, and the ground before it, from above; nothing of them is hidden."""
    faces = [
        face((0, 0, SIDE), (1, 0, 0), (0, 1, 0)),
        face((0, 0, 0.5), (1, 0, 0), (0, 0, 1)),
        face((0, -0.5, 0), (1, 0, 0), (0, -1, 0)),
    ]
    places = np.concatenate(faces).astype(np.float32)
    places += np.random.default_rng(0).normal(scale=0.05, size=places.shape).astype(np.float32)
    label = np.repeat(np.array([TOP, FRONT, GROUND], np.int32), SIDE**2)
    cloud = even_cloud(places, np.zeros((len(places), 3), np.uint8), 1.0, 1.0)
    every = np.arange(len(places), dtype=np.int32)
    view = Visibility("a", every, np.zeros_like(every), np.ones(len(every), np.float32), 8, 8)
    return cloud, cameras_at((12, -60, 80)), view, label


def edges(cloud, cameras, view, label):
    """When all cameras see what one view does."""
    return convex_edges(cloud, cameras, [view] * len(cameras), label, borders(label, cloud, TouchingParams()))


def test_faces_of_a_box_meet_in_a_convex_edge_and_the_ground_before_it_in_a_hollow():
    assert np.argwhere(np.triu(edges(*scene()))).tolist() == [[TOP - 1, FRONT - 1]]


def test_from_inside_of_a_box_its_faces_meet_in_a_hollow():
    cloud, _, view, label = scene()
    assert not edges(cloud, cameras_at((12, 12, 12)), view, label)[TOP - 1, FRONT - 1]


def test_most_cameras_tell_the_outside_of_a_surface_however_far_away_the_others_are():
    cloud, _, view, label = scene()
    above, far_below = (12, -60, 80), (12, 6000, -8000)
    assert edges(cloud, cameras_at(above, above, far_below), view, label)[TOP - 1, FRONT - 1]
    assert not edges(cloud, cameras_at(above, far_below, far_below), view, label)[TOP - 1, FRONT - 1]


@pytest.mark.parametrize(("width", "meet"), [(9, False), (15, True)])
def test_an_edge_is_convex_where_most_of_it_is(width, meet):
    cloud, cameras, view, label = scene()
    rises = (label == FRONT) & (cloud.points[:, 0] > width - 0.5)  # beside where it falls off from the top
    places = np.where(rises[:, None], (0, 0, 2 * SIDE) + cloud.points * (1, 1, -1), cloud.points).astype(np.float32)
    assert edges(replace(cloud, points=places), cameras, view, label)[TOP - 1, FRONT - 1] == meet


def test_a_fence_along_the_edge_of_a_table_is_no_face_of_it():
    # From in front the table is behind the fence's plane, but the fence does not fall off behind that of the table.
    cloud, cameras, view, label = scene()
    places = cloud.points + np.where((label == TOP)[:, None], (0, 0.5, -SIDE), 0)
    assert not edges(replace(cloud, points=places.astype(np.float32)), cameras, view, label).any()


def test_halves_of_one_face_meet_in_no_edge():
    cloud, cameras, view, label = scene()
    halves = np.where((label == TOP) & (cloud.points[:, 0] > SIDE / 2), 4, label)
    assert not edges(cloud, cameras, view, halves)[TOP - 1, 3]


@pytest.mark.parametrize(("width", "meet"), [(3, False), (6, True)])
def test_an_edge_that_is_short_beside_the_borders_of_both_says_nothing(width, meet):
    cloud, cameras, view, label = scene()
    strip = np.where((label == FRONT) & (cloud.points[:, 0] > width - 0.5), 4, label)  # the rest of the front is 4
    assert edges(cloud, cameras, view, strip)[TOP - 1, FRONT - 1] == meet


@pytest.mark.parametrize(
    ("together", "apart", "agreement"), [(2, 1, 0.8), (1, 2, None), (0, 0, None)], ids=["shown", "denied", "unseen"]
)
def test_faces_are_one_unless_the_views_deny_it(together, apart, agreement):
    # The masks that hold both hold much else, so that alone they show nothing.
    cloud, cameras, view, label = scene()
    seen = np.full(3, SIDE**2, np.int32)
    views = [[[1, 1, 1]]] * together + [[[1, 0, 0], [0, 1, 0], [0, 0, 1]]] * apart
    tallies = [
        Tally(
            "a",
            np.arange(1, 4, dtype=np.int32),
            seen - number,
            np.array(masks, np.int32) * (seen - number),
            np.zeros((3, 3), np.int32),
            np.full(len(masks), 0.5 if len(masks) == 1 else 0.95, np.float32),
        )
        for number, masks in enumerate(views)
    ]

    def found(**changes):
        tree = hierarchy(cloud, cameras, [view], labels_of(label), tallies, params=HierarchyParams(**changes))
        rows = zip(tree.node, tree.agreement, strict=True)
        return {tuple(tree.node[tree.parent == node].tolist()): share for node, share in rows}

    assert found(convex=0.8).get((TOP, FRONT)) == (None if agreement is None else pytest.approx(agreement))
    assert (TOP, FRONT) not in found(convex=0.0)
