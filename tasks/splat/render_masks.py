"""The instance ids that the finished scene shows: what its Gaussians say, rather than the masks they grew from."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ss_flow.running import progress
from ss_flow.task import Resources, task
from ss_flow.tasks.artifacts import Cameras, Gaussians, LabelMap
from ss_flow.tasks.gaussians.initialise import select
from ss_flow.tasks.gaussians.render import render
from ss_flow.tasks.geometry.cameras import Camera, camera_of
from ss_flow.tasks.splat.groups import rasterizer

_LABELS_AT_ONCE = 16
"""So many mask images are held at once."""
_SOLID = 0.5
"""Alpha from which a pixel shows anything."""


@task(name="splat.render_masks", resources=Resources(cores=1, memory_mb=1000), environment=rasterizer)
def render_masks(cameras: Cameras, scene: Gaussians, refined: Sequence[LabelMap]) -> tuple[LabelMap, ...]:
    """The instance that weighs most in each pixel of each view, all Gaussians composited together (spec P5).

    0 where that is the background, and where the scene leaves a hole. An instance that has masks but no Gaussians keeps
    what the scene calls background.

    refined: the exclusive masks after refinement, of all views.
    """
    absent = np.setdiff1d(np.arange(np.iinfo(np.uint16).max + 1), scene.instance_id)
    maps = []
    for view, known in enumerate(refined):
        ids = _heaviest(scene, camera_of(cameras, view))
        maps.append(LabelMap(known.name, np.where((ids == 0) & np.isin(known.ids, absent), known.ids, ids)))
        progress(view + 1, len(refined), known.name)
    return tuple(maps)


def _heaviest(scene: Gaussians, camera: Camera) -> np.ndarray:
    """The id with the largest weight in each pixel: [H, W] uint16."""
    whole = render(scene, camera)
    shown = select(scene, whole.visible)
    ids = np.zeros((camera.height, camera.width), np.uint16)
    weight = np.zeros(ids.shape, np.float32)
    present = np.unique(shown.instance_id)
    for start in range(0, len(present), _LABELS_AT_ONCE):
        labels = present[start : start + _LABELS_AT_ONCE]
        weights = render(shown, camera, label_ids=labels.tolist()).label_masks
        best = weights.argmax(axis=0)
        strongest = weights.max(axis=0)
        ids = np.where(strongest > weight, labels.astype(np.uint16)[best], ids)
        weight = np.maximum(weight, strongest)
    ids[whole.alpha < _SOLID] = 0
    return ids
