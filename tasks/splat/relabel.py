"""Labels of Gaussians voted anew, once the scene that they make up together shows where its instances end.

Beyond Split&Splat.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ss_flow.tasks.artifacts import Gaussians, LabelMap
from ss_flow.tasks.gaussians.render import shown_instances
from ss_flow.tasks.gaussians.views import SceneViews, Views
from ss_flow.tasks.geometry.images import decode_valid, resampled, size_within

MOST_PIXELS = 160
"""Longer side of the renderings that tell what the scene shows."""
SOLID = 0.5
"""Alpha from which a pixel shows anything, and share of it from which that is one instance."""
MAJORITY = 2 / 3
"""Share of the views that see a Gaussian's centre from which their label is its own."""


def shown_masks(views: Views, scene: Gaussians, masks: Sequence[LabelMap]) -> list[LabelMap]:
    """The instance that each pixel of each view shows when the whole scene is rendered.

    A coarse and quick answer beside `render_masks`: no side of a rendering is longer than MOST_PIXELS, and borders are
    as coarse as that. Where the scene leaves a hole, no instance makes up most of a pixel, or the frame is not valid,
    what `masks` say stays.

    masks: exclusive label maps of all views.
    """
    found = []
    for frame, camera, known in zip(views.frames, views.cameras, masks, strict=True):
        small = camera.scaled(*size_within(MOST_PIXELS, camera.width, camera.height))
        shown = shown_instances(scene, small)
        sure = (shown.alpha >= SOLID) & (shown.weight >= SOLID * shown.alpha)
        ids, sure = (resampled(image, camera.height, camera.width) for image in (shown.ids, sure))
        found.append(LabelMap(known.name, np.where(sure & decode_valid(frame), ids, known.ids)))
    return found


def relabelled(views: SceneViews, scene: Gaussians, masks: Sequence[LabelMap]) -> Gaussians:
    """The same rows, each with the label that at least two thirds of the views that see its centre show there.

    Where views disagree, none sees the centre, or their label is that of no other Gaussian, the label stays. A new
    label's confidence is its share of the views; the Gaussian is of no part of its new instance.

    scene: centres on the surface, as `assemble` gives it. masks: of all views.
    """
    span = np.iinfo(np.uint16).max + 1
    keys = []
    for view, shown in enumerate(masks):
        rows, column, row, _ = views.surface_points(view, scene.means)
        keys.append(rows.astype(np.int64) * span + shown.ids[row, column])
    pair, votes = np.unique(np.concatenate(keys), return_counts=True)
    row, label = pair // span, (pair % span).astype(np.int32)
    share = votes / np.bincount(row, votes, minlength=1)[row]
    wins = (share >= MAJORITY) & (label != scene.instance_id[row]) & np.isin(label, scene.instance_id)
    row, label, share = row[wins], label[wins], share[wins]
    instance_id, confidence, part = scene.instance_id.copy(), scene.instance_conf.copy(), scene.part_id.copy()
    instance_id[row], confidence[row], part[row] = label, share, 0
    return replace(scene, instance_id=instance_id, instance_conf=confidence, part_id=part)
