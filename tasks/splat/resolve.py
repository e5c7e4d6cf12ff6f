"""Refined masks made exclusive again: every pixel belongs to one instance."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ss_flow.errors import InputError
from ss_flow.task import task
from ss_flow.tasks.artifacts import REFINED, Cameras, InstanceMasks, LabelMap
from ss_flow.tasks.geometry.images import pack_masks
from ss_flow.tasks.splat.views import mask_of


@task()
def resolve(cameras: Cameras, instances: tuple[InstanceMasks, ...]) -> tuple[LabelMap, ...]:
    """The instance ids of every view, painted from large to small, so that the smaller is on top (spec S1, P4).

    instances: in any order; the background (id 0) is what remains. Equal areas: the lower id is on top.
    Raises InputError when masks and frames differ in size.
    """
    maps = [np.zeros((int(height), int(width)), np.uint16) for width, height in cameras.sizes]
    seen: list[list[tuple[int, int, InstanceMasks, int]]] = [[] for _ in maps]
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
            area = int(mask_of(instance, row).sum())
            seen[view].append((-area, -instance.instance_id, instance, row))
    for ids, layers in zip(maps, seen, strict=True):
        for _, _, instance, row in sorted(layers, key=lambda layer: layer[:2]):
            ids[mask_of(instance, row)] = instance.instance_id
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
        same = row is not None and np.array_equal(mask, mask_of(instance, row))
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
