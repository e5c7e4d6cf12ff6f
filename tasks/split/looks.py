"""What the views see at places of the scene, by the points that they see."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ss_flow.running import in_threads
from ss_flow.tasks.artifacts import Cameras, Float64, PointCloud, Visibility
from ss_flow.tasks.geometry.cameras import camera_of, pixels_in_view

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

_NEAR = 1.5
"""Distance from a line of sight up to which a point is what is seen there, in spacings; at least so many pixels."""


@dataclass(frozen=True)
class Looks:
    """A cloud, and how all views see it."""

    cloud: PointCloud
    cameras: Cameras
    visibility: Sequence[Visibility]

    def at(self, view: int, places: Float64) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Which of some places [P, 3] lie in a view's picture, and the point of the cloud that it sees there, at the
        place or before or behind it; -1 where it sees none."""
        camera, visible = camera_of(self.cameras, view), self.visibility[view]
        place, column, row, z = pixels_in_view(places, camera)
        point = np.full(len(place), -1, np.intp)
        if len(place) and len(visible.pixel):
            distance, nearest = self._pixels[view].query(np.stack([row, column], axis=1))
            found = visible.point_index[nearest]
            here = distance <= np.maximum(_NEAR * self.cloud.spacing[found] * camera.fx / z, _NEAR)
            point[here] = found[here]
        return place.astype(np.intp), point

    @functools.cached_property
    def _pixels(self) -> list[cKDTree]:
        """Of each view: row and column of the pixels at which it sees its points, to be searched."""
        from scipy.spatial import cKDTree

        pixels = (np.stack(np.divmod(v.pixel, v.width), axis=1) for v in self.visibility)
        return list(in_threads(cKDTree, pixels))
