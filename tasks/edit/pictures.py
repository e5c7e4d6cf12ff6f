"""Pictures of a scene before and after an edit."""

from __future__ import annotations

import numpy as np

from ss_flow.task import task
from ss_flow.tasks.artifacts import Cameras, Gaussians
from ss_flow.tasks.deliver.compressed import Picture, compressed
from ss_flow.tasks.gaussians.rasterize import backend_identity
from ss_flow.tasks.gaussians.render import render
from ss_flow.tasks.geometry.cameras import camera_of

_LOOKED_AT = 12
_SMALL = 96
_SHOWN = 3


@task(environment=backend_identity)
def before_and_after(before: Gaussians, after: Gaussians, cameras: Cameras) -> tuple[Picture, ...]:
    """The three views that changed most, before on the left and after on the right.

    Of at most twelve views, evenly chosen; none where nothing is to be seen.
    """
    if not len(before) or not len(after):
        return ()
    looked_at = np.unique(np.linspace(0, len(cameras) - 1, _LOOKED_AT).astype(int)).tolist()
    changes = []
    for view in looked_at:
        camera = camera_of(cameras, view)
        small = camera.scaled(_SMALL, max(1, round(_SMALL * camera.height / camera.width)))
        changes.append(float(np.abs(render(before, small).rgb - render(after, small).rgb).mean()))
    order = np.argsort(-np.array(changes), kind="stable")[:_SHOWN]
    pictures = []
    for view in sorted(looked_at[row] for row in order):
        camera = camera_of(cameras, view)
        pair = np.concatenate([render(scene, camera).rgb for scene in (before, after)], axis=1)
        picture = np.rint(255 * pair.clip(0, 1)).astype(np.uint8)
        pictures.append(Picture(f"{cameras.names[view]}: before and after", compressed(picture)))
    return tuple(pictures)
