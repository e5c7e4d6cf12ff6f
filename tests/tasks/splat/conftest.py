"""One training of the ray-cast scene, for all the tests that start from it."""

from __future__ import annotations

import pytest
from ball_and_box import SmallScene
from trained_ball_and_box import MERGE, TRAIN, Built

from ss_flow.tasks.artifacts import Gaussians
from ss_flow.tasks.splat.global_pass import assemble, global_pass
from ss_flow.tasks.splat.merge import merge_pair
from ss_flow.tasks.splat.reconstruct import reconstruct


@pytest.fixture(scope="session")
def built() -> Built:
    scene = SmallScene()
    return Built(scene, *(reconstruct(scene.views, scene.instance(i), params=TRAIN) for i in (1, 2, 0)))


@pytest.fixture(scope="session")
def merged(built: Built) -> Gaussians:
    return merge_pair(built.views, built.box, built.ball, built.scene.maps, params=MERGE, w_mask=0.05)


@pytest.fixture(scope="session")
def whole(built: Built, merged: Gaussians) -> Gaussians:
    return global_pass(built.views, assemble((merged, built.background)), built.scene.maps, params=MERGE)
