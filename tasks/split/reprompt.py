"""Asking the segmenter where a label is that it had not found by itself (spec row 20, A36)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ss_flow.task import Resources, task
from ss_flow.tasks.artifacts import Bool, Frame, MaskSet, PointLabels, PromptedMasks, Visibility
from ss_flow.tasks.geometry.images import decode_valid, pack_masks
from ss_flow.tasks.geometry.sampling import greedy_farthest
from ss_flow.tasks.models.catalogue import Model
from ss_flow.tasks.models.sam import Embedding, Sam
from ss_flow.tasks.ranges import Count, NonNegative
from ss_flow.tasks.split.selection import SelectionParams, paint_labels, select_masks


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


@task(
    resources=Resources(cores=1, memory_mb=1500),
    uses=("onnxruntime", "onnx", "opencv-contrib-python-headless", "scipy"),
)
def reprompt(
    frame: Frame,
    embedding: Embedding,
    visibility: Visibility,
    masks: MaskSet,
    labels: PointLabels,
    *,
    params: RepromptParams,
    selection: SelectionParams,
    model: Model,
) -> PromptedMasks:
    """Masks for the labels that are visible in a view but that none of its masks shows (spec S5).

    embedding, visibility, masks: those of the frame. selection: how the view's own masks are matched to labels, as in
    the re-projection. Each missing label gets one mask, prompted at points spread over it. Whether the mask agrees with
    the label is for `split.reproject` to judge. Raises InputError when the model cannot be opened.
    """
    painted = paint_labels(visibility, labels.label)
    shown = select_masks(painted, masks, selection)
    names, counts = np.unique(painted.label, return_counts=True)
    missing = [
        int(label)
        for label, count in zip(names, counts, strict=True)
        if label > 0 and count >= params.min_points and int(label) not in shown
    ]
    found: list[Bool] = []
    if missing:
        sam = Sam(model)
        valid = decode_valid(frame)
        for label in missing:
            v, u = np.divmod(painted.pixel[painted.label == label], visibility.width)
            places = np.stack([u, v], axis=-1) + 0.5
            chosen = greedy_farthest(places, params.prompts, alpha=params.alpha, drop_hull=params.drop_hull)
            mask, _ = sam.predict_prompt(embedding, places[chosen])
            found.append(mask & valid)
    dense = np.array(found, bool).reshape(len(found), frame.height, frame.width)
    return PromptedMasks(
        name=frame.name,
        height=frame.height,
        width=frame.width,
        label=np.array(missing, np.int32),
        packed=pack_masks(dense) if found else np.zeros((0, (frame.height * frame.width + 7) // 8), np.uint8),
    )
