"""View-consistent instance masks from labelled points (Split&Splat, Sec. 3.1.3, last part)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from ss_flow.running import warn
from ss_flow.task import Resources, task
from ss_flow.tasks.artifacts import (
    DRAWN,
    FOUND,
    PROMPTED,
    Bool,
    Hierarchy,
    InstanceMasks,
    InstancesInView,
    MaskSet,
    PointCloud,
    PointLabels,
    PointParts,
    PromptedMasks,
    Visibility,
)
from ss_flow.tasks.geometry.clustering import nearest_spacing
from ss_flow.tasks.geometry.images import at_diagonal
from ss_flow.tasks.masks.painting import (
    PaintedView,
    agreement,
    agreements,
    labels_in_front,
    nearest_painted,
    stack_exclusive,
)
from ss_flow.tasks.masks.pool import smoothed
from ss_flow.tasks.masks.selection import SelectionParams, paint_for_selection, select_masks
from ss_flow.tasks.packed import Masks
from ss_flow.tasks.ranges import Count, Fraction, NonNegative
from ss_flow.tasks.split.confidence import confidence, evidence, pieces
from ss_flow.tasks.unread import by_default

_DENSE = 2.5
"""Pixels, of an image with a diagonal of 800, between a label's points up to which `reach` is meant as it stands."""


@dataclass(frozen=True)
class ReprojectParams:
    """How labelled points become masks again."""

    selection: SelectionParams = field(default_factory=SelectionParams)
    """Which masks of a view show a label."""
    draw_missing: bool = True
    """Whether a label that a view sees, but that no mask shows, gets its points there, grown together, as its mask."""
    min_agreement: Fraction = 0.7
    """IoU of a label's mask with its points in the view below which these are drawn, and of the mask only that stays
    which no point of another label is near; 0 = never (only with `draw_missing`)."""
    min_points: Count = 10
    """Points of a label that must be in front in a view for this."""
    reach: NonNegative = 4.0
    """How far a drawn mask reaches round its points, in pixels of an image with a diagonal of 800; farther, in
    proportion, where the points lie more than 2.5 such pixels apart."""
    min_views: Count = 2
    """Views with a mask below which an instance is weak: kept as points, not reconstructed."""

    def in_view(self) -> ReprojectParams:
        """For the steps of single views: what these do not read is as by default, so that it does not enter the key."""
        return by_default(self, "min_views")


@task(name="split.instances_in_view", resources=Resources(cores=1, memory_mb=700))
def instances_in_view(
    view: Visibility,
    pool: MaskSet,
    labels: PointLabels,
    prompted: Sequence[PromptedMasks] = (),
    *,
    params: ReprojectParams,
) -> InstancesInView:
    """One mask at most of each label in a view (M~_{k,l}; spec S5); they do not overlap: smaller ones are on top.

    pool: the view's masks. prompted: masks of the view from `split.reprompt`, if it was asked; they stand in where the
    view's own masks do not show a label, or show it less well; where there is none either, the label's points do
    (`draw_missing`).
    """
    painted = paint_for_selection(view, labels.label, params.selection)
    shown, origin = _masks_of_view(painted, view, pool, prompted, params)
    ids = stack_exclusive(shown, view.height, view.width)
    label = np.unique(ids)
    return InstancesInView(
        **vars(Masks.of(ids == i for i in label)),
        name=view.name,
        height=view.height,
        width=view.width,
        label=label,
        origin=np.array([origin.get(int(i), FOUND) for i in label], np.uint8),
    )


