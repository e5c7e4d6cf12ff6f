"""What stands or lies on something else: it bulges out of its surroundings. Beyond Split&Splat."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ss_flow.running import in_threads
from ss_flow.tasks.artifacts import Bool, Cameras, Float64, Int32, PointCloud, PointLabels, Tally
from ss_flow.tasks.geometry.clustering import rows_by_label
from ss_flow.tasks.geometry.shape import extent_of, middle_of, plane_through, thinned, towards
from ss_flow.tasks.split.votes.color_histograms import bins_of, histogram, likeness
from ss_flow.tasks.split.votes.touching import Borders, TouchingParams

_FOOT = 0.3
"""Share of a label's points, those nearest to what surrounds it, that are its foot."""
_BESIDE = 0.05
"""Share of its border along which a label must meet another one to stand on it."""
_FEW = 20
"""Points below which a label has no shape."""
_SMALL = 0.5
"""What stands on something is smaller than this share of it, in points: the body of a mug does not stand on its rim."""
_CLEAR = 2.0
"""Standard deviations of the depth by which a label must rise at least: by the 1.3 above which a tenth of the points of
something flat lie, so does a print on a wall."""
_LEAST = 2 / 3
"""Share of the height that is asked for at least, however much the colours differ: what is printed on a far wall rises
from it by half as much, in the noise of the depth."""


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
    points: PointCloud,
    cameras: Cameras,
    labels: PointLabels,
    tallies: Sequence[Tally],
    ends: Borders,
    *,
    around: float,
    height: float,
) -> Mounds:
    """Which labels bulge out of what surrounds them, as a bag on a sofa does and a label printed on a box does not.

    ends: the borders of the labels. around: see `Mounds`. A label bulges when a tenth of its points lie in front of the
    plane of its foot (the points nearest to its neighbours) far enough, and it does not go on smoothly into its
    neighbours along half of its border, as a part of something round does. Far enough is the share `height` of its
    extent where its colours are half like those of its neighbours; twice as far where they are the same, since the arm
    of a sofa rises from its seat too, and down to two thirds as far where they differ. In no case less than two
    spacings of its points, or what the noise of the depth makes of something flat.
    """
    from scipy.spatial import cKDTree

    names, size = np.unique(labels.label[labels.label > 0], return_counts=True)
    meets = np.zeros((len(names), len(names)))
    for tally in tallies:
        column = np.searchsorted(names, tally.label)
        meets[np.ix_(column, column)] += tally.beside
    share = meets / np.maximum(meets.sum(axis=1, keepdims=True), 1)
    bulges = np.zeros(len(names), bool)
    if not len(names):
        return Mounds(share, size.astype(np.int32), bulges, around)
    apart = _ends(labels.label, names, ends)
    rows_of, eye, bins = rows_by_label(labels.label), middle_of(cameras), bins_of(points.colors)
    spread = TouchingParams().color_spread

    def rises(row: int) -> bool:
        inside = rows_of[int(names[row])]
        own = thinned(points.points[inside])
        rest = np.sort(np.concatenate([rows_of[name] for name in names[share[row] > _BESIDE].tolist()]))
        distance, _ = cKDTree(points.points[rest]).query(own)
        centre, normal = plane_through(own[distance <= np.quantile(distance, _FOOT)])
        rise = np.quantile((own - centre) @ towards(normal, centre, eye), 0.9)
        alike = likeness(histogram(bins[inside], spread), histogram(bins[rest], spread))
        enough = height * max(2 * alike, _LEAST) * extent_of(own)
        noise = points.noise * float(np.linalg.norm(centre - eye))
        return bool(rise >= max(enough, 2 * points.spacing_of(inside), _CLEAR * noise))

    asked = np.flatnonzero((size >= _FEW) & apart & (share > _BESIDE).any(axis=1)).tolist()
    bulges[asked] = list(in_threads(rises, asked))
    return Mounds(share, size.astype(np.int32), bulges, around)


def _ends(label: Int32, names: Int32, ends: Borders) -> Bool:
    """[L] which labels do not go on smoothly into others along half of their border."""
    smooth = np.zeros(len(ends.rows), bool)
    smooth[ends.smooth[0][ends.smooth[1] > 0]] = True
    of = np.searchsorted(names, label[ends.rows])
    length = np.bincount(of, minlength=len(names))
    return 2 * np.bincount(of, smooth, len(names)) < np.maximum(length, 1)
