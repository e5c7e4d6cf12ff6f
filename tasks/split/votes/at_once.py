"""Labels from all views at once: correlation clustering of the masks, then a vote of the views on every point.

Every view that sees two masks says how far their points lie under one mask of its own. Masks are united as long as
what speaks for it outweighs what speaks against it (Bansal, Blum, Chawla: "Correlation Clustering", 2004, with real
weights). Up to `max_views` views, no order of views enters, nor does a second copy of all of them. A mask that holds
two objects is outvoted by those that part them. What is small from afar lies there under the mask of what it stands
on; so a view from farther off counts less (`words_of`). Beyond Split&Splat, whose labels can only grow together.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ss_flow.running import progress
from ss_flow.tasks.artifacts import INSIDE, STRAY, Float32, Float64, Int32, Observation, Visibility
from ss_flow.tasks.ranges import Count, Fraction
from ss_flow.tasks.split.votes.votes import Votes

if TYPE_CHECKING:
    from scipy.sparse import csr_array

_AT_ONCE = 1 << 12
"""Pairs of masks that are weighed at once: few enough for what is said of them to stay in the processor's caches. Of a
million pairs, a twentieth of the time went into the weighing, the rest into fetching memory."""
_AS_NEAR = 1.4
"""Up to so many times the distance of the third nearest view, a view's word on a point counts in full."""
_STEPS = 64
"""Words are multiples of one part in so many: their sums are exact, in any order."""


@dataclass(frozen=True)
class MaskClusteringParams:
    """How masks are united, and how they vote."""

    rate: Fraction = 0.4
    """Share of what the views say about two groups of masks that must speak for their union."""
    min_points: Count = 5
    """Points inside a mask below which it takes no part."""
    min_share: Fraction = 0.02
    """Share of a mask's points below which it is not asked what another mask makes of them."""
    max_views: Count = 120
    """Views whose masks are clustered together. More are dealt out in turn into several lots; what each lot finds is
    clustered again, as if each were one view."""
    border_vote: Fraction = 0.5
    """Weight of a mask's vote for a point at its border, inside which it is 1."""
    background_vote: Fraction = 0.3
    """Weight of a view's vote against every label, for a point that it sees under no mask."""


def words_of(visibility: Sequence[Visibility], num_points: int) -> list[Float32]:
    """How much each view's word on the points that it sees counts, 0..1: [M] for each view.

    It falls with the area that a point's surroundings cover in its photo, from 1.4 times the distance on from which
    the third nearest view sees the point; with fewer than three views, all count in full.
    """
    nearest = np.full((3, num_points), np.inf, np.float32)
    # A second copy of a view is no other view.
    for view in {(view.point_index.tobytes(), view.depth.tobytes()): view for view in visibility}.values():
        depth = view.depth
        for distance in nearest:
            here = distance[view.point_index]
            distance[view.point_index], depth = np.minimum(here, depth), np.maximum(here, depth)
    words = []
    for view in visibility:
        as_near = _AS_NEAR * nearest[-1][view.point_index] / view.depth
        words.append((np.rint(_STEPS * np.minimum(as_near, 1) ** 2) / _STEPS).astype(np.float32))
    return words


