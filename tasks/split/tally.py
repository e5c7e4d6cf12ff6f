"""What the masks of one view, whole and nested, hold of each label."""

from __future__ import annotations

import numpy as np

from ss_flow.task import task
from ss_flow.tasks.artifacts import MaskSet, PointLabels, Tally, Visibility


@task(name="split.tally")
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
        quality=np.minimum(masks.predicted_iou, 1) * masks.stability,
    )
