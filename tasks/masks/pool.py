"""The pool of masks of one view: canonical order, duplicates, the mask tree, and the exclusive map (spec S1)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ss_flow.tasks.artifacts import Bool, Float32, Int32, MaskSet
from ss_flow.tasks.masks.overlap import intersections, mask_iou, suppress
from ss_flow.tasks.packed import Masks, bounds

_CRUMB = 0.1
"""Pieces of a drawn mask below this share of its largest one are no part of it."""


def canonical_order(masks: Bool) -> Int32:
    """The order in which masks are taken everywhere, so that the order they come in does not matter (spec S1).

    masks: [N, H, W]. Returns [N] indices: area descending, then row, then column of the centroid, then the pixels
    themselves; only equal masks keep the order they came in.
    """
    if not len(masks):
        return np.zeros(0, np.int32)
    count, width = len(masks), masks.shape[2]
    keys = []
    for index in range(count):
        row, column = np.divmod(np.flatnonzero(masks[index]), width)
        keys.append((-len(row), int(row.sum()), int(column.sum()), np.packbits(masks[index]).tobytes()))
    return np.array(sorted(range(count), key=keys.__getitem__), np.int32)


def exclusive(masks: Bool, order: Int32) -> Int32:
    """One mask a pixel: large masks painted first, smaller ones on top (spec S1).

    masks: [N, H, W]; order: their canonical order. Returns [H, W] the index of the mask that owns each pixel, -1 where
    there is none.
    """
    owner = np.full(masks.shape[1:], -1, np.int32)
    for index in order:
        owner[masks[index]] = index
    return owner


def whole_pictures(masks: Bool, valid: Bool, max_area: float) -> Bool:
    """[N] which masks are the picture rather than a thing in it: they fill more than the share `max_area` of the valid
    pixels, or what they leave free is another mask (IoU above `max_area`) and smaller than they are.

    masks: [N, H, W], on valid pixels only. valid: [H, W].
    """
    shared, total = intersections(masks), float(valid.sum())
    areas = np.diag(shared)
    # The rest of mask i shares areas[j] - shared[i, j] pixels with mask j.
    both = areas[None] - shared
    iou_of_rest = both / np.maximum(total - areas[:, None] + areas[None] - both, 1)
    complement = (iou_of_rest > max_area) & (areas[None] < areas[:, None])
    return (areas > max_area * total) | complement.any(axis=1)


def large_pieces(mask: Bool, share: float) -> tuple[Bool, float]:
    """A mask [H, W] without its pieces below this share of the largest, and the area of which these fall short."""
    import cv2

    large = np.zeros_like(mask)
    if not mask.any():
        return large, 0.0
    x0, y0, x1, y1 = bounds(mask)
    _, piece, stats, _ = cv2.connectedComponentsWithStats(mask[y0:y1, x0:x1].astype(np.uint8), connectivity=8)
    area = stats[:, cv2.CC_STAT_AREA].copy()
    area[0] = 0
    least = share * float(area.max())
    large[y0:y1, x0:x1] = ((area > 0) & (area >= least))[piece]
    return large, least


def without_speckles(mask: Bool, share: float) -> Bool:
    """A mask [H, W] without its small islands and holes: pieces below this share of its largest piece are taken off,
    and holes as small are filled. What lies open to the image's border is no hole."""
    import cv2

    if not share or not mask.any():
        return mask
    # A gap that reaches the edge of the mask's bounds goes on round the mask, to the image's border.
    x0, y0, x1, y1 = bounds(mask)
    inner = mask[y0:y1, x0:x1]
    large, least = large_pieces(inner, share)
    _, gap, stats, _ = cv2.connectedComponentsWithStats((~inner).astype(np.uint8), connectivity=4)
    x, y, w, h, size = stats[:, :5].T
    inside = (x > 0) & (y > 0) & (x + w < inner.shape[1]) & (y + h < inner.shape[0])
    hole = inside & (size < least)
    hole[0] = False  # the mask itself
    mended = np.zeros_like(mask)
    mended[y0:y1, x0:x1] = large | hole[gap]
    return mended


def smoothed(mask: Bool, radius: int) -> Bool:
    """A mask [H, W] with smooth borders and without crumbs.

    A pixel belongs to it when most of the square of this radius round it does; pieces of less than a tenth of the
    largest one are dropped.
    """
    import cv2

    side = 2 * radius + 1
    x0, y0, x1, y1 = bounds(mask)
    # Farther off than this nothing is seen of it.
    near = (slice(max(y0 - side, 0), y1 + side), slice(max(x0 - side, 0), x1 + side))
    most = np.zeros_like(mask)
    most[near] = cv2.boxFilter(mask[near].astype(np.float32), -1, (side, side), borderType=cv2.BORDER_REPLICATE) > 0.5
    return large_pieces(most, _CRUMB)[0]


