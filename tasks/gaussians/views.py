"""What a view says about some of the instances: the pixels that train their Gaussians (spec P1)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ss_flow.errors import InputError
from ss_flow.task import Bundle
from ss_flow.tasks.artifacts import Bool, ColourTransform, DepthMap, Float32, Float64, Frame, Int32, SceneUnit
from ss_flow.tasks.geometry.cameras import Camera, pixels_in_view
from ss_flow.tasks.geometry.clustering import nearest_spacing
from ss_flow.tasks.geometry.fusion import depth_at
from ss_flow.tasks.geometry.images import averaged_valid, pixels_under, shared_rgb, shared_valid, transformed
from ss_flow.tasks.geometry.visibility import VisibilityParams, surface_points
from ss_flow.tasks.ranges import Count, Natural

NONE_OF_MINE, IGNORED = -2, -1
"""Pixels without an instance of the group, and pixels that say nothing about it (see `TrainView.ids`)."""
_MAX_REACH_PX = 8


@dataclass(frozen=True)
class TrainView:
    """One view to train on; every array has the camera's size."""

    camera: Camera
    """Already cropped to the view's box."""
    image: Float32
    """[h, w, 3] RGB of the scene: that of the photo, 0..1, through its colour transform."""
    inside: Bool
    """[h, w] pixels of what is trained: colour loss, alpha towards 1."""
    free: Bool
    """[h, w] pixels where nothing is: alpha towards 0, or colour towards black. Pixels of neither kind are ignored."""
    depth: Float32
    """[h, w] z-depth in world units, 0 = unknown; counts inside only."""
    ids: Int32 | None = None
    """[h, w] for the mask loss: index into `label_ids`, -1 = ignore, -2 = none of them. None = no mask loss."""


@dataclass(frozen=True)
class Views(Bundle):
    """Views of a scene, all or some, in the order of their frames."""

    frames: Sequence[Frame]
    cameras: Sequence[Camera]
    depths: Sequence[DepthMap]
    unit: SceneUnit
    colours: Sequence[ColourTransform]
    """What the photos' colours go through; empty where they stay."""

    def row_of(self) -> dict[str, int]:
        """The row of each view by its name."""
        return {frame.name: row for row, frame in enumerate(self.frames)}

    def compared(self, visibility: VisibilityParams) -> SceneViews:
        """The same with what tells whether two depths are of one surface."""
        return SceneViews(self.frames, self.cameras, self.depths, self.unit, self.colours, visibility)


@dataclass(frozen=True)
class SceneViews(Views):
    """Views of a scene, and when two depths are of one surface."""

    visibility: VisibilityParams

    def tolerance(self, depth: Float32) -> Float32:
        """How far two depths of one surface may differ, world units."""
        return np.asarray(self.visibility.tolerance(depth, self.unit.length), np.float32)

    def surface_points(self, view: int, points: Float32) -> tuple[Int32, Int32, Int32, Float64]:
        """The points [N, 3] that a view sees (Split&Splat, Eq. 1-2), as `surface_points` gives them."""
        return surface_points(points, self.cameras[view], self.depths[view], self.visibility, self.unit.length)


@dataclass(frozen=True)
class PointSurface:
    """The surface of what is trained, as points."""

    points: Float32
    """[N, 3] world."""
    spacing: float
    """Median distance to the nearest neighbour, world units."""

    @classmethod
    def of(cls, points: Float32) -> PointSurface:
        return cls(points, nearest_spacing(points))


@dataclass(frozen=True)
class CropParams:
    """Which part of a view is used, and how large."""

    margin_px: Natural = 16
    """Pixels of the photo added on every side of the box around the instance."""
    max_side: Count = 480
    """Longest side of the crop, pixels; larger crops are scaled down."""


def channels_of_mask(mask: Bool) -> Int32:
    """What `group_view` takes of an instance with this mask [H, W]: 0 inside, NONE_OF_MINE outside."""
    channels = np.full(mask.shape, NONE_OF_MINE, np.int32)
    channels[mask] = 0
    return channels


def sample_depth(depth: DepthMap, full: Camera, crop: Camera) -> Float32:
    """A view's depth at the pixel centres of a crop of its camera, nearest neighbour: [h, w], 0 where unknown.

    full: the view's camera; crop: `full`, cropped and scaled.
    """
    column, row = _pixels_of_crop(full, crop)
    row, column = np.meshgrid(row, column, indexing="ij")
    return depth_at(depth, column, row, full.width, full.height)


