"""Where the parts of instances are seen, so that a text can be held against each. Beyond Split&Splat."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ss_flow.running import progress
from ss_flow.task import Resources, task
from ss_flow.tasks.artifacts import Cameras, Gaussians, LabelMap, PartMasks
from ss_flow.tasks.gaussians.rasterize import backend_identity
from ss_flow.tasks.gaussians.render import render
from ss_flow.tasks.geometry.cameras import camera_of
from ss_flow.tasks.packed import Masks

_SOLID = 0.5
"""Alpha from which a pixel shows anything."""


@task(name="semantics.part_masks", resources=Resources(cores=1, memory_mb=1000), environment=backend_identity)
def part_masks(cameras: Cameras, scene: Gaussians, maps: Sequence[LabelMap]) -> tuple[PartMasks, ...]:
    """The parts of all instances by instance and part, each in the views that show it.

    A pixel of an instance's mask shows the part of the Gaussian with the largest weight there, and none where that is
    another instance's.

    maps: the ids that the finished scene shows in each view.
    """
    if not len(scene):
        return ()
    row_of = cameras.row_of()
    found: dict[tuple[int, int], dict[str, Masks]] = {}
    for done, shown in enumerate(maps):
        height, width = shown.ids.shape
        seen = render(scene, camera_of(cameras, row_of[shown.name]).scaled(width, height))
        top = seen.top_contributor
        same = (top >= 0) & (seen.alpha >= _SOLID) & (scene.instance_id[top] == shown.ids) & (shown.ids > 0)
        part = np.where(same, scene.part_id[top], 0)
        both = np.stack([shown.ids[part > 0], part[part > 0]], axis=1)
        for instance, number in np.unique(both, axis=0).tolist():
            mask = Masks.of([(shown.ids == instance) & (part == number)])
            found.setdefault((instance, number), {})[shown.name] = mask
        progress(done + 1, len(maps), shown.name)
    return tuple(
        PartMasks(**vars(Masks.joined(list(masks.values()))), views=tuple(masks), instance_id=instance, part_id=number)
        for (instance, number), masks in sorted(found.items())
    )
