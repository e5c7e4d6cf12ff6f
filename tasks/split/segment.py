"""2D instance masks of one view: Segment Anything prompted on grids of points, from coarse to fine (Split&Splat,
Sec. 3.1; spec S1)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from ss_flow.errors import InputError
from ss_flow.running import progress
from ss_flow.task import Resources, task
from ss_flow.tasks.artifacts import Bool, Float32, Float64, Frame, Int32, MaskSet
from ss_flow.tasks.geometry.images import decode_valid, pack_masks
from ss_flow.tasks.models.catalogue import Model
from ss_flow.tasks.models.sam import Embedding, Sam
from ss_flow.tasks.ranges import Count, Fraction, Natural, NonNegative
from ss_flow.tasks.split.mask_pool import (
    canonical_order,
    drop_duplicates,
    mask_tree,
    merge_union,
    suppress,
)


@dataclass(frozen=True)
class SegmentParams:
    """How masks are prompted, filtered and merged; tuples have one value for each grid."""

    grids: tuple[Count, ...] = (1, 4, 8, 16)
    """Prompt points a side of each grid, coarse to fine (row 2)."""
    adaptive: bool = True
    """Whether a finer grid leaves out the points that a small accepted mask already covers."""
    settled_area: Fraction = 0.1
    """Largest share of the image of a mask that keeps finer prompts away; under larger ones parts may hide."""
    pred_iou: Fraction = 0.8
    """Least quality that the segmenter itself predicts (row 3)."""
    stability: tuple[Fraction, ...] | None = None
    """Least IoU of a mask cut above and below its threshold (row 4); None takes the model's own figure."""
    stability_offset: tuple[NonNegative, ...] = (0.85, 0.85, 0.85, 1.0)
    """Distance of those two cuts from the threshold, in logits (row 4)."""
    mask_threshold: tuple[float, ...] = (0.5, 0.5, 0.3, 0.3)
    """Logit above which a pixel belongs to a mask (row 5)."""
    box_nms: tuple[Fraction, ...] = (0.3, 0.3, 0.5, 0.3)
    """IoU of bounding boxes above which the worse of two masks of one grid is dropped (row 6)."""
    min_area: Fraction = 0.0025
    """Smallest mask, as a share of the image (row 7); dense scenes want 0.0005."""
    min_pixels: Natural = 64
    """Smallest mask, in pixels (row 7)."""
    merge: Literal["child", "union"] = "child"
    """What becomes of masks of several grids that overlap: a mask tree, or one mask (rows 8 and 9)."""
    duplicate_iou: Fraction = 0.9
    """With "child": IoU above which the worse of two masks is dropped."""
    contained: Fraction = 0.9
    """With "child": share of a mask that its parent holds."""
    duplicate_overlap: Fraction = 0.95
    """With "union": share of the smaller of two masks of one grid above which the later is dropped (row 8)."""
    union_overlap: Fraction = 0.3
    """With "union": share of the smaller mask above which a finer one is united with a coarser one (row 9)."""

    def __post_init__(self) -> None:
        for name in ("stability", "stability_offset", "mask_threshold", "box_nms"):
            values = getattr(self, name)
            if values is not None and len(values) < len(self.grids):
                raise InputError(
                    f"segment.{name} has {len(values)} values but segment.grids has {len(self.grids)}; "
                    "it should have one for each grid."
                )


@dataclass(frozen=True)
class _Candidates:
    """Masks at the network's own resolution, cropped to the image."""

    logits: Float32
    """[N, 256, 256]."""
    masks: Bool
    """[N, h, w]."""
    predicted_iou: Float32
    stability: Float32
    grid: Int32

    def __getitem__(self, rows: Int32) -> _Candidates:
        return _Candidates(
            self.logits[rows], self.masks[rows], self.predicted_iou[rows], self.stability[rows], self.grid[rows]
        )

    def __add__(self, other: _Candidates) -> _Candidates:
        return _Candidates(
            np.concatenate([self.logits, other.logits]),
            np.concatenate([self.masks, other.masks]),
            np.concatenate([self.predicted_iou, other.predicted_iou]),
            np.concatenate([self.stability, other.stability]),
            np.concatenate([self.grid, other.grid]),
        )


