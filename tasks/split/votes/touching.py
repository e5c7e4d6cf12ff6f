"""Which labels are pieces of one surface, by touch and colour (spec S4, global merge).

For what all views cut into the same pieces, so that no mask holds them together: a sofa, a table. Two labels are pieces
of one surface when they meet along much of the border of one of them, go on into each other without an edge or a step,
and have the same colours.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, NamedTuple

import numpy as np

from ss_flow.tasks.artifacts import Bool, Float32, Float64, Int32, PointCloud
from ss_flow.tasks.geometry.clustering import nearest_within
from ss_flow.tasks.geometry.shape import normals_of
from ss_flow.tasks.ranges import Fraction, Positive, Range
from ss_flow.tasks.split.votes.color_histograms import bins_of, histogram, likeness

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

_BESIDE = 9
"""Nearest points, itself among them, that tell whether a point lies at the border of its label."""
_ACROSS = 2
"""How many of them carry another label, or none, there; fewer may be strays."""
_NEAR = 40
"""Nearest points, itself among them, that a point may touch, and that make up its normal."""
_FEW = 4
"""Points of its label, itself among them, below which a point has no normal."""
_AT_ONCE = 1 << 16
"""Points whose normals are found at once."""


@dataclass(frozen=True)
class TouchingParams:
    """When two labels are pieces of one surface."""

    contact: Fraction = 0.2
    """Share of the border of one of them along which it touches the other without an edge."""
    similarity: Fraction = 0.95
    """Cosine of their colour histograms."""
    angle: Annotated[float, Range(0.0, 90.0)] = 25.0
    """Degrees between normals, and by which a surface may rise towards the other, above which there is an edge."""
    reach: Positive = 4.0
    """Distance at which points touch, and within which a normal is found, in spacings of the points."""
    color_spread: Positive = 10.0
    """Standard deviation of the smoothing of the histograms, in CIELAB units."""


def merge_touching(labels: Int32, cloud: PointCloud, params: TouchingParams) -> Int32:
    """Unite the labels of points that are pieces of one surface (spec S4, global merge).

    labels: [N], 0 = none. Round by round, pairs are united in the order of the share of a border along which they touch
    (ties: those whose points come first), each label once a round, until there is none left. A union takes its lowest
    label; else the numbers of the labels do not matter.
    """
    if not labels.any():
        return labels
    # Numbered by their first points, after 0.
    originals, first, inverse = np.unique(np.append(np.int32(0), labels), return_index=True, return_inverse=True)
    order = np.argsort(first)
    originals = originals[order]
    label = np.argsort(order).astype(np.int32)[inverse[1:]]
    rows, beside, _, touches = borders(label, cloud, params)
    bins = bins_of(cloud.colors)
    colors: dict[int, Float32] = {}
    united = np.arange(len(originals), dtype=np.int32)
    while True:
        own = united[label[rows]]
        at_border = (united[label[beside]] != own[:, None]).sum(axis=1) >= _ACROSS
        taken: set[int] = set()
        for a, b in _meeting(own, at_border, touches[0], united[touches[1]], params.contact):
            if taken & {a, b}:
                continue
            for label_id in {a, b} - colors.keys():
                colors[label_id] = histogram(bins[label == label_id], params.color_spread)
            if likeness(colors[a], colors[b]) >= params.similarity:
                taken |= {a, b}
                united[united == b] = a
                colors[a] += colors.pop(b)
        if not taken:
            lowest = np.full(len(originals), np.iinfo(np.int32).max, np.int32)
            np.minimum.at(lowest, united, originals)
            return lowest[united][label]


class Borders(NamedTuple):
    """Where labels end, and where they go on into another."""

    rows: Int32
    """[R] the labelled points that have some of another label, or of none, beside them."""
    beside: Int32
    """[R, _BESIDE] the points beside each."""
    touches: Int32
    """[2, T] which of the R touches which other label."""
    smooth: Int32
    """[2, S] which does so without an edge."""


def borders(label: Int32, cloud: PointCloud, params: TouchingParams) -> Borders:
    """The borders of labels [N] of a cloud's points, 0 = none."""
    from scipy.spatial import cKDTree

    tree = cKDTree(cloud.points)
    reach = params.reach * cloud.spacing
    rows = np.flatnonzero(label).astype(np.int32)
    beside = _nearest(tree, rows, _BESIDE, reach)
    kept = (label[beside] != label[rows, None]).sum(axis=1) >= _ACROSS
    rows, beside = rows[kept], beside[kept]
    near = _nearest(tree, rows, _NEAR, reach)
    number = np.full(len(label), -1, np.int32)
    number[rows] = np.arange(len(rows))
    normal = np.zeros((len(rows), 3), np.float32)
    for start in range(0, len(rows), _AT_ONCE):
        part = slice(start, start + _AT_ONCE)
        normal[part] = _normals(cloud.points, rows[part], near[part], label)
    i, column = np.nonzero((number[near] >= 0) & (label[near] != label[rows, None]))
    j = number[near[i, column]]
    ahead = cloud.points[rows[j]] - cloud.points[rows[i]]
    ahead /= np.maximum(np.linalg.norm(ahead, axis=1, keepdims=True), np.finfo(np.float32).tiny)
    even = np.abs(np.einsum("tc,tc->t", normal[i], normal[j])) >= np.cos(np.radians(params.angle))
    for end in (i, j):
        even &= np.abs(np.einsum("tc,tc->t", normal[end], ahead)) <= np.sin(np.radians(params.angle))
    base = int(label.max(initial=0)) + 1
    touches = i * base + label[rows[j]]
    some, smooth = (np.stack(np.divmod(np.unique(of), base)).astype(np.int32) for of in (touches, touches[even]))
    return Borders(rows, beside, some, smooth)


