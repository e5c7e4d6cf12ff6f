"""Points in a row, views of them, and the labels that masks give them."""

from dataclasses import replace

import numpy as np
from box_scene import mask_set, row_of_points
from clouds import even_cloud

from ss_flow.tasks.artifacts import Observation
from ss_flow.tasks.split.observe import ClusterParams, ObserveParams, observe
from ss_flow.tasks.split.propagate import PropagateParams, propagate
from ss_flow.tasks.split.votes.in_turn import SequentialParams

BARE = PropagateParams(
    views="in_turn",
    in_turn=SequentialParams(min_overlap=1, min_overlap_share=0, min_new_points=1),
    smoothing=0,
    touching_merge=False,
    label_clusters=ClusterParams(),
    min_label_points=1,
)


def in_turn(**values):
    return replace(BARE, in_turn=replace(BARE.in_turn, **values))


def run(points, visible, masks, params, observing=ObserveParams()):
    """The labels that masks give, from the points under each mask on."""
    seen = tuple(observe(points, view, pool, params=observing) for view, pool in zip(visible, masks, strict=True))
    return propagate(points, visible, seen, params=params)


def points(count):
    places = np.stack([np.arange(count), np.zeros(count), np.ones(count)], axis=-1).astype(np.float32)
    return even_cloud(places, np.zeros((count, 3), np.uint8), 1.0, 1.0)


def views_of(*views):
    """Views of one row of points; each view is a list of masks, each mask a list of points."""
    seen, sets = [], []
    for masks in views:
        seen.append(row_of_points(sorted({p for mask in masks for p in mask}))[0])
        sets.append(mask_set(np.stack([row_of_points(mask)[1] for mask in masks])))
    return tuple(seen), tuple(sets)


def lying(*masks) -> Observation:
    """A view of points 0, 1, ..., all of them under each of its masks, and how they lie there."""
    every = np.arange(len(masks[0]), dtype=np.int32)
    first = (len(every) * np.arange(len(masks) + 1)).astype(np.int32)
    standing = np.concatenate(masks).astype(np.uint8)
    return Observation("0", every, np.arange(len(masks), dtype=np.int32), first, np.tile(every, len(masks)), standing)
