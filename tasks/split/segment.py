"""2D instance masks of one view: Segment Anything prompted on grids of points, from coarse to fine (Split&Splat,
Sec. 3.1.1; spec S1)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Annotated, Any, Literal

import numpy as np

from ss_flow.errors import InputError
from ss_flow.running import progress
from ss_flow.task import Resources, task
from ss_flow.tasks.artifacts import Bool, Float32, Float64, Frame, Int32, MaskSet
from ss_flow.tasks.geometry.images import decode_valid
from ss_flow.tasks.masks.overlap import drop_duplicates, mask_iou, suppress
from ss_flow.tasks.masks.pool import canonical_order, mask_tree, merge_union, whole_pictures, without_speckles
from ss_flow.tasks.models.catalogue import Model
from ss_flow.tasks.models.onnx import network_identity
from ss_flow.tasks.models.sam import LOW, Embedding, PromptedImage, Sam
from ss_flow.tasks.packed import Masks
from ss_flow.tasks.ranges import Count, Fraction, Natural, NonNegative, Range
from ss_flow.tasks.unread import by_default


@dataclass(frozen=True)
class SegmentParams:
    """How masks are prompted, filtered and merged; tuples have one value for each grid."""

    grids: tuple[Annotated[int, Range(1, 1024)], ...] = (1, 4, 8, 16)
    """Prompt points a side of each grid, coarse to fine (row 2)."""
    adaptive: bool = True
    """Whether the finest grid leaves out the points where the coarser ones agree."""
    settled_by: Count = 3
    """A point that lies in the smallest masks of so many prompts is not prompted: it would hardly find more. A mask
    above `max_area` does not count, since any thing may lie in it."""
    pred_iou: Fraction = 0.8
    """Least quality that the segmenter itself predicts (row 3)."""
    stability: tuple[Fraction, ...] | None = None
    """Least IoU of a mask cut above and below its threshold (row 4); None takes the model's own figure."""
    stability_offset: tuple[NonNegative, ...] = (0.85, 0.85, 0.85, 1.0)
    """Distance of those two cuts from the threshold, in logits (row 4)."""
    mask_threshold: tuple[float, ...] = (0.5, 0.5, 0.3, 0.3)
    """Logit above which a pixel belongs to a mask (row 5)."""
    suppression: Literal["masks", "boxes"] = "masks"
    """What two masks of one grid are compared by before the worse is dropped. A wall and what hangs on it may have
    nearly the same bounding box."""
    mask_nms: Fraction = 0.8
    """With "masks": IoU of two masks of one grid above which the worse is dropped."""
    box_nms: tuple[Fraction, ...] = (0.3, 0.3, 0.5, 0.3)
    """With "boxes": the same for their bounding boxes (row 6)."""
    max_area: Fraction = 0.8
    """Largest mask, as a share of the valid image: what fills nearly all of it is no object, nor is a mask the rest of
    whose image is another mask. 1 keeps them all."""
    speckle: Fraction = 0.05
    """Pieces of a mask smaller than this share of its largest one are taken off, and holes as small are filled."""
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
        for name, values in self._lists().items():
            if len(values) < len(self.grids):
                raise InputError(
                    f"segment.{name} has {len(values)} values but segment.grids has {len(self.grids)}; "
                    "it should have one for each grid."
                )

    def in_use(self) -> SegmentParams:
        """With what is not read as by default, so that it does not enter the key: also values beyond the grids."""
        unread = ["mask_nms" if self.suppression == "boxes" else "box_nms"]
        unread += ["duplicate_iou"] if self.merge == "union" else ["duplicate_overlap", "union_overlap"]
        unread += [] if self.adaptive else ["settled_by"]
        default, count = SegmentParams(), len(self.grids)
        lists: dict[str, Any] = {
            name: values[:count] + (getattr(default, name) or ())[count:] for name, values in self._lists().items()
        }
        return replace(by_default(self, *unread), **lists)

    def _lists(self) -> dict[str, tuple[float, ...]]:
        """What is read of each grid, by name."""
        names = ["stability", "stability_offset", "mask_threshold"] + ["box_nms"] * (self.suppression == "boxes")
        return {name: values for name in names if (values := getattr(self, name)) is not None}


