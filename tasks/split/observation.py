"""What the masks of the views say about the dense points."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ss_flow.tasks.artifacts import Float32, Int32, MaskSet, Visibility
from ss_flow.tasks.geometry.clustering import main_clusters
from ss_flow.tasks.ranges import Count, Fraction, NonNegative
from ss_flow.tasks.split.erosion import ErosionParams, interiors

if TYPE_CHECKING:
    from scipy.sparse import csr_array


@dataclass(frozen=True)
class MaskPoints:
    """One mask's share of a view's surface points (Split&Splat, Eq. 3: P_{k,j})."""

    mask: int
    """Index in its MaskSet."""
    points: Int32
    """[Q] rows of the point cloud under the eroded mask, ascending."""
    pixels: Int32
    """[P] flat indices of the eroded mask's pixels, ascending."""
    covered: int
    """Pixels of the eroded mask where at least one visible point falls."""


@dataclass(frozen=True)
class ClusterParams:
    """Which points under a mask belong together (DBSCAN; spec rows 14 and 15)."""

    eps: NonNegative = 0.0
    """Neighbourhood radius in multiples of the cloud's spacing; 0 keeps all points."""
    min_samples: Count = 10
    """Neighbours that make a core point."""
    keep_share: Fraction = 0.1
    """Clusters with at least this share of the points are kept, and always the largest; 1 keeps that one alone."""


def observe(
    visibility: Visibility,
    masks: MaskSet,
    points: Float32,
    spacing: float,
    erosion: ErosionParams,
    clusters: ClusterParams,
    *,
    nested: bool,
) -> list[MaskPoints]:
    """The points under each eroded mask of one view, in canonical mask order.

    points: [N, 3] the cloud that `visibility` indexes, of the given spacing. nested: whether a point inside two masks
    counts for both; if not, it counts for the smaller.
    """
    seen = []
    inside = np.zeros(visibility.height * visibility.width, bool)
    for interior in interiors(masks, erosion, nested=nested):
        inside[interior.pixels] = True
        under = inside[visibility.pixel]
        rows = visibility.point_index[under]
        covered = len(np.unique(visibility.pixel[under]))
        inside[interior.pixels] = False
        if clusters.eps and rows.size:
            kept = main_clusters(points[rows], clusters.eps * spacing, clusters.min_samples, clusters.keep_share)
            rows = rows[kept]
        seen.append(MaskPoints(interior.mask, rows, interior.pixels, covered))
    return seen


def membership(groups: list[Int32], num_points: int) -> csr_array:
    """Groups of points as a sparse matrix [groups, points] of ones."""
    from scipy.sparse import csr_array

    bounds = np.cumsum([0, *(len(group) for group in groups)])
    columns = np.concatenate(groups) if groups else np.zeros(0, np.int32)
    return csr_array((np.ones(len(columns), np.float32), columns, bounds), shape=(len(groups), num_points))
