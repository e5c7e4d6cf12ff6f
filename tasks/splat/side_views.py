"""What the instances of a scene should cover from where no photo was taken. Beyond Split&Splat."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from ss_flow.running import in_threads
from ss_flow.tasks.artifacts import Bool, Float32, Gaussians, LabelMap
from ss_flow.tasks.gaussians.initialise import neighbour_spread
from ss_flow.tasks.gaussians.native_pass import NEAR_PLANE
from ss_flow.tasks.gaussians.objective import Target
from ss_flow.tasks.gaussians.trainer import PartView
from ss_flow.tasks.gaussians.views import SceneViews
from ss_flow.tasks.geometry.cameras import Camera, looking, pixels_in_view, surface_of_pixels
from ss_flow.tasks.geometry.fusion import depth_at
from ss_flow.tasks.geometry.images import at_diagonal, resampled
from ss_flow.tasks.geometry.sampling import cube_of_each, sphere

FEWEST = 20
"""Gaussians from which an instance has a shape."""
MOST_PIXELS = 96
"""Side of a view, if its pixels need not be smaller than half a spacing."""
GAP = 2.5
"""Spacings between points that still belong to one surface: narrower gaps are closed."""
RIM = 0.2
"""Spacings by which the surface goes on beyond its last points."""
TRIM = 0.05
"""Share of the points at either end of each axis that do not tell where an instance is: some carry a wrong label."""
GROWN = 1.3
"""How much larger than the box of the others what is looked at may be."""
SURFACE_PIXELS = 2_000_000
"""Pixels of all views together whose surface points are looked at."""
LEAST_KNOWN = 0.9
"""Share of an instance's pixels whose depth is known from which its surface is."""
LEAST_NEARBY = 0.95
"""The same share where depth that is known nearby counts too."""
NEARBY = 2.0
"""Pixels of an image with a diagonal of 800 within which a known depth of the same instance makes up for an unknown
one: sensors lose single pixels and strips along edges, beside which the surface has points."""
EDGE = 4.0
"""Pixels of an image with a diagonal of 800 behind an edge of the depth in which a pixel says nothing: masks are as
coarse there, and what is far behind a thing is not its surface."""
JUMP = 0.03
"""Share of the depth by which the far side of such an edge is farther."""
CLEAR = 0.3
"""Spacings before a surface from which a place is empty."""
CORE = 0.01
"""Share of the points at either end of each axis that lie beyond the box in which places may be hidden."""
MOST_PLACES = 50_000
"""Places of an instance that are looked at: where there would be more, they are farther apart."""
LEAST_SHARE = 1 / 3
"""Share of a cube's pixels that show an instance from which the cube may be its surface."""


