"""The ray-cast scene with what a few seconds of training make of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from ball_and_box import SmallScene

from ss_flow.tasks.artifacts import Gaussians
from ss_flow.tasks.splat.merge import MergeParams
from ss_flow.tasks.splat.reconstruct import ReconstructParams

TRAIN = ReconstructParams(min_iterations=300, max_iterations=300, max_points=900)
MERGE = MergeParams(min_iterations=300, max_iterations=300, global_iterations=200)


@dataclass
class Built:
    """The scene, and what a training of each of its instances alone gave."""

    scene: SmallScene
    box: Gaussians
    ball: Gaussians
    background: Gaussians

    @property
    def views(self):
        return self.scene.views


def same(a: Gaussians, b: Gaussians) -> bool:
    return all(np.array_equal(getattr(a, name), getattr(b, name)) for name in vars(a))
