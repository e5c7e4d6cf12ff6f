"""Refined masks made exclusive again: every pixel belongs to one instance."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from ss_flow.errors import InputError
from ss_flow.task import task
from ss_flow.tasks.artifacts import (
    REFINED,
    Cameras,
    DepthMap,
    Float32,
    Frame,
    InstanceMasks,
    Int32,
    LabelMap,
    Visibility,
)
from ss_flow.tasks.gaussians.views import SceneViews, scene_views
from ss_flow.tasks.geometry.images import at_diagonal, decode_valid
from ss_flow.tasks.masks.packing import pack_masks
from ss_flow.tasks.masks.painting import nearest_labels, paint_labels

_REACH = 8.0
"""How far from a pixel a point may lie that decides it, in pixels of an image with a diagonal of 800."""


@dataclass(frozen=True)
class ResolveParams:
    """How masks that refinement made overlap become exclusive again."""

    contested: Literal["points", "smaller"] = "points"
    """Whose a pixel under several masks is: "points" - the instance's whose labelled point is nearest; where none is
    near, a mask's that refinement left as it was, and the smaller one's of two such; "smaller" - always the smaller
    one's, as in the paper."""


@task()
def resolve(cameras: Cameras, instances: tuple[InstanceMasks, ...]) -> tuple[LabelMap, ...]:
    """The instance ids of every view, painted from large to small, so that the smaller is on top (spec S1, P4).

    instances: in any order; the background (id 0) is what remains. Equal areas: the lower id is on top.
    Raises InputError when masks and frames differ in size.
    """
    return _painted(cameras, instances, kept_on_top=False)


@task(uses=("opencv-contrib-python-headless",))
def resolve_refined(
    frames: tuple[Frame, ...],
    cameras: Cameras,
    depths: tuple[DepthMap, ...],
    instances: tuple[InstanceMasks, ...],
    *,
    params: ResolveParams,
    tau_depth: float = 0.02,
    tau_relative: float = 0.0,
) -> tuple[LabelMap, ...]:
    """The instance ids of every view after refinement; as `resolve`, but by `params`, 0 where a frame is not valid.

    Split's masks are exclusive, so of two masks that overlap at least one is new, made from this photo alone, while the
    labels of points have the votes of all views. frames, depths: of all views. tau_depth, tau_relative: as in `refine`.
    """
    by_points = params.contested == "points"
    maps = _painted(cameras, instances, kept_on_top=by_points)
    scene = scene_views(frames, cameras, depths, tau_depth, tau_relative)
    points = np.concatenate([instance.points for instance in instances])
    labels = np.repeat([i.instance_id for i in instances], [len(i.points) for i in instances]).astype(np.int32)
    for view, (frame, label_map) in enumerate(zip(frames, maps, strict=True)):
        if by_points:
            nearest = _nearest(scene, view, points, labels)
            for instance in instances:
                for row in np.flatnonzero((instance.view == view) & (instance.instance_id > 0)).tolist():
                    label_map.ids[instance.mask(row) & (nearest == instance.instance_id)] = instance.instance_id
        label_map.ids[~decode_valid(frame)] = 0
    return maps


def _nearest(scene: SceneViews, view: int, points: Float32, labels: Int32) -> Int32:
    """The label of the nearest point that a view sees, within reach: [H, W], 0 where that is none.

    points: [N, 3] world; labels: [N].
    """
    width, height = (int(n) for n in scene.cameras.sizes[view])
    rows, column, row, z = scene.surface_rows(view, points)
    seen = Visibility(scene.cameras.names[view], rows, row * width + column, z, height, width)
    return nearest_labels(paint_labels(seen, labels), height, width, at_diagonal(_REACH, height, width))


def _painted(cameras: Cameras, instances: tuple[InstanceMasks, ...], *, kept_on_top: bool) -> tuple[LabelMap, ...]:
    """All masks painted one over the other, smaller ones on top; kept_on_top: of those that no refinement changed."""
    maps = [np.zeros((int(height), int(width)), np.uint16) for width, height in cameras.sizes]
    seen: list[list[tuple[bool, int, int, InstanceMasks, int]]] = [[] for _ in maps]
    for instance in instances:
        if instance.instance_id == 0:
            continue
        for row, view in enumerate(instance.view):
            if maps[view].shape != (instance.height, instance.width):
                raise InputError(
                    f"Frame {cameras.names[view]} is {maps[view].shape[1]} x {maps[view].shape[0]} pixels and the "
                    f"masks of instance {instance.instance_id} are {instance.width} x {instance.height}; "
                    "both must have one size."
                )
            area = int(instance.mask(row).sum())
            on_top = kept_on_top and instance.prompted[row] != REFINED
            seen[view].append((on_top, -area, -instance.instance_id, instance, row))
    for ids, layers in zip(maps, seen, strict=True):
        for *_, instance, row in sorted(layers, key=lambda layer: layer[:3]):
            ids[instance.mask(row)] = instance.instance_id
    return tuple(LabelMap(name, ids) for name, ids in zip(cameras.names, maps, strict=True))


@task()
def exclusive(instance: InstanceMasks, maps: tuple[LabelMap, ...]) -> InstanceMasks:
    """An instance with the masks that label maps give it; for the background all that no instance has.

    maps: of all views, in their order. Views where it has no pixel left drop out. Masks that differ from those in
    `instance` are marked as refined.
    """
    old = {int(view): row for row, view in enumerate(instance.view)}
    views, masks, prompted = [], [], []
    for view, label_map in enumerate(maps):
        mask = label_map.ids == instance.instance_id
        if not mask.any():
            continue
        row = old.get(view)
        same = row is not None and np.array_equal(mask, instance.mask(row))
        views.append(view)
        masks.append(mask)
        prompted.append(instance.prompted[row] if same else REFINED)
    stack = np.array(masks, bool).reshape(-1, instance.height, instance.width)
    return replace(
        instance,
        view=np.array(views, np.int32),
        packed=pack_masks(stack),
        prompted=np.array(prompted, np.uint8),
    )