def side_views(views: SceneViews, scene: Gaussians, masks: Sequence[LabelMap], count: int, most: int) -> list[PartView]:
    """For each instance but the background, views of it alone from directions all over the sphere, from below too.

    Photos do not tell what they cannot see: Gaussians grow into the floor below a thing, or off its surface along the
    line of sight. But the surface is known, as points: the centres of the Gaussians that come from the labelled points,
    and the surface points of the pixels that show the instance. Alpha is to be 0 where no point is near; what lies
    nearer than a fifth of a spacing, and gaps between points, count for nothing. Nor does what no photo sees through,
    inside the box of the points: there the instance may go on. Where the depth of an instance is unknown in more than a
    tenth of its pixels, and in more than a twentieth around these too, points do not tell where it ends: it has no such
    views.

    scene: ordered by instance, not yet trained together. masks: exclusive label maps of all views. count: views of each
    instance; where these are more than `most` in all, an equal share of `most`, rounded up. Returns targets whose alpha
    counts alone.
    """
    own = {int(i): scene.means[scene.instance_id == i] for i in np.unique(scene.instance_id) if i}
    spacings = {i: float(np.median(neighbour_spread(centres))) for i, centres in own.items() if len(centres) >= FEWEST}
    if not spacings:
        return []
    surfaces = shown_surfaces(views, masks, float(np.median(list(spacings.values()))))
    shaped = sorted(spacings.keys() & surfaces.keys())

    def around(instance: int) -> list[PartView]:
        start = int(np.searchsorted(scene.instance_id, instance))
        stop = start + len(own[instance])
        spacing = spacings[instance]
        points = np.concatenate([own[instance], surfaces[instance], hidden(views, own[instance], spacing)])
        cameras = cameras_around(points, spacing, min(count, -(-most // len(shaped))))
        return [PartView(start, stop, _target(camera, empty(camera, points, spacing))) for camera in cameras]

    return list(itertools.chain.from_iterable(in_threads(around, shaped)))


def hidden(views: SceneViews, points: Float32, spacing: float) -> Float32:
    """Places inside the box of an instance's points that no view sees through, [N, 3] world, on a grid at least a
    spacing wide: inside of things, behind them, and between those that stand close together."""
    low, high = np.quantile(points.astype(np.float64), (CORE, 1 - CORE), axis=0)
    side = max(spacing, float((high - low).max()) / MOST_PLACES)  # centres may lie one upon the other
    while np.prod(counts := np.maximum(np.ceil((high - low) / side), 1)) > MOST_PLACES:
        side *= 1.1
    axes = (a + (np.arange(n) + 0.5) * (b - a) / n for a, b, n in zip(low, high, counts.astype(int), strict=True))
    places = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    for camera, depth in zip(views.cameras, views.depths, strict=True):
        rows, column, row, z = pixels_in_view(places, camera)
        through = depth_at(depth, column, row, camera.width, camera.height) > z + CLEAR * spacing
        places = np.delete(places, rows[through], axis=0)
    return places.astype(np.float32)


def shown_surfaces(views: SceneViews, masks: Sequence[LabelMap], side: float) -> dict[int, Float32]:
    """By instance: surface points of pixels that show it, [N, 3] world, one for each cube of space a good part of whose
    pixels, of all views, do so. Instances with too many pixels where no depth is known nearby are left out.

    side: of the cubes, world units.
    """
    every = max(1, round(np.sqrt(sum(m.ids.size for m in masks) / SURFACE_PIXELS)))
    places: list[Float32] = []
    shown_there: list[NDArray[np.uint16]] = []
    area = np.zeros(np.iinfo(np.uint16).max + 1, np.int64)
    known, nearby = np.zeros_like(area), np.zeros_like(area)
    for camera, depth, shown in zip(views.cameras, views.depths, masks, strict=True):
        z = resampled(depth.depth, *shown.ids.shape)
        area += np.bincount(shown.ids.ravel(), minlength=len(area))
        known += np.bincount(shown.ids[z > 0], minlength=len(area))
        nearby += np.bincount(shown.ids[_known_nearby(z > 0, shown.ids)], minlength=len(area))
        z = np.where(_behind_edges(z), 0, z)
        z, ids = z[::every, ::every], shown.ids[::every, ::every]
        row, column = np.nonzero(z > 0)
        surface = surface_of_pixels(every * column, every * row, z[row, column], camera)
        places.append(surface.astype(np.float32))
        shown_there.append(ids[row, column])
    points, ids = np.concatenate(places), np.concatenate(shown_there)
    del places, shown_there
    if not len(points):
        return {}
    most = int(ids.max()) + 1
    pair, first, held = np.unique(cube_of_each(points, side) * most + ids, return_index=True, return_counts=True)
    _, cube = np.unique(pair // most, return_inverse=True)
    good = (held >= 2) & (held >= LEAST_SHARE * np.bincount(cube, held)[cube])
    pair, first = pair[good] % most, first[good]
    shaped = (known >= LEAST_KNOWN * area) | (nearby >= LEAST_NEARBY * area)
    return {int(i): points[first[pair == i]] for i in np.unique(pair) if shaped[i]}


def _behind_edges(z: Float32) -> Bool:
    """[H, W] where a much nearer surface is beside the pixel."""
    import cv2

    reach = round(at_diagonal(EDGE, *z.shape))
    near = np.where(z > 0, z, np.inf).astype(np.float32)
    return np.asarray(z / (1 + JUMP) > cv2.erode(near, np.ones((2 * reach + 1,) * 2, np.uint8)))


def _known_nearby(known: Bool, ids: NDArray[np.uint16]) -> Bool:
    """[H, W] where a pixel of the same instance has a known depth, NEARBY at most away."""
    reach = int(np.ceil(at_diagonal(NEARBY, *known.shape)))
    shows = np.pad(np.where(known, ids.astype(np.int32), -1), reach, constant_values=-1)
    row, column = np.nonzero(~known)
    own, found = ids[row, column], np.zeros(len(row), bool)
    steps = np.arange(-reach, reach + 1)
    for down, right in ((y, x) for y in steps for x in steps if np.hypot(y, x) <= reach):
        found |= shows[row + reach + down, column + reach + right] == own
    nearby = known.copy()
    nearby[row, column] = found
    return nearby


def cameras_around(points: Float32, spacing: float, count: int) -> Iterator[Camera]:
    """Cameras that show points whole from directions evenly spread over the sphere, at twice the diagonal of their box
    and no nearer than what is drawn, with pixels of half a spacing where that needs no more than MOST_PIXELS.

    Points far off from most others stay outside: with them, a bowl of which a piece of the table has the label would be
    a few pixels wide.
    """
    low, high = np.quantile(points.astype(np.float64), (TRIM, 1 - TRIM), axis=0)
    middle = (low + high) / 2
    farthest = np.linalg.norm(np.abs(points - middle).max(axis=0))
    radius = min(GROWN * np.linalg.norm(high - low) / 2, farthest) + GAP * spacing
    size = int(np.clip(np.ceil(4 * radius / spacing), 16, MOST_PIXELS))
    away = max(4.0, 1 + NEAR_PLANE / float(radius))  # radii; of what is tiny, none of it before the nearest depth
    focal = size / 2 * np.sqrt(away**2 - 1)  # a sphere seen from there
    for direction in sphere(count):
        pose = looking(middle + away * radius * direction, -direction, np.array([0.0, 0.0, 1.0]))
        yield Camera(size, size, focal, focal, size / 2, size / 2, pose)


def empty(camera: Camera, points: Float32, spacing: float) -> Bool:
    """[h, w] the pixels that lie wholly beyond the outline of points.

    The outline is that of the discs of radius GAP about the points, less GAP - RIM (both in spacings): gaps narrower
    than twice GAP close, and the rim stays narrow.
    """
    import cv2

    fine = camera.scaled(2 * camera.width, 2 * camera.height)
    _, column, row, z = pixels_in_view(points, fine)
    pixels = spacing * fine.fx / float(z.mean())
    border = int(np.ceil(GAP * pixels)) + 1  # what lies outside of the picture is empty, too
    free = np.pad(np.ones((fine.height, fine.width), np.uint8), border, constant_values=1)
    free[row + border, column + border] = 0
    away = cv2.distanceTransform(free, cv2.DIST_L2, 5) > GAP * pixels
    back = cv2.distanceTransform((~away).astype(np.uint8), cv2.DIST_L2, 5) <= (GAP - RIM) * pixels
    inner = back[border:-border, border:-border]
    rows = inner[::2] & inner[1::2]
    return np.asarray(rows[:, ::2] & rows[:, 1::2])


def _target(camera: Camera, free: Bool) -> Target:
    """Alpha towards 0 where nothing is; all that does not count is shared by all views."""
    blank, ones, image = _blank(camera.height, camera.width)
    judged = (free / free.size).astype(np.float32)
    return Target(camera, image, blank, blank, judged, ones, blank, None, None)


@functools.lru_cache(maxsize=MOST_PIXELS)
def _blank(height: int, width: int) -> tuple[Float32, Float32, Float32]:
    blank = np.zeros((height, width), np.float32)
    return blank, np.ones_like(blank), np.zeros((height, width, 3), np.float32)