def propagated_depth(points: Float32, camera: Camera, spacing: float) -> Float32:
    """The depth of a surface that is known by points only: [h, w] z-depth, 0 where no point is near.

    points: [N, 3] world; spacing: distance between neighbours, world units. Each pixel takes the mean depth of the
    points in front within the projected spacing, so that the surface has no holes between its points.
    """
    import cv2

    rows, column, row, z = pixels_in_view(points, camera)
    if not len(rows):
        return np.zeros((camera.height, camera.width), np.float32)
    far = np.float32(np.finfo(np.float32).max)
    own = np.full((camera.height, camera.width), far)
    np.minimum.at(own, (row, column), z.astype(np.float32))
    distance = float(np.median(z))
    reach = int(np.clip(np.ceil(spacing * camera.fx / distance), 1, _MAX_REACH_PX))
    window = (2 * reach + 1, 2 * reach + 1)
    nearest = cv2.erode(own, np.ones(window, np.uint8), borderType=cv2.BORDER_REPLICATE)
    # Farther points belong to a side of the surface that shows through between those in front.
    in_front = (own < far) & (own - nearest <= 3 * max(spacing, reach * distance / camera.fx))
    total = cv2.boxFilter(
        np.where(in_front, own, 0), cv2.CV_32F, window, normalize=False, borderType=cv2.BORDER_CONSTANT
    )
    count = cv2.boxFilter(
        in_front.astype(np.float32), cv2.CV_32F, window, normalize=False, borderType=cv2.BORDER_CONSTANT
    )
    return np.where(count > 0.5, total / np.maximum(count, 1), 0).astype(np.float32)


def crop_camera(full: Camera, inside: Bool, points: Float32 | Float64, params: CropParams) -> Camera:
    """The camera of the box around a mask and the projections of points: cropped, and scaled to `max_side`.

    inside: [H, W]; points: [N, 3] world. The outermost 0.5 % of the points do not widen the box. The whole image where
    there is neither mask nor point.
    """
    _, column, row, _ = pixels_in_view(points, full)
    columns, rows = np.flatnonzero(inside.any(axis=0)), np.flatnonzero(inside.any(axis=1))
    if len(column):
        outermost = np.quantile([column, row], (0.005, 0.995), axis=1)
        columns, rows = np.append(columns, outermost[:, 0]), np.append(rows, outermost[:, 1])
    if not len(columns):
        return full
    x0, y0 = (max(0, int(v.min()) - params.margin_px) for v in (columns, rows))
    x1 = min(full.width, int(columns.max()) + 1 + params.margin_px)
    y1 = min(full.height, int(rows.max()) + 1 + params.margin_px)
    cropped = full.cropped(x0, y0, x1, y1)
    scale = min(1.0, params.max_side / max(cropped.width, cropped.height))
    return cropped.scaled(max(1, round(cropped.width * scale)), max(1, round(cropped.height * scale)))


def group_view(
    scene: SceneViews,
    view: int,
    channels: Int32,
    surface: PointSurface,
    *,
    crop: CropParams,
    ignore_occluded: bool = True,
    around: Float32 | None = None,
) -> TrainView:
    """One view of an instance (spec P1) or of a group of them (P4).

    Pixels are *inside* a mask of the group (colour counts), *free* (nothing of the group may be seen), or ignored:
    where something lies in front of the group's surface, where a depth needed to tell is unknown, or where the frame
    is masked out.

    channels: [H, W] index of the group's instance at each pixel, NONE_OF_MINE where there is none, IGNORED where the
    pixel says nothing. surface: of the group. around: [M, 3] the part of the group that the crop shows, in place of all
    of it. ignore_occluded: False calls every pixel outside the masks free, as in the paper.
    Raises InputError when the frame's size is not that of the masks.
    """
    seen = _crop(scene, view, channels, crop, surface.points if around is None else around, masks=around is None)
    free = seen.outside
    if ignore_occluded:
        depth = propagated_depth(surface.points, seen.camera, surface.spacing)
        # What lies in front of the surface, or may do so since no depth is known there.
        covered = (depth > 0) & ((seen.depth == 0) | (seen.depth + scene.tolerance(depth) < depth))
        free = free & ~covered
    return seen.training(free)


