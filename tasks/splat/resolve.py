"""Refined masks made exclusive again: every pixel belongs to one instance."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from ss_flow.errors import InputError
from ss_flow.running import in_threads
from ss_flow.task import Resources, task
from ss_flow.tasks.artifacts import REFINED, Cameras, Float32, InstanceMasks, Int32, LabelMap, Visibility
from ss_flow.tasks.gaussians.views import SceneViews, Views
from ss_flow.tasks.geometry.images import at_diagonal, decode_valid
from ss_flow.tasks.geometry.visibility import VisibilityParams
from ss_flow.tasks.masks.painting import nearest_labels, paint_labels
from ss_flow.tasks.packed import Masks

_REACH = 8.0
"""How far from a pixel a point may lie that decides it, in pixels of an image with a diagonal of 800."""


@dataclass(frozen=True)
class ResolveParams:
    """How masks that refinement made overlap become exclusive again."""

    contested: Literal["points", "smaller"] = "points"
    """Whose a pixel under several masks is: "points" - the instance's whose labelled point is nearest; where none is
    near, a mask's that refinement left as it was, and the smaller one's of two such; "smaller" - always the smaller
    one's, as in the paper."""


@task(resources=Resources(cores=1, memory_mb=1000))
def resolve(cameras: Cameras, instances: tuple[InstanceMasks, ...]) -> tuple[LabelMap, ...]:
    """The instance ids of every view, painted from large to small, so that the smaller is on top (spec S1, P4).

    instances: in any order; the background (id 0) is what remains. Equal areas: the lower id is on top.
    Raises InputError when masks and frames differ in size.
    """
    sizes = dict(zip(cameras.names, ((int(h), int(w)) for w, h in cameras.sizes), strict=True))
    return _painted(sizes, instances, kept_on_top=False)


@task(resources=Resources(cores=1, most_cores=8, memory_mb=1000))
def resolve_refined(
    views: Views,
    instances: tuple[InstanceMasks, ...],
    *,
    params: ResolveParams,
    visibility: VisibilityParams = VisibilityParams(),
) -> tuple[LabelMap, ...]:
    """The instance ids of every view after refinement; as `resolve`, but by `params`, 0 where a frame is not valid.

    Split's masks are exclusive, so of two masks that overlap at least one is new, made from this photo alone, while the
    labels of points have the votes of all views. views: all of the scene.
    """
    by_points = params.contested == "points"
    sizes = {frame.name: (frame.height, frame.width) for frame in views.frames}
    maps = _painted(sizes, instances, kept_on_top=by_points)
    scene = views.compared(visibility)
    points = np.concatenate([instance.points for instance in instances])
    labels = np.repeat([i.instance_id for i in instances], [len(i.points) for i in instances]).astype(np.int32)

    def settled(view: int) -> LabelMap:
        frame, label_map = views.frames[view], maps[view]
        if by_points:
            nearest = _nearest(scene, view, points, labels)
            for instance in instances:
                if instance.instance_id and frame.name in instance.views:
                    mask = instance.mask(instance.views.index(frame.name))
                    label_map.ids[mask & (nearest == instance.instance_id)] = instance.instance_id
        label_map.ids[~decode_valid(frame)] = 0
        return label_map

    return tuple(in_threads(settled, range(len(maps))))


def _nearest(scene: SceneViews, view: int, points: Float32, labels: Int32) -> Int32:
    """The label of the nearest point that a view sees, within reach: [H, W], 0 where that is none.

    points: [N, 3] world; labels: [N].
    """
    height, width = scene.frames[view].height, scene.frames[view].width
    rows, column, row, z = scene.surface_points(view, points)
    seen = Visibility(scene.frames[view].name, rows, row * width + column, z.astype(np.float32), height, width)
    return nearest_labels(paint_labels(seen, labels), height, width, at_diagonal(_REACH, height, width))


def _painted(
    sizes: Mapping[str, tuple[int, int]], instances: tuple[InstanceMasks, ...], *, kept_on_top: bool
) -> tuple[LabelMap, ...]:
    """All masks painted one over the other, smaller ones on top.

    sizes: height and width of each view. kept_on_top: whether masks that no refinement changed come above the others.
    """
    maps = {name: np.zeros(size, np.uint16) for name, size in sizes.items()}
    seen: dict[str, list[tuple[bool, int, int, InstanceMasks, int]]] = {name: [] for name in maps}
    for instance in instances:
        if instance.instance_id == 0:
            continue
        for row, (view, area) in enumerate(zip(instance.views, instance.areas().tolist(), strict=True)):
            if maps[view].shape != tuple(instance.sizes[row][::-1]):
                raise InputError(
                    f"Frame {view} is {maps[view].shape[1]} x {maps[view].shape[0]} pixels and the "
                    f"mask of instance {instance.instance_id} has {instance.sizes[row, 0]} x {instance.sizes[row, 1]}; "
                    "both must have one size."
                )
            on_top = kept_on_top and instance.origin[row] != REFINED
            seen[view].append((on_top, -area, -instance.instance_id, instance, row))
    for view, layers in seen.items():
        for *_, instance, row in sorted(layers, key=lambda layer: layer[:3]):
            maps[view][instance.mask(row)] = instance.instance_id
    return tuple(LabelMap(name, ids) for name, ids in maps.items())


@task()
def exclusive(instance: InstanceMasks, maps: tuple[LabelMap, ...]) -> InstanceMasks:
    """An instance with the masks that label maps give it; for the background all that no instance has.

    maps: at least those with a pixel of it, in the order of the frames. Views where it has no pixel left drop out.
    Masks that differ from those in `instance` are marked as refined.
    """
    old = {name: row for row, name in enumerate(instance.views)}
    views, masks, origins = [], [], []
    for label_map in maps:
        mask = label_map.ids == instance.instance_id
        if not mask.any():
            continue
        row = old.get(label_map.name)
        same = row is not None and np.array_equal(mask, instance.mask(row))
        views.append(label_map.name)
        masks.append(Masks.of([mask]))
        origins.append(instance.origin[row] if same else REFINED)
    return replace(instance, **vars(Masks.joined(masks)), views=tuple(views), origin=np.array(origins, np.uint8))
