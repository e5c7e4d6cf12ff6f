"""The cut through the hierarchy: which of its levels are the instances. Beyond Split&Splat."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ss_flow.running import warn
from ss_flow.task import task
from ss_flow.tasks.artifacts import Hierarchy, Int32, PointCloud, PointLabels, PointParts

_WEAKEST = 2 / 3
"""Share of the granularity that each union below an instance must exceed: views that see all of an instance make up for
those that doubt some of its unions, but not for those that deny them."""
_MOST = 0.5
"""Share of the labelled surface above which a single instance is warned of."""


@task(name="split.cut")
def cut(points: PointCloud, labels: PointLabels, tree: Hierarchy, *, granularity: float) -> PointLabels:
    """The labels of points and masks at one level of the hierarchy.

    labels: of the points, the leaves of the tree. granularity: pieces on which the views agree more than this are one
    instance (0..1); the highest such node counts, as long as no union in it has less than two thirds of that. So 1
    leaves the labels as they are, and lower values give things, then groups of things. Ids are those of the nodes.
    Warns of an instance that gets more than half of the labelled surface, unless it is stuff.
    """
    instance = instances_of(tree, labels.num_labels, granularity)
    highest = max(labels.num_labels, int(tree.node.max(initial=0)))
    _warn_of_largest(points, instance[labels.label], tree)
    return replace(labels, label=instance[labels.label], match_label=instance[labels.match_label], num_labels=highest)


@task(name="split.cut_parts")
def cut_parts(labels: PointLabels, parts: PointParts, instances: PointLabels) -> PointParts:
    """The parts of the instances: the labels that each is made of, and the parts of those.

    labels: the leaves; parts: theirs; instances: the same points after the cut, and as boards and corrections divided
    them. Numbered from the largest part on in each instance. An instance that is a single label keeps its parts as they
    are; one that is a piece of a single label has of its parts those that it holds.
    """
    three = instances.label, labels.label, parts.part
    sides = [int(one.max(initial=0)) + 1 for one in three]
    # As one number each: rows of three are sorted ten times as slowly.
    code, row, size = np.unique(np.ravel_multi_index(three, sides), return_inverse=True, return_counts=True)
    found = np.stack(np.unravel_index(code, sides), axis=1)
    alone = np.isin(found[:, 0], np.unique(labels.label))
    number = np.where(alone, found[:, 2], 0)
    for instance in np.unique(found[~alone, 0]):
        rows = np.flatnonzero(found[:, 0] == instance)
        if (found[rows, 1] == found[rows[0], 1]).all():  # what is no part of the label is none of its piece
            rows = rows[found[rows, 2] > 0]
        number[rows[np.argsort(-size[rows], kind="stable")]] = np.arange(1, len(rows) + 1)
    return PointParts(number[row].astype(np.int32))


def _warn_of_largest(points: PointCloud, label: Int32, tree: Hierarchy) -> None:
    """label: [N] the instance of each point, 0 = none."""
    # What is near has more points than as much surface farther away.
    size = np.bincount(label, np.where(label > 0, points.spacing.astype(np.float64) ** 2, 0))
    largest = int(size.argmax())
    if size[largest] > _MOST * size.sum() and largest not in tree.node[tree.stuff]:
        warn(
            f"Instance {largest} holds {size[largest] / size.sum():.0%} of the labelled surface. Unless it is one "
            "thing that fills the scene, its masks show several things as one: raise split.granularity "
            "(--set split.granularity=0.7), or give masks (--masks) or clicked points (--hints)."
        )


def instances_of(tree: Hierarchy, num_labels: int, granularity: float) -> Int32:
    """[num_labels + 1] the instance that each label belongs to; labels that no point carries stay as they are."""
    row = tree.row_of()
    sound = tree.agreement > _WEAKEST * granularity
    for child, parent in enumerate(tree.parent):  # children come first
        if parent and not sound[child]:
            sound[row[int(parent)]] = False
    instance = np.arange(num_labels + 1, dtype=np.int32)
    for leaf in np.flatnonzero(~np.isin(tree.node, tree.parent)):
        above = int(leaf)
        while parent := int(tree.parent[above]):
            above = row[parent]
            if sound[above] and tree.agreement[above] > granularity:
                instance[tree.node[leaf]] = parent
    return instance
