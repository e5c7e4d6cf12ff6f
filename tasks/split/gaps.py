"""What lies or stands on a flat surface may part it into labels that touch nowhere. Beyond Split&Splat.

The pieces of a table top lie in one plane and have the same colours. So have two tables of a kind; but between these,
some view sees the floor. Where a view looks at the gap between two pieces of one table, it sees the table or what is on
it.
"""

from __future__ import annotations

import numpy as np

from ss_flow.tasks.artifacts import Bool, Float32, Float64, Int32
from ss_flow.tasks.geometry.shape import Plane
from ss_flow.tasks.split.looks import Looks

_FACING = 3.0
"""Spacings of the points by which a line across a gap may be longer than twice the shortest one."""
_LINES, _STEPS = 60, 9
"""Lines across a gap, at least so many where there are, and less than twice as many; and places on the middle half of
each: at its ends the two labels themselves are seen."""
_OFF = 1.5
"""Distance from the plane from which on a point is not on it, in multiples of the plane's thickness."""
_LOOKED_AT = 0.5
"""Share of the places that some view must look at."""
_PAST = 0.2
"""Share of the looks that may miss the surface: at the rim of a table some go past it."""


def bridged(
    looks: Looks, of: Int32, larger: int, smaller: int, plane: Plane, alike: Bool, *, thickness: float, longest: float
) -> bool:
    """Whether the views see only one surface, and what is on it, between two labels of one plane.

    of: [N] label of the cloud's points, 0 = none. plane: of both labels, with its normal towards the cameras. alike:
    [N] which points have the colour of both; others without a label, in the plane, say nothing. thickness: distance
    from the plane up to which points lie on it; longest: of a gap; both in world units.

    A look misses the surface that goes behind it, or meets in its plane a label with more points there than the smaller
    one has: that does not lie on the surface, but both in that, like two pages in a table.
    """
    cloud, own = looks.cloud, of == smaller
    places = _across(cloud.points[own], cloud.points[of == larger], cloud.spacing_of(own), longest)
    if not len(places):
        return False
    centre, normal = plane
    height = (cloud.points - centre) @ normal
    flat = np.abs(height) <= _OFF * thickness
    size = np.bincount(of[flat], minlength=int(of.max()) + 1)
    beyond = size > size[smaller]
    beyond[[0, larger, smaller]] = False
    misses = (height < -_OFF * thickness) | (flat & beyond[of])
    tells = (of > 0) | ~flat | alike
    count, missing = np.zeros(len(places), np.int64), 0
    for view in range(len(looks.visibility)):
        place, point = looks.at(view, places)
        told = (point >= 0) & tells[point]
        count[place[told]] += 1
        missing += int(misses[point[told]].sum())
    return bool((count > 0).mean() >= _LOOKED_AT and missing <= _PAST * count.sum())


def _across(some: Float32, others: Float32, spacing: float, longest: float) -> Float64:
    """[P, 3] places across the gap between two sets of points [N, 3], where it is narrow; none if it is too long."""
    from scipy.spatial import cKDTree

    distance, nearest = cKDTree(others).query(some)
    if distance.min() > longest:
        return np.zeros((0, 3))
    order = np.argsort(distance, kind="stable")
    facing = order[np.unique(nearest[order], return_index=True)[1]]  # the shortest line to each end
    facing = facing[distance[facing] <= 2 * distance.min() + _FACING * spacing]
    facing = facing[:: max(1, len(facing) // _LINES)]
    share = np.linspace(0.25, 0.75, _STEPS)[:, None]
    start, end = (places.astype(np.float64)[:, None] for places in (some[facing], others[nearest[facing]]))
    return (start + share * (end - start)).reshape(-1, 3)
