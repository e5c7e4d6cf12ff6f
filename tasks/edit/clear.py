"""What no view has shaped, taken away with what had hidden it."""

from __future__ import annotations

import numpy as np

from ss_flow.running import progress
from ss_flow.task import Resources, task
from ss_flow.tasks.artifacts import Bool, EditedScene, Float32
from ss_flow.tasks.edit.holes import SHOWS, Measured, Remains, stays
from ss_flow.tasks.gaussians.initialise import select
from ss_flow.tasks.gaussians.rasterize import backend_identity
from ss_flow.tasks.gaussians.render import render, shares
from ss_flow.tasks.geometry.cameras import Camera, camera_of
from ss_flow.tasks.geometry.images import size_within

_MOST_PIXELS = 320
"""Longer side of the pictures in which weights are summed."""
_GROWN = 2.0
"""How many times as much a Gaussian shows where something has left as it had shown elsewhere, from which on it goes."""
_GROWN_ON_SURFACE = 8.0
"""The same, no farther than a spacing from a dense point that remains: there a view has measured the surface."""


@task(name="edit.clear", resources=Resources(cores=1, memory_mb=1000, gpus=0.1), environment=backend_identity)
def clear(
    before: EditedScene,
    after: EditedScene,
    measured: Measured,
    *,
    instances: tuple[int, ...],
    gone: tuple[int, ...],
) -> EditedScene:
    """Take away what shows only since some instances have left their place.

    Behind and inside of a thing nothing is trained to look like anything, and along its outline some Gaussians of what
    is around it carry its colour. Both come to light where it was. So a Gaussian of what stayed goes when its weight,
    T * alpha summed over the pixels of one view that had shown the instances, is now in some view more than twice as
    much as in any view it was in all other pixels; on a surface that was measured, more than eight times, as a single
    view may have seen it at a slant. What was filled before stays, and so does what is new.

    before: the scene with the instances in their old place. gone: labels of the dense points that are no longer there,
    those of the instances among them.
    """
    from scipy.spatial import cKDTree

    cameras, surface = measured.cameras, Remains.of(measured, gone)
    stayed = stays(before, after, instances)
    rest = select(before, stayed)
    shown, uncovered = np.zeros(len(before), np.float32), np.zeros(len(rest), np.float32)
    for view, name in enumerate(cameras.names):
        progress(view + 1, len(cameras), name)
        whole = camera_of(cameras, view)
        camera = whole.scaled(*size_within(_MOST_PIXELS, whole.width, whole.height))
        left = render(before, camera, label_ids=instances).label_masks.sum(axis=0) >= SHOWS
        np.maximum(shown, _weights(before, camera, ~left), out=shown)
        if left.any():
            np.maximum(uncovered, _weights(rest, camera, left), out=uncovered)
    distance, nearest = cKDTree(surface.points.points[surface.rows]).query(rest.means, workers=1)
    grown = np.where(distance <= surface.points.spacing[surface.rows][nearest], _GROWN_ON_SURFACE, _GROWN)
    goes = np.zeros(len(after), bool)
    goes[stays(after, before, instances)] = (uncovered > grown * shown[stayed]) & (rest.filled == 0)
    return select(after, ~goes)


def _weights(scene: EditedScene, camera: Camera, pixels: Bool) -> Float32:
    """[N] the weight of each Gaussian in some pixels [H, W] of a view."""
    found = shares(scene, camera, np.where(pixels, 0, -1).astype(np.int32))
    weights = np.zeros(len(scene), np.float32)
    weights[found.row] = found.weight
    return weights