def counts_between(names: Int32, own: Int32, touches: Int32) -> Float64:
    """[L, L] how many points at the border of each label, called `names`, ascending, touch each other one.

    own: [R] the label of each point. touches: [2, T] which of the points touches which label, as in `Borders`.
    """
    counts = np.zeros((len(names), len(names)))
    np.add.at(counts, (np.searchsorted(names, own[touches[0]]), np.searchsorted(names, touches[1])), 1)
    return counts


def _nearest(tree: cKDTree, rows: Int32, count: int, reach: Float32) -> Int32:
    """The points nearest to some points of the tree: [R, count]; the point itself where there are fewer in reach
    of it [N]."""
    near = nearest_within(tree, tree.data[rows], count, reach[rows])
    return np.where(near < tree.n, near, rows[:, None]).astype(np.int32)


def _normals(points: Float32, rows: Int32, near: Int32, label: Int32) -> Float32:
    """The normals of points from those near them that carry the same label: [R, 3]; zeros where these are too few.

    An edge between two labels stays sharp, as neither takes part in the other's normals.
    """
    part = (label[near] == label[rows, None]) & (near != rows[:, None])
    part[:, 0] = True
    normal = normals_of(points[near] - points[rows, None], part)
    return np.where(part.sum(axis=1)[:, None] >= _FEW, normal, 0).astype(np.float32)


def _meeting(own: Int32, at_border: Bool, point: Int32, touched: Int32, contact: float) -> list[tuple[int, int]]:
    """The pairs of labels that touch along enough of the border of one of them, the largest share first.

    own: [R] label of each point. at_border: [R] which lie at its border. point, touched: [T] which touches which label.
    """
    base = int(max(own.max(initial=0), touched.max(initial=0))) + 1
    kept = at_border[point] & (own[point] != touched)
    once = np.unique(point[kept].astype(np.int64) * base + touched[kept])
    pairs, count = np.unique(own[once // base].astype(np.int64) * base + once % base, return_counts=True)
    a, b = np.divmod(pairs, base)
    share = count / np.bincount(own[at_border], minlength=base)[a]
    low, high = np.minimum(a, b), np.maximum(a, b)
    order = np.lexsort((high, low, -share))
    order = order[share[order] >= contact]
    return list(zip(low[order].tolist(), high[order].tolist(), strict=True))