def mask_tree(masks: Bool, contained: float) -> Int32:
    """The parent of each mask: the smallest larger one that holds at least the share `contained` of it.

    masks: [N, H, W] in canonical order, none empty. Returns [N] rows, -1 at the top; a parent comes before its
    children.
    """
    shared = intersections(masks)
    areas = np.diag(shared)
    parent = np.full(len(masks), -1, np.int32)
    for index in range(1, len(masks)):
        holders = np.flatnonzero(shared[index, :index] >= contained * areas[index])
        if holders.size:
            parent[index] = holders[-1]
    return parent


def mask_set(name: str, masks: Bool, predicted_iou: Float32, source: str, *, contained: float = 0.9) -> MaskSet:
    """Masks that came from elsewhere than the grids as the masks of a view: in canonical order, without empty ones.

    masks: [N, H, W]. predicted_iou: [N]. source: who made them. contained: as `mask_tree` takes it.
    """
    order = canonical_order(masks)
    order = order[masks[order].any(axis=(1, 2))]
    kept = masks[order]
    return MaskSet(
        name=name,
        height=masks.shape[1],
        width=masks.shape[2],
        **vars(Masks.of(kept)),
        predicted_iou=predicted_iou[order].astype(np.float32),
        stability=np.ones(len(kept), np.float32),
        grid=np.zeros(len(kept), np.int32),
        parent=mask_tree(kept, contained),
        source=source,
    )


def with_more(
    whole: MaskSet,
    masks: Bool,
    predicted_iou: Float32,
    stability: Float32,
    *,
    grid: int,
    max_iou: float,
    contained: float,
) -> MaskSet:
    """The masks of a view and more of them [N, H, W], none empty: of two with an IoU above `max_iou` its own stays,
    or the surer one.

    predicted_iou, stability: [N]. grid: what to say that these came from. contained: as `mask_tree` takes it.
    """
    everything = np.concatenate([whole.dense(), masks])
    quality = np.concatenate([whole.predicted_iou, predicted_iou])
    own = np.arange(len(quality)) < len(whole)
    rows = suppress(mask_iou(everything), quality + 2 * own, max_iou)
    rows = rows[canonical_order(everything[rows])]
    return replace(
        whole,
        **vars(Masks.of(everything[rows])),
        predicted_iou=quality[rows],
        stability=np.concatenate([whole.stability, stability])[rows],
        grid=np.append(whole.grid, np.full(len(masks), grid, np.int32))[rows],
        parent=mask_tree(everything[rows], contained),
    )


def merge_union(masks: Bool, grid: Int32, duplicate: float, overlap: float) -> tuple[Bool, Int32]:
    """Promote larger masks: a mask of a finer grid is united with every one before it that it overlaps, of a coarser
    grid, or larger and of its own (Split&Splat, Sec. 3.1.1; spec S1 with rows 8 and 9 of its table).

    masks: [N, H, W], none empty. grid: [N] grid of origin, 0 = coarsest. duplicate: share of the smaller mask above
    which the later of two masks of one grid is dropped. overlap: share of the smaller mask above which two are united.
    Returns masks [K, H, W] and, for each, the row it grew from.
    """
    pool: list[Bool] = []
    origin: list[int] = []
    for level in np.unique(grid):
        rows = np.flatnonzero(grid == level)
        rows = rows[canonical_order(masks[rows])]
        # Canonical order is area descending, so the smaller of two is the later one.
        shared = intersections(masks[rows])
        areas = np.diag(shared)
        share = shared / np.minimum(areas[:, None], areas[None])
        rows = rows[suppress(share, -np.arange(len(rows), dtype=np.float32), duplicate)]
        for row in rows:
            mask = masks[row]
            hit = [p for p in pool if _pixels(p & mask) > overlap * min(_pixels(p), _pixels(mask))]
            if hit and level > 0:
                for promoted in hit:
                    promoted |= mask
            else:
                pool.append(mask.copy())
                origin.append(int(row))
    return np.array(pool, bool).reshape(-1, *masks.shape[1:]), np.array(origin, np.int32)


def _pixels(mask: Bool) -> int:
    return int(np.count_nonzero(mask))


def masks_by_id(ids: NDArray[np.integer], name: str) -> MaskSet:
    """The masks of an id image [H, W], one for each id above 0, by rising id."""
    present = np.unique(ids)
    present = present[present > 0]
    count = len(present)
    return MaskSet(
        name=name,
        height=ids.shape[0],
        width=ids.shape[1],
        **vars(Masks.of(ids == i for i in present)),
        predicted_iou=np.ones(count, np.float32),
        stability=np.ones(count, np.float32),
        grid=np.zeros(count, np.int32),
        parent=np.full(count, -1, np.int32),
        source="ready-made",
    )