@task(resources=Resources(cores=1, memory_mb=1500))
def reproject(
    points: PointCloud,
    labels: PointLabels,
    parts: PointParts,
    tree: Hierarchy,
    views: Sequence[InstancesInView],
    *,
    min_views: int,
) -> tuple[InstanceMasks, ...]:
    """The instances that the labelled points make, with their masks in all views.

    The first instance is the background (id 0): unlabelled points, and what no mask covers; the others follow by id.
    tree: what is part of what, for the confidence of each. min_views: as in `ReprojectParams`. Warns where there is
    none but the background, and where every other one is weak.
    """
    of_more = pieces(tree)
    shown_in: dict[int, list[tuple[InstancesInView, int]]] = {}
    for view in views:
        for row, label in enumerate(view.label.tolist()):
            shown_in.setdefault(label, []).append((view, row))
    found = []
    for label in np.union1d([0], labels.label).tolist():
        rows, shown = labels.label == label, shown_in.get(label, [])
        masks = Masks.joined([view.rows([row]) for view, row in shown])
        origin = np.array([view.origin[row] for view, row in shown], np.uint8)
        found.append(
            InstanceMasks(
                instance_id=label,
                points=points.points[rows],
                colors=points.colors[rows],
                point_confidence=labels.confidence[rows],
                point_part=parts.part[rows],
                confidence=confidence(evidence(masks, origin, piece=label in of_more)) if shown else 0.0,
                views=tuple(view.name for view, _ in shown),
                **vars(masks),
                origin=origin,
                weak=label > 0 and len(shown) < min_views,
            )
        )
    if len(found) == 1:
        warn(
            "No instance was found: no mask gave any point its label, so the whole scene is background. Look whether "
            "the views' masks show the things: if so, give photos that overlap more; if not, use another segmenter."
        )
    elif all(instance.weak for instance in found[1:]):
        warn(
            f"No instance has masks in as many views as split.reproject.min_views ({min_views}), so none is "
            "reconstructed: give more photos, or lower it."
        )
    return tuple(found)


def _masks_of_view(
    painted: PaintedView, view: Visibility, pool: MaskSet, prompted: Sequence[PromptedMasks], params: ReprojectParams
) -> tuple[dict[int, Bool], dict[int, int]]:
    """A mask of each label that a view shows, not yet exclusive, and where it comes from."""
    shown = select_masks(painted, pool, params.selection)
    origin = dict.fromkeys(shown, FOUND)
    for asked in prompted:
        for label, mask in zip(asked.label.tolist(), asked.dense(), strict=True):
            agrees = agreement(painted, mask, label)
            own = agreement(painted, shown[label], label) if label in shown else 0.0
            if agrees >= params.selection.min_iou and agrees > own:
                shown[label], origin[label] = mask, PROMPTED
    if params.draw_missing:
        for label, mask in _drawn(painted, view, shown, params).items():
            shown[label], origin[label] = mask, DRAWN
    return shown, origin


def _drawn(painted: PaintedView, view: Visibility, shown: dict[int, Bool], params: ReprojectParams) -> dict[int, Bool]:
    """Masks of the labels in front in a view that have none, or none that their points agree with: the pixels nearest
    to their points, and what a mask holds besides where no point of another label is near; smoothed.

    A label whose points lie so scattered that hardly any of them is left inside has none.
    """
    ids = stack_exclusive(shown, view.height, view.width)
    labels = np.array(sorted(shown), np.int32)
    good = set(labels[agreements(painted, ids, labels) >= params.min_agreement].tolist())
    missing = [label for label in labels_in_front(painted, params.min_points) if label not in good]
    if not missing:
        return {}
    nearest, distance = nearest_painted(painted, view.height, view.width)
    masks = {}
    for label in missing:
        reach = _reach_of(label, painted, view, params)
        mask = (nearest == label) & (distance <= reach)
        if label in shown:
            mask |= shown[label] & ((nearest == 0) | (distance > reach))
        masks[label] = smoothed(mask, round(reach))
    return {label: mask for label, mask in masks.items() if agreement(painted, mask, label) >= params.selection.min_iou}


def _reach_of(label: int, painted: PaintedView, view: Visibility, params: ReprojectParams) -> float:
    """How far the drawn mask of a label reaches round its points in a view, in its pixels: farther where these lie far
    apart, as in a close view of a capture whose points are as dense as its far views need."""
    v, u = np.divmod(painted.pixel[painted.label == label], view.width)
    apart = nearest_spacing(np.stack([u, v], axis=-1).astype(np.float32))
    least = at_diagonal(params.reach, view.height, view.width)
    return least * max(1.0, apart / at_diagonal(_DENSE, view.height, view.width))