def cluster_masks(
    observations: Sequence[Observation],
    num_points: int,
    params: MaskClusteringParams,
    words: Sequence[Float32] = (),
) -> list[Int32]:
    """The object that each mask of each view shows: for each view [J], 1.. from the largest object on, 0 = none.

    observations: one of each view. words: of each view, from `words_of`; without any, all count in full.
    """
    words = words or _in_full(observations)
    lots = -(-len(observations) // params.max_views)
    if lots <= 1:
        within_masks = [[seen.inside(j) for j in range(len(seen.mask))] for seen in observations]
        said = [[word[seen.rows_inside(j)] for j in range(len(seen.mask))]
                for seen, word in zip(observations, words, strict=True)]  # fmt: skip
        return _cluster(within_masks, said, num_points, params)
    within: list[Int32] = [np.zeros(0, np.int32)] * len(observations)
    found: list[list[Int32]] = []
    for lot in range(lots):
        # Every lot gets views from all over, so that all lots see the same objects.
        views = observations[lot::lots]
        within[lot::lots] = labels = cluster_masks(views, num_points, params, words[lot::lots])
        leader, _ = vote_at_once(num_points, views, labels, params, words[lot::lots])[0].leaders()
        order = np.argsort(leader, kind="stable").astype(np.int32)
        count = max((int(of_view.max(initial=0)) for of_view in labels), default=0)
        found.append(np.split(order, np.searchsorted(leader[order], np.arange(1, count + 1)))[1:])
    in_full = [[np.ones(len(rows), np.float32) for rows in of_lot] for of_lot in found]
    across = _cluster(found, in_full, num_points, params)
    return [np.append(0, across[k % lots])[of_view].astype(np.int32) for k, of_view in enumerate(within)]


def _in_full(observations: Sequence[Observation]) -> list[Float32]:
    return [np.ones(len(seen.point_index), np.float32) for seen in observations]


def _cluster(
    views: list[list[Int32]], words: list[list[Float32]], num_points: int, params: MaskClusteringParams
) -> list[Int32]:
    """The same for the points inside the masks of each view, and the view's word on each of them."""
    contents = [
        b"".join(
            [np.int64(len(p)).tobytes() + p.tobytes() + word.tobytes() for p, word in zip(masks, said, strict=True)]
        )
        for masks, said in zip(views, words, strict=True)
    ]
    first: dict[bytes, int] = {}
    original = [first.setdefault(content, k) for k, content in enumerate(contents)]
    labels = [np.zeros(len(masks), np.int32) for masks in views]
    found = [
        (points, k, j) for k in first.values() for j, points in enumerate(views[k]) if len(points) >= params.min_points
    ]
    if found:
        # The canonical order of masks keeps ties from depending on the order of views.
        found.sort(key=lambda mask: (-len(mask[0]), mask[0].tobytes(), contents[mask[1]]))
        members = membership([points for points, _, _ in found], num_points)
        alike = Counter(original)
        copies = np.array([alike[k] for _, k, _ in found])
        spoken = members.copy()
        spoken.data = np.sqrt(np.concatenate([words[k][j] for _, k, j in found]))  # of a pair it takes the product
        view = np.array([k for _, k, _ in found])
        together, said = evidence(members, view, copies, params.min_share, masks=spoken)
        cluster = correlation_clusters(together, said, copies, params.rate)
        size = np.bincount(cluster, weights=np.diff(members.indptr))
        number = np.empty(len(size), np.int32)
        number[np.argsort(-size, kind="stable")] = np.arange(1, len(size) + 1)
        for (_, k, j), label in zip(found, number[cluster].tolist(), strict=True):
            labels[k][j] = label
    return [labels[k] for k in original]


def membership(groups: list[Int32], num_points: int) -> csr_array:
    """Groups of points as a sparse matrix [groups, points] of ones."""
    from scipy.sparse import csr_array

    bounds = np.cumsum([0, *(len(group) for group in groups)])
    columns = np.concatenate([np.zeros(0, np.int32), *groups])
    return csr_array((np.ones(len(columns), np.float32), columns, bounds), shape=(len(groups), num_points))


def evidence(
    members: csr_array, view: Int32, copies: Int32, min_share: float = 0.0, *, masks: csr_array | None = None
) -> tuple[csr_array, Float64]:
    """What the views say about pairs of masks.

    members: [T, N] which points lie inside which mask. masks: [T, N] the same, each point with the root of its view's
    word on it; without, all words count in full. view: [T] the view of each mask. copies: [T] how many views there are
    like that one. min_share: smaller g_im (see below) count as 0.
    Returns `together` [T, T] and `said` [T, K]. Let g_im be the share of the points of mask i that lie inside mask m,
    and u_ik the sum of g_im over the masks of view k. A point of i and one of j, drawn at random, are both seen under
    masks of view k with probability u_ik u_jk, and under the same one with the sum of g_im g_jm. `together` holds the
    latter, summed over the views; `said` is u, so that `said said^T` sums the former.
    """
    from scipy.sparse import csr_array, diags_array

    size = np.diff(members.indptr)
    share = csr_array(diags_array(1 / size) @ csr_array(members @ (members if masks is None else masks).T))
    share.data[share.data < min_share] = 0
    share.eliminate_zeros()
    weighted = share @ diags_array(np.sqrt(copies))
    _, first, column = np.unique(view, return_index=True, return_inverse=True)
    of_view = csr_array((np.ones(len(view)), (np.arange(len(view)), column)))
    return csr_array(weighted @ weighted.T), (share @ of_view).toarray() * np.sqrt(copies[first])


def correlation_clusters(together: csr_array, said: Float64, copies: Int32, rate: float) -> Int32:
    """Unite what belongs together: [T] the cluster of each mask, numbered by their first masks.

    together, said: from `evidence`. copies: [T] how many masks there are like each. The weight of a union is the mean
    of together - rate * said said^T over the pairs of masks that it brings together. In each round all pairs of
    clusters are united that are each other's best partner, until no union has a positive weight; with a mean (average
    linkage), uniting the best pairs one by one would give the same.
    """
    from scipy.sparse import csr_array, diags_array

    cluster = np.arange(len(said), dtype=np.int32)
    joined = csr_array(diags_array(copies.astype(np.float64)))
    while True:
        together, said = csr_array(joined @ together @ joined.T), np.asarray(joined @ said)
        size = np.bincount(cluster, weights=copies).astype(np.float64)
        a, b, weight = _weights(together, said, rate, size)
        # Best partner of each cluster: the highest weight, then the lowest number.
        order = np.lexsort((b, -weight, a))
        first = np.flatnonzero(np.diff(a[order], prepend=-1))
        best = np.full(len(said), -1, np.int32)
        best[a[order[first]]] = b[order[first]]
        mutual = np.flatnonzero((best >= 0) & (best[best] == np.arange(len(best))))
        if not len(mutual):
            return cluster
        lowest = np.arange(len(said), dtype=np.int32)
        lowest[mutual] = np.minimum(mutual, best[mutual])
        _, united = np.unique(lowest, return_inverse=True)
        joined = csr_array((np.ones(len(united)), (united, np.arange(len(united)))))
        cluster = united[cluster].astype(np.int32)


def _weights(together: csr_array, said: Float64, rate: float, size: Float64) -> tuple[Int32, Int32, Float64]:
    """The pairs of clusters a, b whose union has a positive weight, each both ways round.

    together, said: summed over the masks of each cluster. size: how many these are.
    """
    from scipy.sparse import triu

    pairs = triu(together, k=1, format="coo")
    a, b, weight = pairs.row, pairs.col, pairs.data.copy()
    for start in range(0, len(a), _AT_ONCE):
        part = slice(start, start + _AT_ONCE)
        weight[part] -= rate * np.einsum("pk,pk->p", said[a[part]], said[b[part]])
    # Rounded, so that sums in another order are equal where they should be.
    weight = np.round(weight / (size[a] * size[b]), 9)
    good = weight > 0
    a, b, weight = a[good], b[good], weight[good]
    return np.concatenate([a, b]), np.concatenate([b, a]), np.concatenate([weight, weight])


def vote_at_once(
    num_points: int,
    observations: Sequence[Observation],
    labels: list[Int32],
    params: MaskClusteringParams,
    words: Sequence[Float32] = (),
) -> tuple[Votes, Float32]:
    """The votes of all views on all points: those for labels, and [N] the weight of those against any.

    labels: for each view, what each of its masks shows, 0 = nothing. words: as in `cluster_masks`. A mask votes for the
    points under it; a view votes against all labels where it sees a point under none of its masks.
    """
    votes = Votes(num_points)
    against = np.zeros(num_points, np.float32)
    words = words or _in_full(observations)
    for k, (seen, shown, word) in enumerate(zip(observations, labels, words, strict=True)):
        progress(k, len(labels), seen.name)
        for j in np.flatnonzero(shown).tolist():
            row, standing = seen.under(j)
            kept = standing != STRAY
            weight = np.where(standing == INSIDE, 1.0, params.border_vote)[kept]
            votes.add(seen.point_index[row[kept]], int(shown[j]), weight * word[row[kept]])
        if len(seen.mask):  # a view without masks knows nothing
            free = np.ones(len(seen.point_index), bool)
            free[seen.row] = False
            against[seen.point_index[free]] += word[free]
    return votes, params.background_vote * against
