"""Which instances overlap, and which of them are merged next (Split&Splat, Sec. 3.2.3; spec P4)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ss_flow.tasks.artifacts import Float32, Float64, Gaussians, Int32


@dataclass(frozen=True)
class MergePlan:
    """One round of merging: pairs that can be merged side by side."""

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
        return np.array([[np.inf] * 3, [-np.inf] * 3])
    solid = gaussians.opacities >= min_opacity
    centers = gaussians.means[solid] if solid.any() else gaussians.means
    return np.quantile(centers.astype(np.float64), (quantile, 1 - quantile), axis=0)


def collision_matrix(centers: Sequence[Float32 | Float64], boxes: Float64) -> Float64:
    """C_ab, the share of a's Gaussians inside b's box; C_aa = 0 (Split&Splat, Sec. 3.2.3, Eq. of C_ab).

    centers: of each of G groups [N_g, 3]; boxes: [G, 2, 3]. Borders belong to the box. Returns [G, G].
    """
    matrix = np.zeros((len(centers), len(centers)))
    for a, points in enumerate(centers):
        for b, (low, high) in enumerate(boxes):
            if a != b and len(points):
                matrix[a, b] = ((points >= low) & (points <= high)).all(axis=1).mean()
    return matrix


def match_pairs(collisions: Float64, sizes: Int32, ids: Int32, *, min_score: float = 0.0) -> tuple[Int32, Float64]:
    """Pairs of groups to merge at once, by greedy vertex-disjoint matching (spec P4, A19, A21).

    The overlap of a pair is s_ab = max(C_ab, C_ba). The pair with the largest s above `min_score` whose groups are both
    free is taken, until there is none; ties go to the pair with fewer Gaussians, then to the lowest ids.

    collisions: [G, G]; sizes: [G] numbers of Gaussians; ids: [G] lowest instance id of each group, unique.
    Returns pairs [P, 2] of positions, lower id first, and their scores [P], descending.
    """
    score = np.maximum(collisions, collisions.T)
    a, b = np.nonzero((score > min_score) & (ids[:, None] < ids[None, :]))
    best_first = np.lexsort((ids[b], ids[a], sizes[a] + sizes[b], -score[a, b]))
    used = np.zeros(len(ids), bool)
    pairs = []
    for i in best_first:
        if not used[a[i]] and not used[b[i]]:
            used[[a[i], b[i]]] = True
            pairs.append((a[i], b[i]))
    chosen = np.array(pairs, np.int32).reshape(-1, 2)
    return chosen, score[chosen[:, 0], chosen[:, 1]]
