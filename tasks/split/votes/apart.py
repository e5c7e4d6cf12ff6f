"""Pieces of a label that lie apart in space, and that the views do not show as one: labels of their own.

A mask of a table's shadow may hold the floor beside it, and one of the face of a box what stands behind it. Where two
such masks are united, so is what they hold, though most views tell it apart, or no view shows both. Pieces that lie
farther apart than the larger of them is long are no thing that masks alone could vouch for: a mask of a plant holds the
window behind its leaves. Beyond Split&Splat.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ss_flow.tasks.artifacts import Bool, Float32, Int32, Observation, PointCloud
from ss_flow.tasks.geometry.clustering import dbscan, rows_by_label
from ss_flow.tasks.split.observe import membership
from ss_flow.tasks.split.votes.at_once import correlation_clusters, evidence


def part_labels(
    label: Int32,
    cloud: PointCloud,
    observations: Sequence[Observation],
    *,
    reach: float,
    share: float,
    min_points: int,
    rate: float,
    first: int,
) -> Int32:
    """Part the labels of points whose pieces the views hold apart, or lie far apart: [N].

    label: [N] of the cloud's points, 0 = none. reach: distance between two points of a piece, in the world's unit.
    share, min_points: of a label's points that a piece needs to be asked about; smaller ones stay with the largest, or
    lose their label where they are far from it. rate: as for masks (`votes.at_once`), by whose rule the pieces of a
    label are clustered; what is far from the rest of its cluster is none of it. first: the number of the first new
    label; the largest cluster keeps the old one, and so do those near it that no view sees together with it.
    """
    rows_of = rows_by_label(label)
    rows_of.pop(0, None)
    large: dict[int, list[Int32]] = {}
    small: dict[int, list[Int32]] = {}
    for name, rows in rows_of.items():
        component = dbscan(cloud.points[rows], reach, min_samples=1)
        pieces = [rows[inside].astype(np.int32) for inside in rows_by_label(component).values()]
        enough = max(min_points, share * len(rows))
        large[name] = [piece for piece in pieces if len(piece) >= enough]
        small[name] = [piece for piece in pieces if len(piece) < enough]
    several = {name: pieces for name, pieces in large.items() if len(pieces) > 1}
    parted = _parted(label, cloud, observations, several, rate, first) if several else label.copy()
    for name, crumbs in small.items():
        kept = [piece for piece in large[name] if parted[piece[0]] == name]
        if kept and crumbs:
            near = _near([cloud.points[piece] for piece in kept + crumbs])
            for row, crumb in enumerate(crumbs, len(kept)):
                parted[crumb] = name if near[row, : len(kept)].any() else 0
    return parted


def _parted(
    label: Int32,
    cloud: PointCloud,
    observations: Sequence[Observation],
    pieces_of: dict[int, list[Int32]],
    rate: float,
    first: int,
) -> Int32:
    """The labels [N] once pieces (rows of points) of labels that have several are clustered."""
    from scipy.sparse import coo_array, csr_array
    from scipy.sparse.csgraph import connected_components

    pieces = [piece for some in pieces_of.values() for piece in some]
    whole = np.repeat(np.array(list(pieces_of), np.int32), [len(some) for some in pieces_of.values()])
    size = np.array([len(rows) for rows in pieces])
    view = np.repeat(np.arange(len(observations), dtype=np.int32), [len(seen.mask) for seen in observations])
    masks = [seen.inside(j) for seen in observations for j in range(len(seen.mask))]
    within = membership(masks, len(label))
    pairs, said = evidence(membership(pieces, len(label)), view, np.ones(len(masks), np.int32), masks=within)
    together = coo_array(pairs)
    same = whole[together.row] == whole[together.col]
    together = csr_array((together.data[same], (together.row[same], together.col[same])), shape=together.shape)
    cluster = correlation_clusters(together, said, np.ones(len(pieces), np.int32), rate)
    parted = label.copy()
    for own in rows_by_label(whole).values():
        near = _near([cloud.points[pieces[row]] for row in own])
        _, group = connected_components(csr_array(near & (cluster[own] == cluster[own][:, None])), directed=False)
        groups = [np.flatnonzero(group == number) for number in np.unique(group)]
        largest, *others = sorted(groups, key=lambda rows: -int(size[own[rows]].sum()))
        for rows in others:
            seen_together = said[own[rows]].sum(axis=0) @ said[own[largest]].sum(axis=0) > 0
            if seen_together or not near[np.ix_(rows, largest)].any():
                parted[np.concatenate([pieces[row] for row in own[rows]])] = first
                first += 1
    return parted


def _near(pieces: Sequence[Float32]) -> Bool:
    """[P, P] whether pieces, [n, 3] points each, lie no farther apart than the larger of them is long, by the boxes
    around them."""
    low, high = (np.array([extreme(points, axis=0) for points in pieces]) for extreme in (np.min, np.max))
    length = np.linalg.norm(high - low, axis=1)
    gap = np.maximum(np.maximum(low[:, None] - high, low - high[:, None]), 0)
    return np.linalg.norm(gap, axis=2) <= np.maximum(length[:, None], length)
