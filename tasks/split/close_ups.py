"""Close-ups: where a photo shows many small things, Segment Anything sees its parts by themselves, enlarged, and finds
more of them (Kirillov et al. 2023, App. B: crops)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np

from ss_flow.running import progress
from ss_flow.task import Resources, task
from ss_flow.tasks.artifacts import Bool, Frame, MaskSet
from ss_flow.tasks.geometry.images import decode_rgb, decode_valid, encode_png, encode_valid
from ss_flow.tasks.masks.pool import with_more
from ss_flow.tasks.models.catalogue import Model
from ss_flow.tasks.models.onnx import network_identity
from ss_flow.tasks.models.sam import LOW
from ss_flow.tasks.ranges import Fraction, Natural, Range
from ss_flow.tasks.split.embed import embed
from ss_flow.tasks.split.segment import SegmentParams, segment

Box = tuple[slice, slice]
"""Rows and columns of a photo."""

_SMALL = 0.01
"""Share of a photo below which a mask is small ..."""
_COARSE = 8
"""... and points a side of the grids whose masks are counted: finer ones find parts of everything."""


@dataclass(frozen=True)
class CloseUpParams:
    """Which photos are looked at closely, and how. What is not named here is as in whole photos."""

    side: Natural = 2
    """Close-ups along each side of a photo, hence four; 0 = none."""
    crowded: Natural = 25
    """Only photos are looked at closely that show so many things smaller than a hundredth of them."""
    share: Annotated[float, Range(0.1, 1.0)] = 0.6
    """Sides of a close-up, as a share of the photo's. What one cuts off, another may show whole."""
    grids: tuple[Annotated[int, Range(1, 1024)], ...] = (4, 8)
    """Prompt points a side of each grid in a close-up, coarse to fine."""
    min_area: Fraction = 0.0015
    """Smallest mask, as a share of the close-up; with sides of .6, .00054 of the photo."""


@task(
    name="split.close_ups",
    resources=Resources(cores=1, memory_mb=1500, gpus=0.1),
    environment=network_identity,
)
def close_ups(
    frame: Frame,
    whole: MaskSet,
    *,
    params: CloseUpParams,
    segmenting: SegmentParams,
    model: Model,
    turns: int = 0,
    noise: float = 0.0,
) -> MaskSet:
    """The masks of a view, and those that only its close-ups show, where it is crowded.

    whole: the masks found in the whole photo; of two with an IoU above `segmenting.mask_nms` these stay. A mask that
    the border of a close-up cuts off is none. Other limits are those of the photo's finest grid; the grid of what is
    added is the number of the photo's own. model, turns, noise: as of `embed`.
    Raises InputError when the model's files are missing, damaged or other networks.
    """
    if not _is_crowded(frame, whole, segmenting, params):
        return whole
    settings = _in_close_ups(segmenting, params)
    rgb, valid = decode_rgb(frame), decode_valid(frame)
    none = np.zeros(0, np.float32)
    masks, predicted_iou, stability = [np.zeros((0, frame.height, frame.width), bool)], [none], [none]
    boxes = list(_boxes(frame, params))
    for number, box in enumerate(boxes, 1):
        if not valid[box].any():
            continue
        height, width = valid[box].shape
        part = Frame(frame.name, width, height, encode_png(rgb[box]), encode_valid(valid[box]), width, height)
        found = segment(part, embed(part, model=model, turns=turns, noise=noise), params=settings, model=model)
        shown = found.dense()
        kept = np.flatnonzero(~_cut_off(shown, box, frame))
        placed = np.zeros((len(kept), frame.height, frame.width), bool)
        placed[:, *box] = shown[kept]
        masks.append(placed)
        predicted_iou.append(found.predicted_iou[kept])
        stability.append(found.stability[kept])
        progress(number, len(boxes), f"{len(kept)} masks")
    return with_more(
        whole,
        np.concatenate(masks),
        np.concatenate(predicted_iou),
        np.concatenate(stability),
        grid=len(segmenting.grids),
        max_iou=segmenting.mask_nms,
        contained=segmenting.contained,
    )


def _is_crowded(frame: Frame, whole: MaskSet, params: SegmentParams, close: CloseUpParams) -> bool:
    """Whether a photo shows many small things, of which it may hide more."""
    coarse = np.array(params.grids)[whole.grid] <= _COARSE
    small = whole.areas() < _SMALL * frame.width * frame.height
    return int(np.count_nonzero(coarse & small)) >= close.crowded


def _in_close_ups(params: SegmentParams, close: CloseUpParams) -> SegmentParams:
    """What holds in a close-up: what holds of the photo's finest grid."""
    last, count = len(params.grids) - 1, len(close.grids)
    return replace(
        params,
        grids=close.grids,
        stability=None if params.stability is None else (params.stability[last],) * count,
        stability_offset=(params.stability_offset[last],) * count,
        mask_threshold=(params.mask_threshold[last],) * count,
        box_nms=(params.box_nms[last],) * count,
        min_area=close.min_area,
    )


def _boxes(frame: Frame, params: CloseUpParams) -> Iterator[Box]:
    """The close-ups of a photo, row by row."""
    height, width = (max(1, round(side * params.share)) for side in (frame.height, frame.width))
    for top in np.linspace(0, frame.height - height, params.side).round().astype(int).tolist():
        for left in np.linspace(0, frame.width - width, params.side).round().astype(int).tolist():
            yield slice(top, top + height), slice(left, left + width)


def _cut_off(masks: Bool, box: Box, frame: Frame) -> Bool:
    """[N] which masks [N, h, w] of a close-up reach one of its borders that is none of the photo, as far as the network
    can tell."""
    rows, columns = box
    near = 1 + -(-max(masks.shape[1:]) // LOW)
    cut = np.zeros(len(masks), bool)
    for inside, border in (
        (rows.start > 0, masks[:, :near]),
        (rows.stop < frame.height, masks[:, -near:]),
        (columns.start > 0, masks[:, :, :near]),
        (columns.stop < frame.width, masks[:, :, -near:]),
    ):
        if inside:
            cut |= border.any(axis=(1, 2))
    return cut
