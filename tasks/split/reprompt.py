"""Asking the segmenter where a label is that it had not found by itself (spec row 20, A36)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ss_flow.task import Resources, task
from ss_flow.tasks.artifacts import Float64, Int32, MaskSet, PointLabels, PromptedMasks, Visibility
from ss_flow.tasks.geometry.images import decode_valid
from ss_flow.tasks.geometry.sampling import greedy_farthest
from ss_flow.tasks.masks.painting import PaintedView, labels_in_front
from ss_flow.tasks.masks.pool import without_speckles
from ss_flow.tasks.masks.selection import SelectionParams, paint_for_selection, select_masks
from ss_flow.tasks.models.catalogue import Model
from ss_flow.tasks.models.onnx import network_identity
from ss_flow.tasks.models.sam import EmbeddedPhoto, Sam
from ss_flow.tasks.packed import Masks
from ss_flow.tasks.ranges import Count, Fraction, NonNegative


@dataclass(frozen=True)
class RepromptParams:
    """Which labels are asked for, and how."""

    min_points: Count = 10
    """Points of a label that must be in front in a view."""
    prompts: Count = 10
    """Points that ask for the mask together, far from each other."""
    alpha: NonNegative = 0.3
    """How much prompts keep to the middle of the label."""
    drop_hull: bool = True
    """Whether the outermost points are no prompts."""
    speckle: Fraction = 0.05
    """Pieces of an answer smaller than this share of its largest one are taken off, and holes as small are filled."""


@task(resources=Resources(cores=1, memory_mb=1500, gpus=0.1), environment=network_identity)
def reprompt(
    photo: EmbeddedPhoto,
    visibility: Visibility,
    masks: MaskSet,
    labels: PointLabels,
    *,
    params: RepromptParams,
    selection: SelectionParams,
    model: Model,
) -> PromptedMasks:
    """Masks for the labels that are visible in a view but that none of its masks shows (spec S5).

    visibility, masks: those of the photo. selection: how the view's own masks are matched to labels, as in the
    re-projection. Each such label gets one mask, prompted at points spread over it. Whether the mask agrees with the
    label is for `split.instances_in_view` to judge. Raises InputError when the model cannot be opened.
    """
    painted = paint_for_selection(visibility, labels.label, selection)
    shown = select_masks(painted, masks, selection)
    return prompt(photo, spread_prompts(painted, photo.frame.width, set(shown), params), model, params.speckle)


@dataclass(frozen=True)
class Prompt:
    """Points that ask for one mask together."""

    points: Float64
    """[n, 2] x, y in pixels of the frame."""
    inside: Int32
    """[n] 1 = inside the mask, 0 = outside."""


def spread_prompts(painted: PaintedView, width: int, shown: set[int], params: RepromptParams) -> dict[int, Prompt]:
    """For each label in front in a view of this width, but those in `shown`: points spread over it."""
    prompts = {}
    for label in labels_in_front(painted, params.min_points):
        if label not in shown:
            v, u = np.divmod(painted.pixel[painted.label == label], width)
            places = np.stack([u, v], axis=-1) + 0.5
            chosen = greedy_farthest(places, params.prompts, alpha=params.alpha, drop_hull=params.drop_hull)
            prompts[label] = Prompt(places[chosen], np.ones(len(chosen), np.int32))
    return prompts


def prompt(photo: EmbeddedPhoto, prompts: dict[int, Prompt], model: Model, speckle: float) -> PromptedMasks:
    """The masks of one frame that prompts ask for, by label in ascending order; without any the model is not opened.

    speckle: as in `RepromptParams`.
    """
    frame = photo.frame
    masks = np.zeros((len(prompts), frame.height, frame.width), bool)
    predicted = np.zeros(len(prompts), np.float32)
    if prompts:
        image = Sam(model).image(photo.embedding, few=True)
        valid = decode_valid(frame)
        for row, label in enumerate(sorted(prompts)):
            asked = prompts[label]
            mask, predicted[row] = image.predict_prompt(asked.points, asked.inside)
            masks[row] = without_speckles(mask, speckle) & valid
    return PromptedMasks(
        name=frame.name,
        height=frame.height,
        width=frame.width,
        label=np.array(sorted(prompts), np.int32),
        **vars(Masks.of(masks)),
        predicted_iou=predicted,
    )
