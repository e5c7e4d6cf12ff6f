"""What lies or stands on a flat surface may part it into labels that touch nowhere. Beyond Split&Splat.

The pieces of a table top lie in one plane and have the same colours. So have two tables of a kind; but between these,
some view sees the floor. Where a view looks at the gap between two pieces of one table, it sees the table or what is on
it.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ss_flow.tasks.artifacts import Bool, Cameras, Float64, Int32, PointCloud, Visibility
from ss_flow.tasks.geometry.cameras import camera_of, pixels_in_view
from ss_flow.tasks.geometry.shape import Plane

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

_FACING = 3.0
"""Spacings of the points by which a line across a gap may be longer than twice the shortest one."""
_LINES, _STEPS = 60, 9
"""Lines across a gap, at least so many where there are, and less than twice as many; and places on the middle half of
each: at its ends the two labels themselves are seen."""
_NEAR = 1.5
"""Distance from a line of sight up to which a point is what is seen there, in spacings; at least so many pixels."""
_OFF = 1.5
"""Distance from the plane from which on a point is not on it, in multiples of the plane's thickness."""
_LOOKED_AT = 0.5
"""Share of the places that some view must look at."""
_PAST = 0.2
"""Share of the looks that may miss the surface: at the rim of a table some go past it."""


@dataclass(frozen=True)
class Gaps:
    """The gaps between labels of a cloud, as its views see them."""

    cloud: PointCloud
    cameras: Cameras
    visibility: Sequence[Visibility]
    """Of all views."""

    def bridged(
        self, of: Int32, larger: int, smaller: int, plane: Plane, alike: Bool, *, thickness: float, longest: float
    ) -> bool:
        """Whether the views see only one surface, and what is on it, between two labels of one plane.

        of: [N] label of the cloud's points, 0 = none. plane: of both labels, with its normal towards the cameras.
        alike: [N] which points have the colour of both; others without a label, in the plane, say nothing. thickness:
        distance from the plane up to which points lie on it; longest: of a gap; both in world units.

        A look misses the surface that goes behind it, or meets in its plane a label with more points there than the
        smaller one has: that does not lie on the surface, but both in that, like two pages in a table.
        """
        places = self._across(of == larger, of == smaller, longest)
        if not len(places):
            return False
        centre, normal = plane
        height = (self.cloud.points - centre) @ normal
        flat = np.abs(height) <= _OFF * thickness
        size = np.bincount(of[flat], minlength=int(of.max()) + 1)
        beyond = size > size[smaller]
        beyond[[0, larger, smaller]] = False
        misses = (height < -_OFF * thickness) | (flat & beyond[of])
        tells = (of > 0) | ~flat | alike
        looks, missing = np.zeros(len(places), np.int64), 0
        for view in range(len(self.visibility)):
            place, point = self._looks(view, places)
            looks[place] += tells[point]
            missing += int((tells & misses)[point].sum())
        return bool((looks > 0).mean() >= _LOOKED_AT and missing <= _PAST * looks.sum())

    def _across(self, first: Bool, second: Bool, longest: float) -> Float64:
        """[P, 3] places across the gap between two sets of points [N], where it is narrow; none if it is too long."""
        from scipy.spatial import cKDTree

        ends, others = (self.cloud.points[rows].astype(np.float64) for rows in (second, first))
        distance, nearest = cKDTree(others).query(ends)
        if distance.min() > longest:
            return np.zeros((0, 3))
        order = np.argsort(distance, kind="stable")
        facing = order[np.unique(nearest[order], return_index=True)[1]]  # the shortest line to each end
        facing = facing[distance[facing] <= 2 * distance.min() + _FACING * self.cloud.spacing]
        facing = facing[:: max(1, len(facing) // _LINES)]
        share = np.linspace(0.25, 0.75, _STEPS)[:, None]
        start, end = ends[facing][:, None], others[nearest[facing]][:, None]
        return (start + share * (end - start)).reshape(-1, 3)

    def _looks(self, view: int, places: Float64) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Where a view looks at some places [P, 3]: which of them, and the point of the cloud that it sees there."""
        camera, visible = camera_of(self.cameras, view), self.visibility[view]
        place, column, row, z = pixels_in_view(places, camera)
        if not len(place) or not len(visible.pixel):
            return np.zeros(0, np.intp), np.zeros(0, np.intp)
        distance, nearest = self._pixels[view].query(np.stack([row, column], axis=1))
        here = distance <= np.maximum(_NEAR * self.cloud.spacing * camera.fx / z, _NEAR)
        return place[here].astype(np.intp), visible.point_index[nearest[here]].astype(np.intp)

    @functools.cached_property
    def _pixels(self) -> list[cKDTree]:
        """Of each view: row and column of the pixels at which it sees its points, to be searched."""
        from scipy.spatial import cKDTree

        return [cKDTree(np.stack(np.divmod(v.pixel, v.width), axis=1)) for v in self.visibility]
