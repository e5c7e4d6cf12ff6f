"""What stands there without a label of its own: a jar on a sill is small, lies between the prompts of most photos, and
the few views with a mask of it are outvoted.

Its points have no label, or that of the chest on which it stands, yet they rise from all that is round them. So the
segmenter is asked for it in every view that sees it, and where most of them show it, it has a label. Beyond
Split&Splat.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from ss_flow.task import Resources, task
from ss_flow.tasks.artifacts import (
    Cameras,
    Float32,
    Float64,
    Int64,
    MaskSet,
    PointCloud,
    PointLabels,
    PromptedMasks,
    Visibility,
)
from ss_flow.tasks.geometry.clustering import dbscan, rows_by_label
from ss_flow.tasks.geometry.shape import largest_plane, middle_of, plane_of_most, thinned, towards
from ss_flow.tasks.masks.painting import agreement, by_area, paint_labels
from ss_flow.tasks.masks.pool import with_more
from ss_flow.tasks.models.catalogue import Model
from ss_flow.tasks.models.onnx import network_identity
from ss_flow.tasks.models.sam import EmbeddedPhoto
from ss_flow.tasks.packed import Masks
from ss_flow.tasks.ranges import Count, NonNegative
from ss_flow.tasks.split.propagate import MOST_LABELS
from ss_flow.tasks.split.reprompt import RepromptParams, prompt, spread_prompts

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

_REACH = 2.0
"""Distance at which points hang together, in their spacings."""
_AROUND, _FEW = 5.0, 12
"""Up to which distance from a thing points are round it, in spacings; and below how many it stands on nothing."""
_ROUNDS = 4
"""How often a plane is fitted."""
_THICKNESS = 1.5
"""Up to which distance points lie on a plane, in spacings."""
_FLAT = 0.35
"""Share of the points of a label that must lie on its largest side: else nothing stands on that."""
_PART = 0.25
"""Share of the points of a label up to which something stands on it."""
_VIEWS = 3
"""Views that must see most of a thing: from fewer, nobody can say that masks of it are missing."""
_MOST = 30
"""Things that are asked for, the largest: a lawn has hundreds of tufts."""
_SMALL = 0.0005, 0.01
"""Shares of a photo between which a thing is asked for: a larger one does not lie between the prompts, and of a smaller
one the segmenter sees too little."""
_AGREES = 0.5
"""IoU with a thing's points from which an answer of the segmenter shows it; and the share of the answers that must."""


@dataclass(frozen=True)
class OverlookedParams:
    """What is looked for."""

    rise: NonNegative = 2.5
    """How far at least half of a thing must rise from the plane of what is round it, in multiples of the cloud's
    spacing: the dots of a wallpaper lie in it. Half as far where it stands on the largest side of a label. 0 = nothing
    is looked for."""
    min_points: Count = 15
    """Points of the smallest thing."""


@task(name="split.overlooked")
def overlooked(
    points: PointCloud,
    cameras: Cameras,
    visibility: Sequence[Visibility],
    labels: PointLabels,
    *,
    params: OverlookedParams,
) -> PointLabels:
    """The things that have no label of their own: here theirs are 1.., from the largest on, all other points have none.

    visibility: one of each view. labels: of `points`.
    """
    from scipy.spatial import cKDTree

    seen = np.zeros(len(points.points), np.int32)
    for view in visibility:
        seen[view.point_index] += 1
    tree = cKDTree(points.points)
    rows_of, eye = rows_by_label(labels.label), middle_of(cameras)
    free = _pieces(points, rows_of.pop(0, np.zeros(0, np.int64)), params.min_points)
    standing = [own for rows in rows_of.values() for own in _standing(points, rows, eye, params.min_points)]
    things = [
        own
        for least, pieces in ((params.rise, free), (params.rise / 2, standing))
        for own in pieces
        if np.median(seen[own]) >= _VIEWS and _rise(points, tree, own) >= least
    ]
    things = sorted(things, key=len, reverse=True)[: min(_MOST, MOST_LABELS - labels.num_labels)]
    label = np.zeros(len(points.points), np.int32)
    for number, own in enumerate(things, 1):
        label[own] = number
    nothing = np.zeros(0, np.int32)
    return PointLabels(label, (label > 0).astype(np.float32), len(things), nothing, nothing, nothing)


def _pieces(points: PointCloud, rows: Int64, least: int) -> list[Int64]:
    """What hangs together of some points (rows), at least so many each."""
    piece = dbscan(points.points[rows], _REACH * points.spacing[rows], min_samples=1)
    return [rows[own] for own in rows_by_label(piece).values() if len(own) >= least]


def _standing(points: PointCloud, rows: Int64, eye: Float64, least: int) -> list[Int64]:
    """What hangs together, at least so many points each, of those of a label (rows) that are before its largest side as
    seen from `eye`; nothing where it has no large one."""
    most = _PART * len(rows)
    if most < least:
        return []
    places, thickness = points.points[rows].astype(np.float64), _THICKNESS * points.spacing_of(rows)
    centre, normal = largest_plane(thinned(places), thickness, _ROUNDS)
    height = (places - centre) @ towards(normal, centre, eye)
    if (np.abs(height) <= thickness).mean() < _FLAT:
        return []
    return [own for own in _pieces(points, rows[height > thickness], least) if len(own) <= most]