@task(
    name="split.segment",
    resources=Resources(cores=1, memory_mb=1500),
    uses=("onnxruntime", "onnx", "opencv-contrib-python-headless"),
)
def segment(frame: Frame, embedding: Embedding, *, params: SegmentParams, model: Model) -> MaskSet:
    """The masks that Segment Anything finds in one view (Split&Splat, M_k; spec S1).

    embedding: the frame's, by the same model. Pixels that the frame marks as not valid belong to no mask. The masks
    come in canonical order: area descending.
    Raises InputError when the model's files are missing, damaged or other networks.
    """
    sam = Sam(model)
    valid = decode_valid(frame)
    valid_low = _low_resolution(valid)

    found: _Candidates | None = None
    for level, side in enumerate(params.grids):
        points = grid_points(side, frame.width, frame.height)
        points = points[valid[points[:, 1].astype(int), points[:, 0].astype(int)]]
        if params.adaptive and found is not None:
            points = points[~_settled(points, found, params, frame)]
        logits, scores = sam.predict(embedding, points)
        accepted = _accept(logits, scores, level, valid_low, params, model)
        found = accepted if found is None else found + accepted
        progress(level + 1, len(params.grids), f"{side} x {side} points")
    assert found is not None

    if params.merge == "child":
        found = found[drop_duplicates(found.masks, found.predicted_iou, params.duplicate_iou)]
    thresholds = np.array(params.mask_threshold, np.float32)[found.grid]
    masks = sam.upsample(embedding, found.logits) > thresholds[:, None, None]
    masks &= valid
    if params.merge == "union":
        large = np.flatnonzero(_large_enough(masks, params)).astype(np.int32)
        masks, origin = merge_union(masks[large], found.grid[large], params.duplicate_overlap, params.union_overlap)
        found = found[large[origin]]
    rows = np.flatnonzero(_large_enough(masks, params)).astype(np.int32)
    rows = rows[canonical_order(masks[rows])]
    masks, found = masks[rows], found[rows]
    return MaskSet(
        frame.name,
        frame.height,
        frame.width,
        pack_masks(masks),
        found.predicted_iou,
        found.stability,
        found.grid,
        mask_tree(masks, params.contained),
        model.name,
    )


def grid_points(side: int, width: int, height: int) -> Float64:
    """The centres of side x side equal cells of an image: [side^2, 2] x, y in pixels, row by row."""
    centres = (np.arange(side) + 0.5) / side
    x, y = np.meshgrid(centres * width, centres * height)
    return np.stack([x.ravel(), y.ravel()], axis=1)


def _accept(
    logits: Float32, scores: Float32, level: int, valid: Bool, params: SegmentParams, model: Model
) -> _Candidates:
    """The masks of one grid that pass the filters: logits [M, 4, 256, 256], scores [M, 4], valid [h, w]."""
    h, w = valid.shape
    # The first of the four answers a prompt of several points; for a single point it is the worst.
    flat, quality = logits[:, 1:].reshape(-1, *logits.shape[2:]), scores[:, 1:].ravel()
    good = quality >= params.pred_iou
    flat, quality = flat[good], quality[good]
    cropped = flat[:, :h, :w]
    threshold, offset = params.mask_threshold[level], params.stability_offset[level]
    inner = (cropped > threshold + offset).sum(axis=(1, 2), dtype=np.int64)
    outer = (cropped > threshold - offset).sum(axis=(1, 2), dtype=np.int64)
    stability = (inner / np.maximum(outer, 1)).astype(np.float32)
    masks = (cropped > threshold) & valid
    least = model.parameter("stability") if params.stability is None else params.stability[level]
    passed = np.flatnonzero((stability >= least) & (masks.sum(axis=(1, 2)) >= max(1, params.min_area * h * w)))
    level_of = np.full(len(flat), level, np.int32)
    found = _Candidates(flat, masks, quality, stability, level_of)[passed.astype(np.int32)]
    return found[suppress(_box_iou(found.masks), found.predicted_iou, params.box_nms[level])]


def _settled(points: Float64, found: _Candidates, params: SegmentParams, frame: Frame) -> Bool:
    """Which points [M, 2] an accepted mask already covers that is too small to hide parts: [M]."""
    _, h, w = found.masks.shape
    small = found.masks.sum(axis=(1, 2)) <= params.settled_area * h * w
    covered = found.masks[small].any(axis=0)
    columns = (points[:, 0] * w / frame.width).astype(int)
    rows = (points[:, 1] * h / frame.height).astype(int)
    return covered[rows, columns]


def _box_iou(masks: Bool) -> Float32:
    """IoU of the bounding boxes of masks [N, h, w], none empty: [N, N]."""
    rows: Bool = np.logical_or.reduce(masks, axis=2)
    columns: Bool = np.logical_or.reduce(masks, axis=1)
    low = np.stack([columns.argmax(axis=1), rows.argmax(axis=1)], axis=1)
    high = np.stack(
        [columns.shape[1] - columns[:, ::-1].argmax(axis=1), rows.shape[1] - rows[:, ::-1].argmax(axis=1)], axis=1
    )
    extent = np.minimum(high[:, None], high[None]) - np.maximum(low[:, None], low[None])
    shared = np.clip(extent, 0, None).prod(axis=2)
    areas = (high - low).prod(axis=1)
    return (shared / (areas[:, None] + areas[None] - shared)).astype(np.float32)


def _low_resolution(valid: Bool) -> Bool:
    """Which pixels of the network's masks show valid image: the top left part of [256, 256] that the image fills."""
    from ss_flow.tasks.models.sam import LOW

    height, width = valid.shape
    step = max(height, width) / LOW
    rows = ((np.arange(max(1, round(height / step))) + 0.5) * step).astype(int).clip(max=height - 1)
    columns = ((np.arange(max(1, round(width / step))) + 0.5) * step).astype(int).clip(max=width - 1)
    return valid[np.ix_(rows, columns)]


def _large_enough(masks: Bool, params: SegmentParams) -> Bool:
    area = masks.sum(axis=(1, 2))
    return area >= max(params.min_pixels, params.min_area * masks.shape[1] * masks.shape[2])
