"""A scene that was trained elsewhere, labelled: each view votes on the Gaussians that it shows. Beyond Split&Splat."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ss_flow.running import warn
from ss_flow.task import Resources, task
from ss_flow.tasks.artifacts import (
    Bool,
    Float32,
    Frame,
    Gaussians,
    InstanceMasks,
    Int32,
    LabelMap,
    PointCloud,
    PointLabels,
    PointParts,
)
from ss_flow.tasks.gaussians.initialise import select
from ss_flow.tasks.gaussians.rasterize import backend_identity
from ss_flow.tasks.gaussians.render import shares
from ss_flow.tasks.geometry.cameras import Camera
from ss_flow.tasks.geometry.images import decode_valid
from ss_flow.tasks.ranges import Count, NonNegative

_LEAST = 1 / 255
"""Weight, summed over the pixels of an instance, below which a view has nothing to say about a Gaussian."""


@dataclass(frozen=True)
class LabelParams:
    """How the Gaussians of a given scene get their labels."""

    rounds: Count = 2
    """How often the views vote: by the masks of Split first, then by what the labelled scene shows."""
    neighbours: Count = 5
    """A Gaussian that no view shows takes the label that most of so many neighbours carry, the nearest that have
    votes."""
    reach: NonNegative = 0.1
    """How far such a neighbour may be, in scene units; a Gaussian without one is background."""


@dataclass(frozen=True)
class ViewVotes:
    """What one view says about the Gaussians that it shows."""

    name: str
    gaussian: Int32
    """[A] rows of the scene, ascending for each label."""
    label: Int32
    """[A] the instance in whose pixels each has a part, 0 = background; ascending."""
    weight: Float32
    """[A] how large that part is: the sum of its weights T * alpha over these pixels."""


@task(name="splat.vote", resources=Resources(cores=1, memory_mb=1000), environment=backend_identity)
def vote(scene: Gaussians, frame: Frame, camera: Camera, shown: LabelMap) -> ViewVotes:
    """What a view's masks say about a scene: each pixel has one vote for its instance, and every Gaussian in it gets as
    much of this vote as it makes up of the pixel.

    So a Gaussian that never weighs most, as those that lie over one another in 3DGS, has votes too. Pixels that the
    frame does not count have none. camera, shown: of this view; shown: its exclusive ids.
    """
    ids = np.where(decode_valid(frame), shown.ids.astype(np.int32), -1)
    found = shares(scene, camera, ids)
    enough = found.weight >= _LEAST
    return ViewVotes(frame.name, found.row[enough], found.id[enough], found.weight[enough])


@task(name="splat.label")
def label(
    scene: Gaussians,
    votes: Sequence[ViewVotes],
    points: PointCloud,
    labels: PointLabels,
    parts: PointParts,
    *,
    params: LabelParams,
) -> Gaussians:
    """The scene with the instance that has most of the votes of all views; nothing else of a Gaussian changes.

    `instance_conf` is that instance's share of the votes; equal shares go to the lower id. A Gaussian without votes,
    which no view shows, takes the label of its neighbours (`LabelParams`), and a confidence of 0 marks it.
    A Gaussian's part is that of the nearest dense point of its instance.

    votes: of every view. points, labels, parts: the dense points of Split.
    """
    instance, share = _elected(votes, len(scene))
    silent = share == 0
    instance[silent] = _of_neighbours(scene.means, instance, silent, params.reach * points.unit, params.neighbours)
    if not instance.any():
        warn("No Gaussian of the scene belongs to an instance, so all of it is background.")
    part = _parts(scene.means, instance, points, labels, parts)
    return replace(scene, instance_id=instance, instance_conf=share, part_id=part)


@task(name="splat.own_gaussians")
def own_gaussians(scene: Gaussians, instance: InstanceMasks) -> Gaussians:
    """Those of one instance of a labelled scene."""
    return select(scene, scene.instance_id == instance.instance_id)


def _elected(votes: Sequence[ViewVotes], count: int) -> tuple[Int32, Float32]:
    """Each Gaussian's instance and its share of the votes; 0 and 0 without votes."""
    rows, labels = (
        np.concatenate([getattr(view, name) for view in votes]).astype(np.int64) for name in ("gaussian", "label")
    )
    pairs, inverse = np.unique(rows << 16 | labels, return_inverse=True)
    weight = np.bincount(inverse, np.concatenate([view.weight for view in votes]), len(pairs))
    row, candidate = pairs >> 16, (pairs & 0xFFFF).astype(np.int32)
    order = np.lexsort((candidate, -weight, row))
    voted, first = np.unique(row[order], return_index=True)
    best = order[first]
    total = np.bincount(row, weight, count)
    instance, share = np.zeros(count, np.int32), np.zeros(count, np.float32)
    instance[voted] = candidate[best]
    share[voted] = weight[best] / total[voted]
    return instance, share


def _of_neighbours(means: Float32, instance: Int32, silent: Bool, reach: float, neighbours: int) -> Int32:
    """[M] labels for the silent Gaussians: of most of the nearest others within reach; of equals, the nearest one's."""
    from scipy.spatial import cKDTree

    if silent.all() or not silent.any():
        return instance[silent]
    count = min(neighbours, int((~silent).sum()))
    _, near = cKDTree(means[~silent]).query(means[silent], k=count, distance_upper_bound=reach)
    around = np.append(instance[~silent], np.int32(-1))[np.asarray(near).reshape(-1, count)]
    alike = (around[:, :, None] == around[:, None, :]).sum(axis=2)
    alike[around < 0] = 0
    chosen = np.take_along_axis(around, alike.argmax(axis=1)[:, None], axis=1)[:, 0]
    return np.maximum(chosen, 0)


def _parts(means: Float32, instance: Int32, points: PointCloud, labels: PointLabels, parts: PointParts) -> Int32:
    """[N] the part of the nearest dense point of each Gaussian's instance; 0 where it has none."""
    from scipy.spatial import cKDTree

    part = np.zeros(len(means), np.int32)
    for label in np.unique(labels.label[parts.part > 0]).tolist():
        own, known = instance == label, labels.label == label
        if label and own.any():
            _, nearest = cKDTree(points.points[known]).query(means[own])
            part[own] = parts.part[known][nearest]
    return part
