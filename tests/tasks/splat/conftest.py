"""The ray-cast scene, and one training of it, for all the tests that start from them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from ball_and_box import SmallScene
from trained_ball_and_box import MERGE, TRAIN, Built

from ss_flow.tasks.artifacts import Gaussians
from ss_flow.tasks.gaussians.initialise import initialise
from ss_flow.tasks.geometry.sampling import first_of_each_cube
from ss_flow.tasks.splat.global_pass import assemble, global_pass
from ss_flow.tasks.splat.merge import merge_pair
from ss_flow.tasks.splat.reconstruct import reconstruct


@pytest.fixture(scope="session")
def small() -> SmallScene:
    return SmallScene()


@pytest.fixture(scope="session")
def scene(small: SmallScene) -> Gaussians:
    """Small, opaque Gaussians all over the surface, with their true labels."""
    rows = first_of_each_cube(small.points, 0.03)
    labels = small.labels[rows]
    round_ones = initialise(small.points[rows], small.colors[rows], labels, 0.9, np.full(len(rows), 3), opacity=0.95)
    return replace(round_ones, log_scales=round_ones.log_scales - np.float32(np.log(2)))


@pytest.fixture(scope="session")
def built(small: SmallScene) -> Built:
    return Built(small, *(reconstruct(small.views, small.instance(i), params=TRAIN) for i in (1, 2, 0)))


@pytest.fixture(scope="session")
def merged(built: Built) -> Gaussians:
    return merge_pair(built.views, built.box, built.ball, built.scene.maps, params=MERGE, w_mask=0.05)


@pytest.fixture(scope="session")
def whole(built: Built, merged: Gaussians) -> Gaussians:
    return global_pass(built.views, assemble((merged, built.background)), built.scene.maps, params=MERGE)
