"""One round of merging: who merges with whom (Split&Splat, Sec. 3.2.3; spec P4)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np

from ss_flow.task import task
from ss_flow.tasks.artifacts import Appearances, Float64, Gaussians
from ss_flow.tasks.geometry.clustering import nearest_spacing
from ss_flow.tasks.ranges import Fraction, Natural, NonNegative, Positive, Range
from ss_flow.tasks.splat.collisions import (
    SOLID_OPACITY,
    TRIMMED,
    MergePlan,
    collision_matrix,
    group_box,
    match_pairs,
    voxel_collisions,
)
from ss_flow.tasks.unread import by_default


@dataclass(frozen=True)
class PlanParams:
    """When two groups of instances count as colliding, and how long pairs of them are merged."""

    max_rounds: Natural = 0
    """Rounds of merging pairs; then the last pass over the whole scene refines all that collide together. Pairs before
    it gained nothing, and took 273 of the 1,191 s of Splat on fifty photos (docs/measurements/splat.md), so there are
    none unless asked for; the paper merges until nothing collides."""
    overlap: Literal["box", "voxel"] = "box"
    """What two groups must share: "box", as in the paper, or "voxel", cubes of space, which tells what touches a floor
    from what stands in the room."""
    voxel: Positive = 2.5
    """Side of these cubes, in median distances from a Gaussian to the nearest other: 5 cm where that is 2 cm."""
    pairing: Literal["disjoint", "collision_free"] = "disjoint"
    """Which pairs are merged side by side: "disjoint" ones, or only those no groups of which collide ("collision_free",
    the paper's words taken literally; a floor then lets one pair through at a time)."""
    min_opacity: Fraction = SOLID_OPACITY
    """Fainter Gaussians do not widen the box of their group."""
    bbox_quantile: Annotated[float, Range(0.0, 0.5, open_above=True)] = TRIMMED
    """Share of the centres trimmed off at both ends of each axis of the box; 0 in the paper."""
    min_score: Fraction = 0.0
    """Pairs that overlap by no more than this are left apart."""
    mask_weights: tuple[NonNegative, ...] = (0.05, 0.15, 0.25)
    """w_mask of each round; the last one holds for all further rounds."""

    def in_use(self) -> PlanParams:
        """With what is not read as by default, so that it does not enter the key."""
        if not self.max_rounds:
            return PlanParams(max_rounds=0)
        return by_default(self, "voxel" if self.overlap == "box" else "bbox_quantile")


@task()
def plan(groups: tuple[Gaussians, ...], shown: Appearances, *, params: PlanParams, round: int) -> MergePlan:
    """The pairs of groups that are merged in a round, and the weight of the mask loss for them.

    groups: the instances, or what earlier rounds made of them, in any order. shown: the views of each instance. round:
    from 0. The background (instance 0) reaches everywhere; it stays by itself until the pass over the whole scene.
    Merging is over when the plan has no pairs: when nothing collides, or after `max_rounds`.
    """
    last = round >= params.max_rounds
    collisions = np.zeros((len(groups), len(groups))) if last else _collisions(groups, params)
    background = [i for i, g in enumerate(groups) if not g.instance_id.any()]
    collisions[background, :] = collisions[:, background] = 0
    sizes = np.array([len(g) for g in groups], np.int32)
    ids = np.array([g.instance_id.min(initial=np.iinfo(np.int32).max) for g in groups], np.int32)
    pairs, scores = match_pairs(
        collisions, sizes, ids, min_score=params.min_score, collision_free=params.pairing == "collision_free"
    )
    views = [shown.of(np.concatenate([groups[a].instance_id, groups[b].instance_id])) for a, b in pairs]
    return MergePlan(
        pairs=pairs,
        scores=scores.astype(np.float32),
        singles=np.setdiff1d(np.arange(len(groups)), pairs).astype(np.int32),
        mask_weight=params.mask_weights[min(round, len(params.mask_weights) - 1)],
        collisions=collisions.astype(np.float32),
        **MergePlan.arrays(views),
    )


def _collisions(groups: tuple[Gaussians, ...], params: PlanParams) -> Float64:
    if params.overlap == "voxel":
        means = np.concatenate([g.means for g in groups])
        side = params.voxel * (nearest_spacing(means) if len(means) > 1 else 1.0)
        return voxel_collisions(groups, min_opacity=params.min_opacity, voxel=side)
    boxes = np.array([group_box(g, min_opacity=params.min_opacity, quantile=params.bbox_quantile) for g in groups])
    return collision_matrix([g.means for g in groups], boxes)
