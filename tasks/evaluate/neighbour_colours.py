"""The colours that a view's photo is likely to have, by the photos beside it and by how bright a rendering is there.

Where exposure changes, a scene is trained in the colours of one photo. To show it as a camera would have taken it from
elsewhere on its way, colours go through a map between those of the photos before and after. A camera that meters the
light takes a bright view darker than its neighbours, and by how much is told by the photos that were trained on. No
pixel of the view's own photo is looked at.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from ss_flow.tasks.artifacts import ColourTransform, Float32, Float64, Gaussians
from ss_flow.tasks.capture.names import natural_key
from ss_flow.tasks.geometry.cameras import Camera
from ss_flow.tasks.geometry.images import size_within

_SIDE = 96
"""Longer side of the renderings whose brightness is measured."""
_PRIOR = 0.01
"""Squared logarithms of brightness that speak for no metering, besides those of the views."""


@dataclass(frozen=True)
class NeighbourColours:
    """What trained views tell of the colours of others."""

    names: tuple[str, ...]
    """Of the trained views."""
    to_photo: Float64
    """[K, 3, 4] affine, from RGB of the scene to RGB of each photo."""
    brightness: Float64
    """[K] logarithm of the mean of the scene, rendered there."""
    metering: float
    """By how much the logarithm of a photo's gain rises with a brightness above its neighbours'; usually negative."""

    @classmethod
    def of(cls, scene: Gaussians, cameras: Sequence[Camera], colours: Sequence[ColourTransform]) -> NeighbourColours:
        """cameras, colours: of the trained views, one each."""
        names = tuple(one.name for one in colours)
        matrices = np.stack([np.vstack([one.matrix, [0, 0, 0, 1]]) for one in colours])
        to_photo = np.linalg.inv(matrices)[:, :3]
        brightness = np.array([_brightness(scene, camera) for camera in cameras])
        gains = np.log(np.maximum(to_photo[:, :, :3].sum(axis=2).mean(axis=1), 1e-3))
        brighter, more = np.zeros(len(names)), np.zeros(len(names))
        for row in range(len(names)) if len(names) > 1 else ():
            share = _shares(names[row], names, apart=row)
            brighter[row], more[row] = brightness[row] - share @ brightness, gains[row] - share @ gains
        return cls(names, to_photo, brightness, float(brighter @ more / (brighter @ brighter + _PRIOR)))

    def applied(self, image: Float32, name: str, scene: Gaussians, camera: Camera) -> Float32:
        """A rendering [H, W, 3] of the scene from a camera as the photo `name` is likely to look, 0..1."""
        share = _shares(name, self.names)
        matrix = np.tensordot(share, self.to_photo, axes=1)
        matrix *= np.exp(self.metering * (_brightness(scene, camera) - share @ self.brightness))
        return np.clip(image @ matrix[:, :3].T + matrix[:, 3], 0, 1).astype(np.float32)


def _shares(name: str, names: Iterable[str], apart: int = -1) -> Float64:
    """[K] weights of the views that come before and after a name in natural order, half each; 1 for one at an end.

    apart: row of a view that is left out.
    """
    rows = sorted((natural_key(other), row) for row, other in enumerate(names) if row != apart)
    later = next((i for i, (key, _) in enumerate(rows) if key > natural_key(name)), len(rows))
    beside = [row for _, row in rows[max(later - 1, 0) : later + 1]]
    shares = np.zeros(len(rows) + (apart >= 0))
    shares[beside] = 1 / len(beside)
    return shares


def _brightness(scene: Gaussians, camera: Camera) -> float:
    from ss_flow.tasks.gaussians.render import render

    small = camera.scaled(*size_within(_SIDE, camera.width, camera.height))
    return float(np.log(np.clip(render(scene, small).rgb, 0, 1).mean() + 1e-3))
