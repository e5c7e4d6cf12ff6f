"""What the masks of one view, whole and nested, hold of each label."""

from __future__ import annotations

import numpy as np

from ss_flow.task import Resources, task
from ss_flow.tasks.artifacts import Int32, MaskSet, PointLabels, Tally, Visibility
from ss_flow.tasks.geometry.images import at_diagonal
from ss_flow.tasks.masks.painting import nearest_labels, paint_labels

_REACH = 5.0
"""How far a label's area reaches round its points, in pixels of an image with a diagonal of 800."""


@task(name="split.tally", resources=Resources(cores=1, memory_mb=400))
def tally(visibility: Visibility, masks: MaskSet, labels: PointLabels) -> Tally:
    """How many of each label's points lie under each mask of a view.

    visibility, masks: those of one view. A point counts under every mask that holds it, unlike in `split.observe`: this
    is what tells wholes from parts.
    """
    label = labels.label[visibility.point_index]
    pixel, label = visibility.pixel[label > 0], label[label > 0]
    names, column = np.unique(label, return_inverse=True)
    under = masks.dense().reshape(len(masks), masks.height * masks.width)[:, pixel]
    held = np.array([np.bincount(column[mask], minlength=len(names)) for mask in under], np.int32)
    return Tally(
        name=visibility.name,
        label=names.astype(np.int32),
        seen=np.bincount(column, minlength=len(names)).astype(np.int32),
        held=held.reshape(len(masks), len(names)),
        beside=_borders(visibility, labels, names),
        quality=masks.quality,
    )


def _borders(visibility: Visibility, labels: PointLabels, names: Int32) -> Int32:
    """[V, V] how long the border is between the areas of labels in a view."""
    height, width = visibility.height, visibility.width
    painted = paint_labels(visibility, labels.label)
    area = nearest_labels(painted, height, width, at_diagonal(_REACH, height, width))
    column = np.searchsorted(names, area)
    beside = np.zeros((len(names), len(names)), np.int32)
    for a, b in ((np.s_[:, 1:], np.s_[:, :-1]), (np.s_[1:], np.s_[:-1])):
        meets = (area[a] != area[b]) & (area[a] > 0) & (area[b] > 0)
        np.add.at(beside, (column[a][meets], column[b][meets]), 1)
    return beside + beside.T
