from dataclasses import replace

import numpy as np
import pytest
from generated_views import looking_at, views

from ss_flow.tasks.capture.neighbors import NeighborParams, neighbors

RING = [(3 * np.sin(a), -0.3, -3 * np.cos(a)) for a in np.linspace(0, 2 * np.pi, 20, endpoint=False)]
"""Places round a point; cameras that look at it have no parallax of use beyond the next few."""


@pytest.fixture(scope="module")
def ring():
    _, cameras, _ = views(RING, width=16, height=12, focal=15)
    poses = np.stack([looking_at(np.array(eye), np.zeros(3)) for eye in RING])
    return replace(cameras, world_to_camera=poses)


def test_neighbours_are_the_views_that_overlap_from_beside(ring):
    found = neighbors(ring, params=NeighborParams(count=4))
    for view in range(20):
        beside = sorted((view + step) % 20 for step in (-2, -1, 1, 2))
        assert found.views(view) == beside
        assert found.around(view) == [view, *beside]


def test_a_view_more_changes_the_neighbours_of_those_beside_it_only(ring):
    few = replace(
        ring,
        names=ring.names[:-1],
        sizes=ring.sizes[:-1],
        intrinsics=ring.intrinsics[:-1],
        world_to_camera=ring.world_to_camera[:-1],
    )
    before, after = (neighbors(cameras, params=NeighborParams(count=4)) for cameras in (few, ring))
    changed = [view for view in range(19) if before.views(view) != after.views(view)]
    assert changed == [0, 1, 17, 18]


def test_fewer_views_than_asked_for_are_all_neighbours(ring):
    assert neighbors(ring, params=NeighborParams(count=50)).views(3) == [k for k in range(20) if k != 3]


def test_the_span_is_that_of_the_sparse_points_seen_or_unknown(ring):
    random = np.random.default_rng(0)
    points = np.column_stack([random.uniform(-0.2, 0.2, (100, 2)), np.full(100, -1.0)]).astype(np.float32)
    seen = neighbors(replace(ring, sparse_points=points))
    near, far = seen.span_of(0)
    assert 1.5 < near < 2.0 < far < 2.8  # they lie 2 from the first view
    assert neighbors(replace(ring, sparse_points=points[:20])).span_of(0) is None
    assert neighbors(ring).span_of(0) is None