def _rise(points: PointCloud, tree: cKDTree, own: Int64) -> float:
    """How far half of some points (rows) are from the plane that most points round them lie on, in spacings."""
    near = tree.query_ball_point(points.points[own], _AROUND * points.spacing[own])
    around = np.setdiff1d(np.concatenate(near).astype(np.int64), own)
    if len(around) < _FEW:
        return np.inf
    spacing = points.spacing_of(own)
    centre, normal = plane_of_most(points.points[around].astype(np.float64), spacing, _ROUNDS)
    return float(np.median(np.abs((points.points[own] - centre) @ normal)) / spacing)


@task(name="split.asked", resources=Resources(cores=1, memory_mb=1500, gpus=0.1), environment=network_identity)
def asked(
    photo: EmbeddedPhoto,
    visibility: Visibility,
    things: PointLabels,
    *,
    params: RepromptParams,
    pred_iou: float,
    model: Model,
) -> PromptedMasks:
    """What the segmenter answers in a view when asked for the things that are small there; where the answer is not the
    thing, the mask is empty.

    visibility: that of the photo. things: from `overlooked`. params: from how many points on a thing counts as seen,
    and how prompts are spread over it. pred_iou: least quality of an answer that the segmenter itself predicts.
    Raises InputError when the model cannot be opened.
    """
    height, width = visibility.height, visibility.width
    painted = by_area(paint_labels(visibility, things.label), height, width)
    share = np.bincount(painted.label, painted.area) / (height * width)
    small = (share >= _SMALL[0]) & (share <= _SMALL[1])
    painted = replace(painted, label=np.where(small[painted.label], painted.label, 0))
    found = prompt(photo, spread_prompts(painted, width, set(), params), model, params.speckle)
    shown = [
        mask & (sure >= pred_iou and agreement(painted, mask, label) >= _AGREES)
        for mask, label, sure in zip(found.dense(), found.label.tolist(), found.predicted_iou.tolist(), strict=True)
    ]
    return replace(found, **vars(Masks.of(shown)))


@task(name="split.confirmed")
def confirmed(things: PointLabels, answers: Sequence[PromptedMasks]) -> PointLabels:
    """Those of the things that at least half of the views that were asked for them show, and two.

    things: from `overlooked`. answers: one of each view, from `asked`.
    """
    asked_for, shown = np.zeros((2, things.num_labels + 1), np.int32)
    for of_view in answers:
        asked_for[of_view.label] += 1
        shown[of_view.label] += of_view.areas() > 0
    kept = shown >= np.maximum(2, _AGREES * asked_for)
    return replace(things, label=np.where(kept[things.label], things.label, 0))


@task(name="split.claimed")
def claimed(
    visibility: Sequence[Visibility],
    labels: PointLabels,
    things: PointLabels,
    answers: Sequence[PromptedMasks],
    *,
    tau_label: float,
    min_points: int,
) -> PointLabels:
    """The labels, and one more for each thing.

    visibility, answers: one of each view, the latter from `asked`. things: from `confirmed`. A thing has its points,
    and those that a share of `tau_label` of the views that show it hold under its mask, whatever label they had; a
    label that so is left with fewer than `min_points` goes.
    """
    label, confidence, num_labels = labels.label.copy(), labels.confidence.copy(), labels.num_labels
    for thing in np.unique(things.label[things.label > 0]).tolist():
        share = _share(thing, len(label), visibility, answers)
        own = (things.label == thing) | (share >= tau_label)
        num_labels += 1
        label[own], confidence[own] = num_labels, share[own]
    left = np.bincount(label, minlength=num_labels + 1)
    label[(left < min_points)[label]] = 0
    return replace(labels, label=label, confidence=confidence, num_labels=num_labels)


def _share(thing: int, num_points: int, visibility: Sequence[Visibility], answers: Sequence[PromptedMasks]) -> Float32:
    """[N] the share of the views that show a thing which hold a point under its mask, of those that see the point; 0
    where only one does."""
    seen, held = np.zeros((2, num_points), np.int32)
    for view, of_view in zip(visibility, answers, strict=True):
        for row in np.flatnonzero(of_view.label == thing).tolist():
            if (mask := of_view.mask(row)).any():
                seen[view.point_index] += 1
                held[view.point_index] += mask.ravel()[view.pixel]
    return np.where(seen >= 2, held / np.maximum(seen, 1), 0).astype(np.float32)


@task(name="split.with_answers")
def with_answers(
    masks: MaskSet, answers: PromptedMasks, things: PointLabels, *, grid: int, max_iou: float, contained: float
) -> MaskSet:
    """The masks of a view, and what it was shown of the things.

    answers: the view's, from `asked`. things: from `confirmed`. grid, max_iou, contained: as `with_more` takes them.
    """
    rows = np.flatnonzero(np.isin(answers.label, things.label) & (answers.areas() > 0))
    if not len(rows):
        return masks
    certain = np.ones(len(rows), np.float32)
    sure = answers.predicted_iou[rows]
    return with_more(masks, answers.dense()[rows], sure, certain, grid=grid, max_iou=max_iou, contained=contained)
