"""Pieces of a label that lie apart in space, and that the views do not show as one: labels of their own.

A mask of a table's shadow may hold the floor beside it, and one of the face of a box what stands behind it. Where two
such masks are united, so is what they hold, though most views tell it apart. Beyond Split&Splat.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ss_flow.tasks.artifacts import Float32, Int32, Observation, PointCloud
from ss_flow.tasks.geometry.clustering import dbscan, rows_by_label
from ss_flow.tasks.split.votes.at_once import correlation_clusters, evidence, membership


def part_labels(
    label: Int32,
    cloud: PointCloud,
    observations: Sequence[Observation],
    *,
    reach: Float32,
    share: float,
    min_points: int,
    rate: float,
    first: int,
) -> Int32:
    """Part the labels of points whose pieces the views hold apart: [N].

    label: [N] of the cloud's points, 0 = none. reach: [N] distance between two points of a piece, in the world's unit.
    share, min_points: of a label's points that a piece needs to be asked about; smaller ones stay with the largest.
    rate: as for masks (`votes.at_once`), by whose rule the pieces of a label are clustered. first: the number of the
    first new label; the largest cluster keeps the old one, and so do those that no view sees together with it.
    """
    from scipy.sparse import coo_array, csr_array

    pieces: list[Int32] = []
    of: list[int] = []
    rows_of = rows_by_label(label)
    rows_of.pop(0, None)
    for label_id, rows in rows_of.items():
        component = dbscan(cloud.points[rows], reach[rows], min_samples=1)
        large = np.flatnonzero(np.bincount(component) >= max(min_points, share * len(rows)))
        if len(large) > 1:
            pieces += [rows[component == number].astype(np.int32) for number in large]
            of += [label_id] * len(large)
    if not pieces:
        return label
    whole = np.array(of, np.int32)
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
        clusters = [own[cluster[own] == number] for number in np.unique(cluster[own])]
        largest, *others = sorted(clusters, key=lambda rows: -int(size[rows].sum()))
        for rows in others:
            if said[rows].sum(axis=0) @ said[largest].sum(axis=0) > 0:
                parted[np.concatenate([pieces[row] for row in rows])] = first
                first += 1
    return parted
