"""What the masks of each view say about the dense points (Split&Splat, Eq. 3)."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from ss_flow.task import Resources, task
from ss_flow.tasks.artifacts import (
    BORDER,
    INSIDE,
    STRAY,
    Bool,
    Float32,
    Float64,
    Int32,
    MaskSet,
    Observation,
    PointCloud,
    PromptedMasks,
    Visibility,
)
from ss_flow.tasks.geometry.clustering import main_clusters
from ss_flow.tasks.masks.erosion import ErosionParams, interiors
from ss_flow.tasks.ranges import Count, Fraction, Natural, NonNegative


@dataclass(frozen=True)
class ClusterParams:
    """Which points of a group belong together (DBSCAN; spec rows 14 and 15)."""

    eps: NonNegative = 0.0
    """Neighbourhood radius in spacings of the points; 0 keeps all points."""
    min_samples: Count = 10
    """Neighbours that make a core point."""
    keep_share: Fraction = 0.1
    """Clusters with at least this share of the points are kept, and always the largest; 1 keeps that one alone."""
    max_clusters: Natural = 0
    """Where there are more clusters than this, all points are kept; 0 = no such rule. For labels, 3 in the code of the
    paper's authors."""

    def in_use(self) -> ClusterParams:
        """As by default where all points are kept, so that what is not read does not enter the key."""
        return self if self.eps else ClusterParams(eps=0.0)

    def kept(self, points: Float32 | Float64, spacing: Float32) -> Bool:
        """[N] which of the points [N, 3] belong together; spacing: [N] of them."""
        if not self.eps:
            return np.ones(len(points), bool)
        return main_clusters(points, self.eps * spacing, self.min_samples, self.keep_share, self.max_clusters)


@dataclass(frozen=True)
class ObserveParams:
    """Which points lie under which mask."""

    nested: bool = False
    """Whether a point under two masks of a view belongs to both; if not, to the smaller one."""
    erosion: ErosionParams = field(default_factory=ErosionParams)
    """How far a mask's border is taken off."""
    clusters: ClusterParams = field(default_factory=ClusterParams)
    """Which points inside a mask are kept."""

    def in_use(self) -> ObserveParams:
        """With what is not read as by default, so that it does not enter the key."""
        return replace(self, clusters=self.clusters.in_use())


@task(resources=Resources(cores=1, memory_mb=400))
def observe(
    points: PointCloud, visibility: Visibility, masks: MaskSet | PromptedMasks, *, params: ObserveParams
) -> Observation:
    """The points under each mask of one view, those at its border told apart (spec S4.3, Q_i).

    visibility, masks: those of one view.
    """
    inner = np.zeros(visibility.height * visibility.width, bool)
    whole = np.zeros_like(inner)
    mask: list[int] = []
    rows: list[Int32] = []
    standings: list[np.ndarray] = []
    for interior in interiors(masks, params.erosion, nested=params.nested):
        whole[interior.whole] = inner[interior.pixels] = True
        row = np.flatnonzero(whole[visibility.pixel]).astype(np.int32)
        inside = inner[visibility.pixel[row]]
        whole[interior.whole] = inner[interior.pixels] = False
        standing = np.where(inside, INSIDE, BORDER).astype(np.uint8)
        if params.clusters.eps:  # else all are kept, and each mask's points need not be looked up
            under = visibility.point_index[row[inside]]
            kept = params.clusters.kept(points.points[under], points.spacing[under])
            standing[inside] = np.where(kept, INSIDE, STRAY)
        mask.append(interior.mask)
        rows.append(row)
        standings.append(standing)
    return Observation(
        name=visibility.name,
        point_index=visibility.point_index,
        mask=np.array(mask, np.int32),
        first=np.cumsum([0, *map(len, rows)]).astype(np.int32),
        row=np.concatenate([np.zeros(0, np.int32), *rows]),
        standing=np.concatenate([np.zeros(0, np.uint8), *standings]),
    )