@dataclass(frozen=True)
class _Candidates:
    """Masks at the network's own resolution, cropped to the image."""

    logits: Float32
    """[N, h', w'] as the network gives them, h' >= h and w' >= w: they may go on beyond the image."""
    masks: Bool
    """[N, h, w]."""
    predicted_iou: Float32
    """[N]."""
    stability: Float32
    """[N]."""
    grid: Int32
    """[N] level of the grid whose prompt found it."""

    def __getitem__(self, rows: Int32) -> _Candidates:
        return _Candidates(**{f.name: getattr(self, f.name)[rows] for f in fields(self)})

    @staticmethod
    def joined(parts: Sequence[_Candidates]) -> _Candidates:
        return _Candidates(**{f.name: np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(_Candidates)})


@task(
    name="split.segment",
    resources=Resources(cores=1, memory_mb=1500, gpus=0.1),
    environment=network_identity,
)
def segment(frame: Frame, embedding: Embedding, *, params: SegmentParams, model: Model) -> MaskSet:
    """The masks that Segment Anything finds in one view (Split&Splat, M_k; spec S1).

    embedding: the frame's, by the same model, turned or not; masks are those of the frame as it is. Pixels that the
    frame marks as not valid belong to no mask. The masks come in canonical order: area descending.
    Raises InputError when the model's files are missing, damaged or other networks.
    """
    image = Sam(model).image(embedding)
    valid = np.rot90(decode_valid(frame), embedding.turns)
    valid_low = _low_resolution(valid)

    grids: list[_Candidates] = []
    agreed: Int32 = np.zeros(valid_low.shape, np.int32)
    for level, side in enumerate(params.grids):
        points = grid_points(side, embedding.width, embedding.height)
        points = points[valid[points[:, 1].astype(int), points[:, 0].astype(int)]]
        if params.adaptive and level == len(params.grids) - 1:
            points = points[_at(points, agreed, embedding) < params.settled_by]
        accepted, held = _ask(image, points, level, valid_low, params, model)
        grids.append(accepted)
        agreed += held
        progress(level + 1, len(params.grids), f"{side} x {side}: {len(points)} prompts")
    found = _Candidates.joined(grids)

    if params.merge == "child":
        found = found[drop_duplicates(found.masks, found.predicted_iou, params.duplicate_iou)]
    if params.max_area < 1:
        found = found[np.flatnonzero(~whole_pictures(found.masks, valid_low, params.max_area)).astype(np.int32)]
    thresholds = np.array(params.mask_threshold, np.float32)[found.grid]
    masks = np.empty((len(thresholds), embedding.height, embedding.width), bool)
    for mask, logits, threshold in zip(masks, found.logits, thresholds, strict=True):
        mask[:] = without_speckles(embedding.upsample(logits[None])[0] > threshold, params.speckle) & valid
    if params.merge == "union":
        large = np.flatnonzero(_large_enough(masks, params)).astype(np.int32)
        masks, origin = merge_union(masks[large], found.grid[large], params.duplicate_overlap, params.union_overlap)
        found = found[large[origin]]
    rows = np.flatnonzero(_large_enough(masks, params)).astype(np.int32)
    rows = rows[canonical_order(masks[rows])]
    masks, found = np.rot90(masks[rows], -embedding.turns, axes=(1, 2)), found[rows]
    return MaskSet(
        **vars(Masks.of(masks)),
        name=frame.name,
        height=frame.height,
        width=frame.width,
        predicted_iou=found.predicted_iou,
        stability=found.stability,
        grid=found.grid,
        parent=mask_tree(masks, params.contained),
        source=model.name,
    )


