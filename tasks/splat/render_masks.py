"""The instance ids that the finished scene shows: what its Gaussians say of the masks they grew from."""

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
_BENEFIT = 0.5
"""A pixel keeps its refined id while that weighs at least this share of the heaviest: borders of good masks are finer
than Gaussians, and those of bad masks are off by more than that."""


@task(name="splat.render_masks", resources=Resources(cores=1, memory_mb=1000), environment=rasterizer)
def render_masks(cameras: Cameras, scene: Gaussians, refined: Sequence[LabelMap]) -> tuple[LabelMap, ...]:
    """The instance that weighs most in each pixel of each view, all Gaussians composited together (spec P5).

    0 where that is the background, and where the scene leaves a hole. A pixel keeps its refined id where that weighs
    half as much or more; an instance that has masks but no Gaussians keeps what the scene calls background.

    refined: the exclusive masks after refinement, of all views.
    """
    absent = np.setdiff1d(np.arange(np.iinfo(np.uint16).max + 1), scene.instance_id)
    maps = []
    for view, known in enumerate(refined):
        ids = _ids_of_view(scene, camera_of(cameras, view), known)
        maps.append(LabelMap(known.name, np.where((ids == 0) & np.isin(known.ids, absent), known.ids, ids)))
        progress(view + 1, len(refined), known.name)
    return tuple(maps)


def _ids_of_view(scene: Gaussians, camera: Camera, known: LabelMap) -> np.ndarray:
    """[H, W] uint16."""
    whole = render(scene, camera)
    shown = select(scene, whole.visible)
    ids = np.zeros((camera.height, camera.width), np.uint16)
    heaviest, of_known = np.zeros(ids.shape, np.float32), np.zeros(ids.shape, np.float32)
    present = np.unique(shown.instance_id)
    for start in range(0, len(present), _LABELS_AT_ONCE):
        labels = present[start : start + _LABELS_AT_ONCE]
        weights = render(shown, camera, label_ids=labels.tolist()).label_masks
        for label, weight in zip(labels, weights, strict=True):
            ids[weight > heaviest] = label
            np.maximum(heaviest, weight, out=heaviest)
            np.copyto(of_known, weight, where=known.ids == label)
    ids[whole.alpha < _SOLID] = 0
    keeps = (of_known > 0) & (of_known >= _BENEFIT * heaviest)
    return np.where(keeps, known.ids, ids)