def background_view(
    scene: SceneViews,
    view: int,
    channels: Int32,
    surface: PointSurface,
    *,
    crop: CropParams,
    ignore_occluded: bool = True,
) -> TrainView:
    """One view of the background, which goes on unseen behind all else: only pixels that look through it are free.

    All as for `group_view`.
    """
    seen = _crop(scene, view, channels, crop, surface.points)
    free = seen.outside
    if ignore_occluded:
        depth = propagated_depth(surface.points, seen.camera, surface.spacing)
        free = free & (depth > 0) & (seen.depth > depth + scene.tolerance(depth))
    return seen.training(free)


def whole_view(scene: SceneViews, view: int, channels: Int32, max_side: int) -> TrainView:
    """One view of the whole scene: the entire photo, of which every valid pixel outside the masks is free.

    channels: as for `group_view`. max_side: longest side, pixels; larger photos are scaled down.
    """
    everything = CropParams(margin_px=max(channels.shape), max_side=max_side)
    seen = _crop(scene, view, channels, everything, np.zeros((0, 3), np.float32))
    return seen.training(seen.outside)


@dataclass(frozen=True)
class _Crop:
    """A part of a view, at the size at which it is trained on."""

    camera: Camera
    image: Float32
    """[h, w, 3] RGB of the scene."""
    inside: Bool
    """[h, w] valid pixels of the masks."""
    outside: Bool
    """[h, w] valid pixels of no mask that say something."""
    channels: Int32
    """[h, w]."""
    depth: Float32
    """[h, w] z-depth, world units, 0 = unknown."""

    def training(self, free: Bool) -> TrainView:
        ids = np.full(free.shape, IGNORED, np.int32)
        ids[free] = NONE_OF_MINE
        np.copyto(ids, self.channels, where=self.inside)
        depth = np.where(self.inside, self.depth, np.float32(0))
        return TrainView(self.camera, self.image, self.inside, free, depth, ids)


def _crop(
    scene: SceneViews, view: int, channels: Int32, crop: CropParams, points: Float32, *, masks: bool = True
) -> _Crop:
    """The part of a view around points and, if so asked, the masks."""
    import cv2

    frame, full = scene.frames[view], scene.cameras[view]
    if channels.shape != (frame.height, frame.width):
        raise InputError(
            f"Frame {frame.name} is {frame.width} x {frame.height} pixels and its masks are "
            f"{channels.shape[1]} x {channels.shape[0]}; both must have one size."
        )
    camera = crop_camera(full, channels >= 0 if masks else np.zeros(channels.shape, bool), points, crop)
    column, row = _pixels_of_crop(full, camera)
    x0, y0, width, height = _box(full, camera)
    photo = shared_rgb(frame)[y0 : y0 + height, x0 : x0 + width]
    valid = shared_valid(frame)[y0 : y0 + height, x0 : x0 + width]
    if photo.shape[:2] != (camera.height, camera.width):
        photo = cv2.resize(photo, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
        valid = averaged_valid(valid, camera.width, camera.height)
    image = photo.astype(np.float32) / np.float32(255)
    if scene.colours and scene.colours[view].reference:
        image = transformed(image, scene.colours[view])
    ids = channels[np.ix_(row, column)]
    return _Crop(
        camera=camera,
        image=image,
        inside=(ids >= 0) & valid,
        outside=(ids < 0) & (ids != IGNORED) & valid,
        channels=ids,
        depth=sample_depth(scene.depths[view], full, camera),
    )


def _box(full: Camera, crop: Camera) -> tuple[int, int, int, int]:
    """Where a crop lies in the full image: x0, y0, width, height in pixels."""
    sx, sy = full.fx / crop.fx, full.fy / crop.fy
    return (
        round(full.cx - crop.cx * sx),
        round(full.cy - crop.cy * sy),
        round(crop.width * sx),
        round(crop.height * sy),
    )


def _pixels_of_crop(full: Camera, crop: Camera) -> tuple[Int32, Int32]:
    """The pixel columns and rows of the full image under the pixel centres of a crop."""
    x0, y0, width, height = _box(full, crop)
    column, row = x0 + pixels_under(crop.width, width), y0 + pixels_under(crop.height, height)
    return column.astype(np.int32), row.astype(np.int32)