def grid_points(side: int, width: int, height: int) -> Float64:
    """The centres of side x side equal cells of an image: [side^2, 2] x, y in pixels, row by row."""
    centres = (np.arange(side) + 0.5) / side
    x, y = np.meshgrid(centres * width, centres * height)
    return np.stack([x.ravel(), y.ravel()], axis=1)


def _ask(
    image: PromptedImage, points: Float64, level: int, valid: Bool, params: SegmentParams, model: Model
) -> tuple[_Candidates, Int32]:
    """The masks that the points of one grid find.

    Returns the accepted masks, and for each pixel [h, w] how many of the points have it in the smallest mask that they
    found, leaving out masks above `max_area`.
    """
    parts: list[_Candidates] = []
    held: Int32 = np.zeros(valid.shape, np.int32)
    for start in range(0, max(1, len(points)), image.BATCH):
        logits, scores = image.predict(points[start : start + image.BATCH])
        passed, prompt = _filter(logits, scores, level, valid, params, model)
        parts.append(passed)
        area = passed.masks.sum(axis=(1, 2))
        smallest = np.full(len(scores), -1)
        largest_first = np.argsort(-area, kind="stable")
        smallest[prompt[largest_first]] = largest_first
        smallest = smallest[smallest >= 0]
        things = smallest[area[smallest] <= params.max_area * valid.sum()]
        held += passed.masks[things].sum(axis=0, dtype=np.int32)
    found = _Candidates.joined(parts)
    if params.suppression == "masks":
        return found[suppress(mask_iou(found.masks), found.predicted_iou, params.mask_nms)], held
    return found[suppress(_box_iou(found.masks), found.predicted_iou, params.box_nms[level])], held


def _filter(
    logits: Float32, scores: Float32, level: int, valid: Bool, params: SegmentParams, model: Model
) -> tuple[_Candidates, Int32]:
    """The masks that are good enough, and the prompt of each: logits [M, 4, h', w'], scores [M, 4], valid [h, w]."""
    h, w = valid.shape
    # The first of the four answers a prompt of several points; for a single point it is the worst.
    good = scores[:, 1:] >= params.pred_iou
    flat, quality, prompt = logits[:, 1:][good], scores[:, 1:][good], np.nonzero(good)[0]
    cropped = flat[:, :h, :w]
    threshold, offset = params.mask_threshold[level], params.stability_offset[level]
    inner = np.count_nonzero(cropped > threshold + offset, axis=(1, 2))
    outer = np.count_nonzero(cropped > threshold - offset, axis=(1, 2))
    stability = (inner / np.maximum(outer, 1)).astype(np.float32)
    masks = (cropped > threshold) & valid
    area = np.count_nonzero(masks, axis=(1, 2))
    least = model.parameter("stability") if params.stability is None else params.stability[level]
    passed = np.flatnonzero((stability >= least) & (area >= max(1, params.min_area * h * w))).astype(np.int32)
    grid = np.full(len(flat), level, np.int32)
    return _Candidates(flat, masks, quality, stability, grid)[passed], prompt[passed].astype(np.int32)


def _at(points: Float64, image: Int32, seen: Embedding) -> Int32:
    """The pixels of an image of any size [h, w] at points [M, 2] of what the network saw: [M]."""
    h, w = image.shape
    return image[(points[:, 1] * h / seen.height).astype(int), (points[:, 0] * w / seen.width).astype(int)]


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
    height, width = valid.shape
    step = max(height, width) / LOW
    rows = ((np.arange(max(1, round(height / step))) + 0.5) * step).astype(int).clip(max=height - 1)
    columns = ((np.arange(max(1, round(width / step))) + 0.5) * step).astype(int).clip(max=width - 1)
    return valid[np.ix_(rows, columns)]


def _large_enough(masks: Bool, params: SegmentParams) -> Bool:
    """[N] which masks [N, H, W], of the frame's size, are no crumbs (row 7)."""
    area = masks.sum(axis=(1, 2))
    return area >= max(params.min_pixels, params.min_area * masks.shape[1] * masks.shape[2])
