"""Which views each instance appears in, so that a step for one instance depends on no other view."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from ss_flow.task import task
from ss_flow.tasks.artifacts import Appearances, Int32, LabelMap, PointLabels, Visibility


@task(name="split.appearances")
def appearances(labels: PointLabels, visibility: Sequence[Visibility]) -> Appearances:
    """The views that see any point of each instance; of the background (id 0), all.

    labels: of the dense points; as in `reproject`, each label is an instance. visibility: one a view.
    """
    ids = np.union1d([0], labels.label).astype(np.int32)
    return _listed(ids, [np.append(labels.label[view.point_index], 0) for view in visibility])


@task(name="split.shown_in")
def shown_in(masks: Sequence[LabelMap]) -> Appearances:
    """The views that show each instance by a mask. masks: one a view."""
    found = [np.unique(label_map.ids).astype(np.int32) for label_map in masks]
    return _listed(np.unique(np.concatenate(found)), found)


def _listed(ids: Int32, found: Iterable[Int32]) -> Appearances:
    """found: the ids in each view, in any order."""
    present = np.array([np.isin(ids, of_view) for of_view in found], bool).T
    return Appearances(instance_id=ids, **Appearances.arrays([np.flatnonzero(row).tolist() for row in present]))
