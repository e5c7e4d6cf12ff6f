"""Density-based clustering of points in space."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ss_flow.running import cores
from ss_flow.tasks.artifacts import Bool, Float32, Float64, Int32, Int64

if TYPE_CHECKING:
    from scipy.spatial import cKDTree


def dbscan(points: Float32 | Float64, eps: float | Float32, min_samples: int) -> Int32:
    """DBSCAN (Ester et al. 1996): [N] cluster of each point, -1 for noise.

    points: [N, 3]; eps: neighbourhood radius, inclusive, in the points' unit, of all or [N] of each, of which the
    larger one of two points counts; min_samples: how many points, itself among them, make a core point. Clusters are
    numbered by their first core point; a border point within reach of several clusters joins the lowest.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    count = len(points)
    cluster = np.full(count, -1, np.int32)
    if not count:
        return cluster
    pairs = _pairs(points, eps)
    core = np.bincount(pairs.ravel(), minlength=count) + 1 >= min_samples
    a, b = pairs[core[pairs].all(axis=1)].T
    _, component = connected_components(
        coo_array((np.ones(len(a), bool), (a, b)), shape=(count, count)), directed=False
    )
    _, first, inverse = np.unique(component[core], return_index=True, return_inverse=True)
    cluster[core] = np.argsort(np.argsort(first))[inverse]

    reach = np.concatenate([pairs, pairs[:, ::-1]])
    reach = reach[~core[reach[:, 0]] & core[reach[:, 1]]]
    joined = np.full(count, count, np.int32)
    np.minimum.at(joined, reach[:, 0], cluster[reach[:, 1]])
    border = joined < count
    cluster[border] = joined[border]
    return cluster


def _pairs(points: Float32 | Float64, eps: float | Float32) -> NDArray[np.intp]:
    """[P, 2] the pairs of points that lie no farther apart than `eps`, or than the larger one of theirs."""
    from scipy.spatial import cKDTree

    radii, group = np.unique(eps, return_inverse=True)
    if len(radii) == 1:
        return np.asarray(cKDTree(points).query_pairs(float(radii[0]), output_type="ndarray"))
    rows = [np.flatnonzero(group == number) for number in range(len(radii))]
    trees = [cKDTree(points[some]) for some in rows]
    pairs = []
    for number, radius in enumerate(radii.tolist()):
        pairs.append(rows[number][trees[number].query_pairs(radius, output_type="ndarray")])
        for smaller in range(number):
            near = trees[smaller].sparse_distance_matrix(trees[number], radius, output_type="ndarray")
            pairs.append(np.stack([rows[smaller][near["i"]], rows[number][near["j"]]], axis=1))
    return np.concatenate(pairs)


def main_clusters(
    points: Float32 | Float64,
    eps: float | Float32,
    min_samples: int,
    keep_share: float,
    max_clusters: int = 0,
) -> Bool:
    """[N] which points lie in a cluster worth keeping: the largest, and all with at least `keep_share` of the points.

    All points are kept where none is dense enough to form a cluster, and where there are more than `max_clusters` of
    them (0 = however many). Arguments as in `dbscan`.
    """
    cluster = dbscan(points, eps, min_samples)
    if not len(points) or cluster.max() < 0:
        return np.ones(len(points), bool)
    size = np.bincount(cluster[cluster >= 0])
    if 0 < max_clusters < len(size):
        return np.ones(len(points), bool)
    keep = size >= keep_share * len(points)
    keep[size.argmax()] = True
    return (cluster >= 0) & keep[cluster]


def nearest_within(tree: cKDTree, places: Float32, count: int, reach: Float32) -> Int64:
    """[M, count] the points of a tree nearest to each of some places [M, 3], no farther away than `reach` [M]; the
    tree's size where there are fewer."""
    farthest = float(reach.max(initial=0))
    which = np.arange(1, count + 1)
    distance, near = tree.query(places, k=which, distance_upper_bound=farthest, workers=cores())
    return np.where(distance < reach[:, None], near, tree.n)


def nearest_spacing(points: Float32 | Float64) -> float:
    """Median distance of the points [N, 3] to their nearest neighbour; 0.0 for fewer than two points."""
    from scipy.spatial import cKDTree

    if len(points) < 2:
        return 0.0
    distance = np.asarray(cKDTree(points).query(points, k=2, workers=cores())[0])
    return float(np.median(distance[:, 1]))


def rows_by_label(labels: Int32) -> dict[int, NDArray[np.intp]]:
    """The rows that carry each label that occurs in [N], ascending."""
    order = np.argsort(labels, kind="stable")
    found, starts = np.unique(labels[order], return_index=True)
    return dict(zip(found.tolist(), np.split(order, starts[1:]), strict=True)) if len(labels) else {}
