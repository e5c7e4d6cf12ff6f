"""Which instances overlap, and which of them are merged next (Split&Splat, Sec. 3.2.3; spec P4)."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ss_flow.tasks.artifacts import Bool, Float32, Float64, Gaussians, Int32
from ss_flow.tasks.packed import ViewLists

SOLID_OPACITY = 0.1
"""Fainter Gaussians say nothing of where a group is."""
TRIMMED = 0.005
"""Share of the centres that is trimmed off at both ends of each axis of a group's box."""
NOWHERE = ((np.inf,) * 3, (-np.inf,) * 3)
"""A box that holds nothing."""
_AROUND = np.array(list(itertools.product((-1, 0, 1), repeat=3)))
"""A cube and all that touch it."""


@dataclass(frozen=True)
class MergePlan(ViewLists):
    """One round of merging: pairs that can be merged side by side, a row each, with the views that show any instance of
    a pair."""

    pairs: Int32
    """[P, 2] positions of the groups to merge, the one with the lower instance id first; no group is in two pairs."""
    scores: Float32
    """[P] overlap of each pair, descending."""
    singles: Int32
    """[S] positions of the groups that stay as they are in this round, ascending."""
    mask_weight: float
    """w_mask of this round."""
    collisions: Float32
    """[G, G] the collision matrix C of all groups."""


def group_box(gaussians: Gaussians, *, min_opacity: float, quantile: float) -> Float64:
    """The axis-aligned box B of a group's centres: [2, 3] lowest and highest corner, world (spec P4).

    Centres of Gaussians fainter than `min_opacity` do not count, unless all are; `quantile` is trimmed off at both ends
    of each axis. A group without Gaussians gets a box that holds nothing.
    """
    if not len(gaussians):
        return np.array(NOWHERE)
    solid = gaussians.opacities >= min_opacity
    centers = gaussians.means[solid] if solid.any() else gaussians.means
    return np.quantile(centers.astype(np.float64), (quantile, 1 - quantile), axis=0)


def collision_matrix(centers: Sequence[Float32 | Float64], boxes: Float64) -> Float64:
    """C_ab, the share of a's Gaussians inside b's box; C_aa = 0 (Split&Splat, Eq. 4).

    centers: of each of G groups [N_g, 3]; boxes: [G, 2, 3]. Borders belong to the box. Returns [G, G].
    """
    return _matrix(centers, boxes, lambda points, b: ((points >= boxes[b, 0]) & (points <= boxes[b, 1])).all(axis=1))


def voxel_collisions(groups: Sequence[Gaussians], *, min_opacity: float, voxel: float) -> Float64:
    """C_ab, the share of a's Gaussians in or next to a cube that a solid Gaussian of b lies in (spec A20).

    Where the box of a floor holds half the room, its cubes hold what touches it. voxel: side of the cubes, world units.
    Returns [G, G].
    """
    cells = [np.floor(g.means.astype(np.float64) / voxel).astype(np.int64) for g in groups]
    everywhere = np.concatenate(cells)
    if not len(everywhere):
        return np.zeros((len(groups), len(groups)))
    low = everywhere.min(axis=0) - 1
    size = everywhere.max(axis=0) - low + 2

    def keys(places: NDArray[np.int64]) -> NDArray[np.int64]:
        return np.ravel_multi_index(tuple((places - low).T), tuple(size))

    solid = [c[g.opacities >= min_opacity] for c, g in zip(cells, groups, strict=True)]
    taken = [np.unique(keys((c[:, None] + _AROUND).reshape(-1, 3))) for c in solid]
    boxes = np.array([[c.min(axis=0) - 1, c.max(axis=0) + 1] if len(c) else NOWHERE for c in solid], np.float64)
    return _matrix(cells, boxes, lambda places, group: np.isin(keys(places), taken[group]))


def _matrix(places: Sequence[NDArray[Any]], boxes: Float64, inside: Callable[[NDArray[Any], int], Bool]) -> Float64:
    """The share of a's places [N, 3] that are inside b; most pairs are told apart by their boxes alone."""
    matrix = np.zeros((len(places), len(places)))
    for a, own in enumerate(places):
        if len(own):
            near = (boxes[:, 0] <= own.max(axis=0)) & (boxes[:, 1] >= own.min(axis=0))
            for b in np.flatnonzero(near.all(axis=1)).tolist():
                if a != b:
                    matrix[a, b] = inside(own, b).mean()
    return matrix


def match_pairs(
    collisions: Float64, sizes: Int32, ids: Int32, *, min_score: float = 0.0, collision_free: bool = False
) -> tuple[Int32, Float64]:
    """Pairs of groups to merge at once, by greedy vertex-disjoint matching (spec P4, A19, A21).

    The overlap of a pair is s_ab = max(C_ab, C_ba). The pair with the largest s above `min_score` whose groups are both
    free is taken, until there is none; ties go to the pair with fewer Gaussians, then to the lowest ids.

    collisions: [G, G]; sizes: [G] Gaussians; ids: [G] lowest instance id of each group, unique if it collides.
    collision_free: the paper's text taken literally: a pair waits while a group of it collides with another pair's.
    Returns pairs [P, 2] of positions, lower id first, and their scores [P], descending.
    """
    score = np.maximum(collisions, collisions.T)
    collide = score > min_score
    a, b = np.nonzero(collide & (ids[:, None] < ids[None, :]))
    best_first = np.lexsort((ids[b], ids[a], sizes[a] + sizes[b], -score[a, b]))
    busy = np.zeros(len(ids), bool)
    pairs = []
    for i in best_first:
        pair = [a[i], b[i]]
        if not busy[pair].any():
            busy[pair] = True
            if collision_free:
                busy |= collide[pair].any(axis=0)
            pairs.append(pair)
    chosen = np.array(pairs, np.int32).reshape(-1, 2)
    return chosen, score[chosen[:, 0], chosen[:, 1]]
