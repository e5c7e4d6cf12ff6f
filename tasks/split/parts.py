"""Parts of objects, which masks inside a larger mask of the same object show. Beyond Split&Splat."""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ss_flow.running import progress
from ss_flow.task import task
from ss_flow.tasks.artifacts import STRAY, Bool, Int32, MaskSet, Observation, PointLabels, PointParts
from ss_flow.tasks.ranges import Count, Fraction
from ss_flow.tasks.split.votes.at_once import correlation_clusters, evidence, membership
from ss_flow.tasks.split.votes.votes import Votes


@dataclass(frozen=True)
class PartsParams:
    """Which nested masks show a part of an object."""

    rate: Fraction = 0.4
    """Share of what the views say about two groups of nested masks of an object that must speak for their union."""
    tau_part: Fraction = 0.5
    """Share of the views that see a point under masks of its object which must show the part there."""
    min_views: Count = 2
    """Views that must show a part."""
    min_points: Count = 10
    """Points below which a part is dropped."""


@dataclass(frozen=True)
class _PartMask:
    """A nested mask of an object."""

    view: str
    label: int
    points: Int32
    """[M] the object's points under it, ascending."""


@task(name="split.parts")
def find_parts(
    observations: Sequence[Observation], masks: Sequence[MaskSet], labels: PointLabels, *, params: PartsParams
) -> PointParts:
    """The part of its object that each dense point belongs to.

    observations, masks: one of each per view. labels: of these points and masks. A mask whose label is also that of
    the mask around it shows a part. Such masks are united over the views as `split.propagate` unites those of objects
    (correlation clustering), for each label on its own; then each view votes for the part under whose mask it sees a
    point, or for none where it sees the point under another mask of its label. The order of the views does not matter.
    """
    found: list[_PartMask] = []
    seen_by = np.zeros(len(labels.label), np.int32)
    for k, (seen, pool) in enumerate(zip(observations, masks, strict=True)):
        progress(k, len(masks), seen.name)
        shown = np.zeros(len(pool), np.int32)
        matched = labels.match_view == k
        shown[labels.match_mask[matched]] = labels.match_label[matched]
        owner = _owners(seen, shown, labels.label[seen.point_index])
        seen_by[seen.point_index[owner >= 0]] += 1
        for j in np.flatnonzero(_is_nested(shown, pool.parent)):
            points = seen.point_index[owner == j]
            if len(points):
                found.append(_PartMask(seen.name, int(shown[j]), points))
    # An order that does not depend on the order of the views.
    found.sort(key=lambda mask: (mask.label, -len(mask.points), mask.points.tobytes(), mask.view))
    votes = Votes(len(labels.label))
    whole = [0]
    for label, group in itertools.groupby(found, key=lambda mask: mask.label):
        for of_part in _clusters(list(group), len(labels.label), params.rate):
            if len({mask.view for mask in of_part}) >= params.min_views:
                for mask in of_part:
                    votes.add(mask.points, len(whole), np.ones(len(mask.points)))
                whole.append(label)
    leader, share = votes.leaders()
    enough = np.rint(share * votes.weight()) >= params.tau_part * seen_by
    part = np.where(enough, leader, 0)
    return PointParts(_by_size(part, whole, params.min_points)[part])


def _owners(seen: Observation, shown: Int32, label: Int32) -> Int32:
    """[M] the smallest mask of its own label over each point that a view sees, -1 where there is none.

    shown: [N] what each mask of the view shows. label: [M] of the view's points.
    """
    owner = np.full(len(label), -1, np.int32)
    for j, mask in enumerate(seen.mask.tolist()):  # smaller ones come later
        row, standing = seen.under(j)
        row = row[standing != STRAY]
        owner[row[label[row] == shown[mask]]] = mask
    return owner


def _is_nested(shown: Int32, parent: Int32) -> Bool:
    """[N] which masks lie inside one that shows the same object; masks in between that show nothing do not count."""
    holder = parent.copy()
    while (unmatched := (holder >= 0) & (shown[holder] == 0)).any():
        holder[unmatched] = parent[holder[unmatched]]
    return (shown > 0) & (holder >= 0) & (shown[holder] == shown)


def _clusters(masks: list[_PartMask], num_points: int, rate: float) -> list[list[_PartMask]]:
    """Masks of one label that show the same part, in the order of their first masks."""
    members = membership([mask.points for mask in masks], num_points)
    _, view = np.unique([mask.view for mask in masks], return_inverse=True)
    once = np.ones(len(masks), np.int32)
    together, said = evidence(members, view.astype(np.int32), once)
    cluster = correlation_clusters(together, said, once, rate)
    return [[masks[i] for i in np.flatnonzero(cluster == c)] for c in range(int(cluster.max()) + 1)]


def _by_size(part: Int32, whole: list[int], min_points: int) -> Int32:
    """The number of each part within its label, from the largest on: [P], 0 for small ones.

    part: [N] the part of each point. whole: [P] the label of each part; 0 is no part.
    """
    size = np.bincount(part, minlength=len(whole))
    number = np.zeros(len(whole), np.int32)
    given: Counter[int] = Counter()
    for i in np.argsort(-size[1:], kind="stable") + 1:
        if size[i] >= min_points:
            given[whole[i]] += 1
            number[i] = given[whole[i]]
    return number
