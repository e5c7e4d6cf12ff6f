"""Masks from a few clicked points: the hint-based baseline that Split&Splat compares its own masks with.

The paper lets a video segmenter follow the clicked objects from frame to frame. Here the scene's points carry them:
the points under the masks of the clicked views are labelled, and where another view sees a label, the segmenter is
prompted at points spread over it. No order of views enters.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ss_flow.running import progress
from ss_flow.task import Resources, task
from ss_flow.tasks.artifacts import Bool, Clicks, MaskSet, PointCloud, PointLabels, PromptedMasks, Visibility
from ss_flow.tasks.masks.erosion import ErosionParams
from ss_flow.tasks.masks.painting import PaintedView, paint_labels
from ss_flow.tasks.masks.pool import mask_set
from ss_flow.tasks.models.catalogue import Model
from ss_flow.tasks.models.onnx import network_identity
from ss_flow.tasks.models.sam import EmbeddedPhoto
from ss_flow.tasks.packed import Masks
from ss_flow.tasks.split.observe import ObserveParams, observe
from ss_flow.tasks.split.reprompt import Prompt, RepromptParams, prompt, spread_prompts
from ss_flow.tasks.split.votes.votes import Votes

_MOST = 0.5
"""Share of the labelled pixels that counts as most of them."""


@task(resources=Resources(cores=1, memory_mb=1500, gpus=0.1), environment=network_identity)
def clicked(
    photo: EmbeddedPhoto, clicks: Clicks, *, speckle: float, model: Model, apart: bool = False
) -> PromptedMasks:
    """One mask for each object that was clicked in a view, none in a view without clicks.

    clicks: those of the photo. speckle: as in `RepromptParams`. apart: whether no object is part of another: then
    points on one are outside of the others, and what two masks hold is in neither.
    Raises InputError when the model cannot be opened.
    """
    prompts = {}
    for label in np.unique(clicks.label).tolist():
        own = clicks.label == label
        used = own | ((clicks.inside == 1) & apart)
        prompts[label] = Prompt(clicks.points[used], np.where(own, clicks.inside, 0)[used].astype(np.int32))
    found = prompt(photo, prompts, model, speckle)
    if not apart:
        return found
    masks = found.dense()
    return replace(found, **vars(Masks.of(masks & (masks.sum(axis=0) < 2))))


@task()
def label(
    points: PointCloud,
    visibility: tuple[Visibility, ...],
    masks: tuple[PromptedMasks, ...],
    *,
    erosion: ErosionParams,
    tau_label: float,
) -> PointLabels:
    """The dense points that the clicked masks hold, labelled by object.

    visibility, masks: one of each per view. The points that a view sees under an eroded mask vote for its object;
    where masks overlap, for the smaller one's. A point gets the label that has a share of `tau_label` of its votes. No
    vote weighs more than another, since views have no order here.
    """
    votes = Votes(len(points.points))
    for k, (view, of_view) in enumerate(zip(visibility, masks, strict=True)):
        progress(k, len(masks), view.name)
        seen = observe(points, view, of_view, params=ObserveParams(erosion=erosion))
        for j, mask in enumerate(seen.mask):
            rows = seen.inside(j)
            votes.add(rows, int(of_view.label[mask]), np.ones(len(rows)))
    leader, share = votes.leaders()
    nothing = np.zeros(0, np.int32)
    return PointLabels(
        label=np.where(share >= tau_label, leader, 0).astype(np.int32),
        confidence=share.astype(np.float32),
        num_labels=max((int(of_view.label.max(initial=0)) for of_view in masks), default=0),
        match_view=nothing,
        match_mask=nothing,
        match_label=nothing,
    )


@task(resources=Resources(cores=1, memory_mb=1500, gpus=0.1), environment=network_identity)
def spread(
    photo: EmbeddedPhoto,
    visibility: Visibility,
    clicked: PromptedMasks,
    labels: PointLabels,
    *,
    params: RepromptParams,
    contained: float,
    model: Model,
) -> MaskSet:
    """The masks of one view: those of the objects clicked in it, and one for each other object that it sees.

    visibility, clicked: those of the photo. labels: from `label`. params: from how many points on an object
    counts as seen, and how prompts are spread over them. An answer of the segmenter is left out that misses most of the
    label's pixels, or holds other labels mostly. contained: as `mask_tree` takes it.
    Raises InputError when the model cannot be opened.
    """
    painted = paint_labels(visibility, labels.label)
    prompts = spread_prompts(painted, photo.frame.width, set(clicked.label.tolist()), params)
    found = prompt(photo, prompts, model, params.speckle)
    masks = found.dense()
    fits = [_fits(painted, mask, label_id) for mask, label_id in zip(masks, found.label.tolist(), strict=True)]
    kept = np.array(fits, bool)
    return mask_set(
        photo.frame.name,
        np.concatenate([clicked.dense(), masks[kept]]),
        np.concatenate([clicked.predicted_iou, found.predicted_iou[kept]]),
        model.name,
        contained=contained,
    )


def _fits(painted: PaintedView, mask: Bool, label_id: int) -> bool:
    """Whether a mask [H, W] holds most pixels of a label, and this label is most of what it holds."""
    held = painted.label[mask.ravel()[painted.pixel]]
    own = int((held == label_id).sum())
    return own >= _MOST * int((painted.label == label_id).sum()) and own >= _MOST * int((held > 0).sum())
