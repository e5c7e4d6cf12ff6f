"""What stands or lies on something else: it bulges out of its surroundings. Beyond Split&Splat."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ss_flow.tasks.artifacts import Bool, Cameras, Float64, Int32, PointCloud, PointLabels, Tally
from ss_flow.tasks.split.touching import TouchingParams, borders

_FOOT = 0.3
"""Share of a label's points, those nearest to what surrounds it, that are its foot."""
_BESIDE = 0.05
"""Share of its border along which a label must meet another one to stand on it."""
_FEW = 20
"""Points below which a label has no shape."""
_SMALL = 0.5
"""What stands on something is smaller than this share of it, in points: the body of a mug does not stand on its rim."""
_MOST = 2000
"""So many points of a label tell."""


@dataclass(frozen=True)
class Mounds:
    """Which labels bulge out of what surrounds them; L labels, those that occur, ascending."""

    share: Float64
    """[L, L] share of the border of each with others, over all views, along which it meets each."""
    size: Int32
    """[L] points."""
    bulges: Bool
    """[L]."""
    around: float
    """Least share of its border along which something surrounds what stands on it."""

    def standing(self, members: list[int]) -> Bool:
        """Which of these labels (rows) stand on the others: [members]."""
        share, size = self.share[np.ix_(members, members)], self.size[members]
        surrounded = (share.sum(axis=1) >= self.around) & (size < _SMALL * (size.sum() - size))
        return self.bulges[members] & surrounded


def find_mounds(
    points: PointCloud, cameras: Cameras, labels: PointLabels, tallies: Sequence[Tally], *, around: float, height: float
) -> Mounds:
    """Which labels bulge out of what surrounds them, as a bag on a sofa does and a label printed on a box does not.

    around: see `Mounds`. A label bulges when a tenth of its points lie in front of the plane of its foot (the points
    nearest to its neighbours) by at least the share `height` of its extent, and it does not go on smoothly into its
    neighbours along half of its border, as a part of something round does.
    """
    from scipy.spatial import cKDTree

    names, size = np.unique(labels.label[labels.label > 0], return_counts=True)
    meets = np.zeros((len(names), len(names)))
    for tally in tallies:
        column = np.searchsorted(names, tally.label)
        meets[np.ix_(column, column)] += tally.beside
    share = meets / np.maximum(meets.sum(axis=1, keepdims=True), 1)
    eye = np.mean([-pose[:3, :3].T @ pose[:3, 3] for pose in cameras.world_to_camera], axis=0)
    bulges = np.zeros(len(names), bool)
    if not len(names):
        return Mounds(share, size.astype(np.int32), bulges, around)
    at_border, _, touches = borders(labels.label, points, TouchingParams())
    smooth = np.zeros(len(at_border), bool)
    smooth[touches[0][touches[1] > 0]] = True
    for row, name in enumerate(names):
        beside = names[share[row] > _BESIDE]
        own, rest = points.points[labels.label == name], points.points[np.isin(labels.label, beside)]
        own = own[:: max(1, len(own) // _MOST)].astype(np.float64)
        contact = smooth[labels.label[at_border] == name]
        if len(own) < _FEW or not len(rest) or (contact.size and contact.mean() >= 0.5):
            continue
        distance, _ = cKDTree(rest).query(own)
        foot = own[distance <= np.quantile(distance, _FOOT)]
        centre = foot.mean(axis=0)
        normal = np.linalg.svd(foot - centre, full_matrices=False)[2][2]
        towards = normal if (eye - centre) @ normal > 0 else -normal
        rises = np.quantile((own - centre) @ towards, 0.9)
        low, high = np.quantile(own, (0.02, 0.98), axis=0)
        bulges[row] = rises >= max(height * float(np.linalg.norm(high - low)), 2 * points.spacing)
    return Mounds(share, size.astype(np.int32), bulges, around)
