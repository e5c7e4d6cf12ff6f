"""2D instance masks of one RGB-D view without any weights: the stated fallback for Segment Anything."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ss_flow.task import Resources, task
from ss_flow.tasks.artifacts import Bool, DepthMap, Frame, Int32, MaskSet
from ss_flow.tasks.geometry.cameras import Camera
from ss_flow.tasks.geometry.holes import close_holes
from ss_flow.tasks.geometry.images import decode_rgb, decode_valid, resampled
from ss_flow.tasks.masks.overlap import drop_duplicates
from ss_flow.tasks.masks.pool import canonical_order, mask_tree
from ss_flow.tasks.packed import Masks
from ss_flow.tasks.ranges import Angle, Count, Fraction, Natural, NonNegative, Positive
from ss_flow.tasks.split.regions.graph_segmentation import (
    RegionGraph,
    Surface,
    boundaries,
    find_planes,
    superpixels,
    surface_of,
)


@dataclass(frozen=True)
class SegmentRgbdParams:
    """How regions grow together."""

    side: Count = 320
    """Longer side of the image that regions are grown on, in pixels; masks are scaled back to the frame."""
    levels: tuple[NonNegative, ...] = (0.17, 0.28, 0.45)
    """Boundary strengths up to which regions merge; each level gives masks, and the lowest gives the finest."""
    depth_jump: Positive = 0.02
    """Step in depth, as a share of the depth, at which a surface ends."""
    crease: Angle = 45.0
    """Angle of a concave crease at which an object ends, in degrees."""
    color_weight: NonNegative = 0.2
    """Strength that a difference of colour adds to a boundary whose depth is known."""
    color_scale: Positive = 30.0
    """Distance at which colours count as different, in Lab of 8 bits (lightness runs to 255: it counts 2.55 times)."""
    superpixel: Count = 20
    """Least size of the regions that everything starts from, in pixels of the working image."""
    plane_share: Fraction = 0.05
    """Least share of the image of a plane that gets a mask of its own."""
    plane_tolerance: Positive = 0.01
    """Distance from a plane of its points, as a share of the depth."""
    min_area: Fraction = 0.0025
    """Smallest mask, as a share of the image."""
    min_pixels: Natural = 64
    """Smallest mask, in pixels of the frame."""
    duplicate_iou: Fraction = 0.9
    """IoU above which the worse of two masks is dropped."""
    contained: Fraction = 0.9
    """Share of a mask that its parent holds."""


@task(
    name="split.segment_rgbd",
    resources=Resources(cores=1, memory_mb=500),
)
def segment_rgbd(frame: Frame, depth: DepthMap, camera: Camera, *, params: SegmentRgbdParams) -> MaskSet:
    """The masks of one view from its colours and its depth alone (the place of Split&Splat's M_k; spec S1).

    Gives the same tree as a segmenter: the finest level holds objects, coarser ones groups, and large planes (walls,
    floor, table tops) have masks of their own. `predicted_iou` is how strong a mask's boundary is, `stability` the IoU
    of the mask at a level a tenth lower and a tenth higher.
    """
    rgb, valid = decode_rgb(frame), decode_valid(frame)
    scale = min(1.0, params.side / max(frame.width, frame.height))
    width, height = max(8, round(frame.width * scale)), max(8, round(frame.height * scale))
    camera = camera.scaled(width, height)

    import cv2

    small = cv2.resize(rgb, (width, height), interpolation=cv2.INTER_AREA)
    valid_small = resampled(valid, height, width)
    # Thin holes would cut every surface into pieces. They are closed for the masks alone: steps that compare depths
    # must see measured depth only, not guesses.
    closed = resampled(resampled(close_holes(depth.depth), frame.height, frame.width), height, width)
    surface = surface_of(np.where(valid_small, closed, 0).astype(np.float32), camera)
    boundary = boundaries(surface, valid_small, params.depth_jump, params.crease)
    regions = superpixels(small, surface, boundary, valid_small, params.superpixel)
    lab = cv2.cvtColor(small, cv2.COLOR_RGB2LAB).astype(np.float32)
    graph = RegionGraph(regions, lab, boundary, params.color_weight, params.color_scale)

    found = [*_merged(graph, regions, params), *_planes(surface, valid_small, params)]
    return _finish(frame, valid, found, params)


class _Mask(NamedTuple):
    """One mask, and what `MaskSet` says of it."""

    mask: Bool
    """[h, w] at the working size."""
    quality: float
    stability: float
    grid: int


def _merged(graph: RegionGraph, regions: Int32, params: SegmentRgbdParams) -> Iterator[_Mask]:
    """The regions of each level, the finest level first. regions: [h, w], -1 = none."""
    areas = np.bincount(regions[regions >= 0], minlength=graph.size)
    for step, level in enumerate(sorted(params.levels)):
        graph.merge(level * 0.9)
        before = graph.owners()
        graph.merge(level)
        owners = graph.owners()
        enclosure = graph.enclosures()
        graph.merge(level * 1.1)
        after = graph.owners()
        # Row -1 is the last one: pixels of no region.
        labels = np.append(owners, -1)[regions]
        for region in np.unique(owners):
            members = owners == region
            inner = np.bincount(before[members], areas[members]).max()
            outer = areas[after == after[region]].sum()
            quality = min(1.0, enclosure[int(region)])
            yield _Mask(labels == region, quality, float(inner / outer), len(params.levels) - 1 - step)


def _planes(surface: Surface, valid: Bool, params: SegmentRgbdParams) -> Iterator[_Mask]:
    """Large planes, with smooth borders."""
    import cv2

    for plane in find_planes(surface, valid, params.plane_share, params.plane_tolerance):
        opened = cv2.morphologyEx(plane.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
        closed = cv2.morphologyEx(opened, cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8)).astype(bool)
        yield _Mask(closed & valid, 0.5, 1.0, 0)


def _finish(frame: Frame, valid: Bool, found: Sequence[_Mask], params: SegmentRgbdParams) -> MaskSet:
    """Drop small masks and duplicates, scale the rest to the frame, and put them in canonical order.

    valid: [H, W] of the frame.
    """
    import cv2

    found = [one for one in found if one.mask.sum() >= max(1, params.min_area * one.mask.shape[0] * one.mask.shape[1])]
    if found:
        quality = np.array([one.quality for one in found], np.float32)
        kept = drop_duplicates(np.array([one.mask for one in found]), quality, params.duplicate_iou)
        found = [found[row] for row in kept]
    size = (frame.width, frame.height)
    full = np.zeros((len(found), frame.height, frame.width), bool)
    for mask, one in zip(full, found, strict=True):
        mask[:] = cv2.resize(one.mask.astype(np.float32), size, interpolation=cv2.INTER_LINEAR) >= 0.5
    full &= valid
    least = max(params.min_pixels, params.min_area * frame.width * frame.height)
    rows = np.flatnonzero(full.sum(axis=(1, 2)) >= least).astype(np.int32)
    rows = rows[canonical_order(full[rows])]
    full, found = full[rows], [found[row] for row in rows]
    return MaskSet(
        **vars(Masks.of(full)),
        name=frame.name,
        height=frame.height,
        width=frame.width,
        predicted_iou=np.array([one.quality for one in found], np.float32),
        stability=np.array([one.stability for one in found], np.float32),
        grid=np.array([one.grid for one in found], np.int32),
        parent=mask_tree(full, params.contained),
        source="rgbd-graph",
    )
