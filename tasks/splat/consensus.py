"""What the masks and the depth of all views say together: about the pixels of one, and about points without a label.

Beyond Split&Splat.
"""

from __future__ import annotations

import ctypes
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ss_flow.tasks.artifacts import Bool, Float32, InstanceMasks, Int32, UInt8
from ss_flow.tasks.gaussians.library import VotingView, address, library
from ss_flow.tasks.gaussians.views import IGNORED, SceneViews, channels_of_mask
from ss_flow.tasks.geometry.cameras import project, surface_of_pixels
from ss_flow.tasks.geometry.clustering import dbscan, nearest_spacing
from ss_flow.tasks.geometry.fusion import depth_at
from ss_flow.tasks.geometry.images import pixels_under, shared_rgb
from ss_flow.tasks.geometry.sampling import first_of_each_cube
from ss_flow.tasks.packed import bounds

_Rows = NDArray[np.intp]

REACH = 8
"""Pixels of the photo on either side of a mask's border in which the other views are asked."""
MOST_VIEWS = 12
"""Views that are asked about another one, evenly spread."""
COARSEST = 4.0
"""Pixels of the photos from one point to the next, above which an instance gets more of them. A lawn takes most of the
scene's points, and a book on the table before it hardly any."""
COARSEST_TRAINED = 2.0
"""Pixels of whole photos as they are trained on, up to which it gets none either: they show nothing finer."""
BEYOND = 2.0
"""A surface is missing where it lies farther than so many spacings from all labelled points."""
CONNECTED = 3.0
"""Spacings from one point to the next of one surface."""
LEAST_VIEWS = 4
"""Views whose masks hold a missing point, its own among them."""
LEAST_VIEWS_APART = 3
"""The same for a piece of surface that no point leads to: most are legs whose upper ends nobody sees."""
LEAST_POINTS_APART = 10
"""Points of such a piece, one for each cube of the spacing; what is smaller is mostly a rim that masks hold."""
STRIDE = 2
"""Every second row and column of a mask is looked at for missing points."""
TOGETHER = 50_000
"""Points from which on views are not asked about those of one more view at once: a question takes a tenth of a
millisecond however few its points are, and memory for all of them."""


@dataclass(frozen=True)
class _Pixels:
    """Some pixels of a view whose depth is known, and the points of the surface there."""

    place: int
    """Of the view among those of the instance."""
    row: _Rows
    column: _Rows
    points: Float32
    """[N, 3] world."""


def agreed(scene: SceneViews, instance: InstanceMasks, share: float) -> Iterator[Int32]:
    """The masks of an instance, less the pixels near their borders about which most other views say otherwise.

    A pixel's surface point, where its depth is known, is looked up in the other views that have a mask. Those that see
    it (Split&Splat, Eq. 2) vote, the pixel's own view among them: at least three, and a pixel on the wrong side of its
    mask's border for less than `share` of them is neither inside nor outside.

    scene: at least the views that have a mask. Yields, for each of these, the channels [H, W] that `group_view` takes.
    """
    views = _views(scene, instance)
    near = (_surface(scene, views, k, *_border(instance.mask(k))) for k in range(len(views)))
    for some, votes, held in _votes(scene, instance, views, near):
        mask = instance.mask(some.place)
        channels = channels_of_mask(mask)
        same = np.where(mask[some.row, some.column], held, votes - held) + 1
        doubtful = (votes >= 2) & (same < share * (votes + 1))
        channels[some.row[doubtful], some.column[doubtful]] = IGNORED
        yield channels


def completed(scene: SceneViews, instance: InstanceMasks, share: float, *, max_side: int) -> InstanceMasks:
    """The instance with points where its masks hold a surface that has no labelled point: thin legs, mostly, which the
    borders of the masks hide from the vote on labels; and what lies between points that are far apart in the photos.

    A point joins when the masks of at least four views hold it, and those of at least `share` of the views that see
    it, and when other points lead from it to the labelled ones. What is apart is another thing, unless it lies inside
    the box around all of these, as a chair's leg does whose upper end the seat hides: a piece of at least ten points
    there joins, and for that the masks of three views are enough. One point joins for each cube of the points' spacing,
    or of a few pixels where that is less, the first; its confidence is that share, and its part that of the labelled
    point that it lies beside.

    max_side: longer side of the whole photos that are trained on, pixels.
    """
    from scipy.spatial import cKDTree

    if not (own_spacing := nearest_spacing(instance.points)):
        return instance
    views = _views(scene, instance)
    spacing = min(own_spacing, _a_few_pixels(scene, views, instance.points, max_side))
    tree = cKDTree(instance.points)
    found: list[tuple[Float32, UInt8, Float32, Bool]] = []

    def missing(place: int) -> _Pixels:
        row, column = np.nonzero(instance.mask(place)[::STRIDE, ::STRIDE])
        some = _surface(scene, views, place, STRIDE * row, STRIDE * column)
        distance, _ = tree.query(some.points, distance_upper_bound=BEYOND * spacing, workers=1)
        far = np.isinf(distance)
        return _Pixels(place, some.row[far], some.column[far], some.points[far])

    for some, votes, held in _votes(scene, instance, views, map(missing, range(len(views)))):
        joins = (held + 1 >= LEAST_VIEWS_APART) & (held + 1 >= share * (votes + 1))
        if joins.any():
            photo = shared_rgb(scene.frames[views[some.place]])
            colors = photo[some.row[joins], some.column[joins]]
            shares = ((held + 1) / (votes + 1))[joins].astype(np.float32)
            found.append((some.points[joins], colors, shares, (held + 1 >= LEAST_VIEWS)[joins]))
    if not found:
        return instance
    points, colors, confidence, widely = (np.concatenate(arrays) for arrays in zip(*found, strict=True))
    led_to = _led_to(instance.points, points, np.flatnonzero(widely), spacing)
    rows = np.concatenate([led_to, _pieces_inside(instance.points, points, led_to, spacing)])
    if not len(rows):
        return instance
    _, beside = tree.query(points[rows], distance_upper_bound=BEYOND * own_spacing, workers=1)
    return replace(
        instance,
        points=np.concatenate([instance.points, points[rows]]),
        colors=np.concatenate([instance.colors, colors[rows]]),
        point_confidence=np.concatenate([instance.point_confidence, confidence[rows]]),
        point_part=np.concatenate([instance.point_part, np.append(instance.point_part, np.int32(0))[beside]]),
    )


def _a_few_pixels(scene: SceneViews, views: list[int], points: Float32, max_side: int) -> float:
    """How far apart an instance's points may be, world units: the median over its views."""
    sides = []
    for camera in (scene.cameras[view] for view in views):
        pixels = max(COARSEST, COARSEST_TRAINED * max(camera.width, camera.height) / max_side)
        sides.append(pixels * np.median(project(points, camera)[1]) / camera.fx)
    return float(np.median(sides))


def _led_to(own: Float32, points: Float32, rows: _Rows, spacing: float) -> _Rows:
    """Those of some rows of `points`, one a cube, to which others lead from an instance's own points."""
    if not len(rows):
        return rows
    first = rows[first_of_each_cube(points[rows], spacing)]
    of_own, added = np.split(dbscan(np.concatenate([own, points[first]]), CONNECTED * spacing, 1), [len(own)])
    return first[np.isin(added, of_own)]


def _pieces_inside(own: Float32, points: Float32, led_to: _Rows, spacing: float) -> _Rows:
    """Rows of `points`, one a cube, of the pieces inside the box of an instance's own to which no other point leads."""
    own = np.concatenate([own, points[led_to]])
    inside = np.flatnonzero(((points >= own.min(axis=0)) & (points <= own.max(axis=0))).all(axis=1))
    if not len(inside):
        return inside
    first = inside[first_of_each_cube(points[inside], spacing)]
    together = dbscan(np.concatenate([own, points[first]]), CONNECTED * spacing, 1)
    of_own, piece = np.split(together, [len(own)])
    joins = np.bincount(piece, minlength=together.max() + 1) >= LEAST_POINTS_APART
    joins[of_own] = False
    return first[joins[piece]]


def _views(scene: SceneViews, instance: InstanceMasks) -> list[int]:
    """The scene's row of each view with a mask."""
    row_of = scene.row_of()
    return [row_of[name] for name in instance.views]


def _border(mask: Bool) -> tuple[_Rows, _Rows]:
    """Rows and columns of the pixels within reach of a mask's border."""
    import cv2

    x0, y0, x1, y1 = bounds(mask)
    top, left = max(y0 - REACH, 0), max(x0 - REACH, 0)
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * REACH + 1, 2 * REACH + 1))
    image = mask[top : y1 + REACH, left : x1 + REACH].astype(np.uint8)
    row, column = np.nonzero(cv2.dilate(image, disc) > cv2.erode(image, disc, borderValue=1))
    return top + row, left + column


def _surface(scene: SceneViews, views: list[int], place: int, row: _Rows, column: _Rows) -> _Pixels:
    """Those of some pixels of a view whose depth is known."""
    view = views[place]
    camera = scene.cameras[view]
    depth = depth_at(scene.depths[view], column, row, camera.width, camera.height)
    known = depth > 0
    points = surface_of_pixels(column[known], row[known], depth[known], camera)
    return _Pixels(place, row[known], column[known], points.astype(np.float32))


def _votes(
    scene: SceneViews, instance: InstanceMasks, views: list[int], of_views: Iterable[_Pixels]
) -> Iterator[tuple[_Pixels, Int32, Int32]]:
    """The pixels of each view, [N] how many other views see each one's point, and how many of these have it in their
    mask."""
    asked = [Voter(scene, views[k], instance.mask(k), k) for k in range(0, len(views), -(-len(views) // MOST_VIEWS))]
    for some in _some_together(of_views):
        sizes = [len(pixels.points) for pixels in some]
        points = np.concatenate([pixels.points for pixels in some])
        place = np.repeat(np.array([pixels.place for pixels in some], np.int32), sizes)
        seen, held = np.zeros(len(points), np.int32), np.zeros(len(points), np.int32)
        for voter in asked:
            voter.vote(points, place, seen, held)
        ends = np.cumsum(sizes)[:-1]
        yield from zip(some, np.split(seen, ends), np.split(held, ends), strict=True)


class Voter:
    """A view that is asked about points of a surface; the loop is in native/votes.cpp, beside the rasterizer."""

    def __init__(self, scene: SceneViews, view: int, mask: Bool, place: int) -> None:
        """place: of the view among those of the instance."""
        camera, depth, visibility = scene.cameras[view], scene.depths[view].depth, scene.visibility
        height, width = depth.shape
        rows, columns = pixels_under(camera.height, height), pixels_under(camera.width, width)
        self._arrays = np.ascontiguousarray(depth), mask, rows, columns  # the view below holds only their addresses
        self._view = VotingView(
            *(array.ctypes.data for array in self._arrays),
            camera.width,
            camera.height,
            width,
            place,
            camera.fx,
            camera.fy,
            camera.cx,
            camera.cy,
            (ctypes.c_double * 12)(*np.asarray(camera.world_to_camera, np.float64)[:3].ravel()),
            visibility.tau_depth * scene.unit.length,
            visibility.tau_depth * visibility.share_of_depth,
        )

    def vote(self, points: Float32, place: Int32, seen: Int32, held: Int32) -> None:
        """Count which points [N, 3] the view sees, as `surface_points` tells, and which of these its mask holds; none
        of its own. place: [N] of each point's view."""
        library().ss_vote(
            ctypes.byref(self._view), len(points), address(points), address(place), address(seen), address(held)
        )


def _some_together(of_views: Iterable[_Pixels]) -> Iterator[list[_Pixels]]:
    """The views one after the other, as many at once as their points allow."""
    some, count = list[_Pixels](), 0
    for pixels in of_views:
        some.append(pixels)
        count += len(pixels.points)
        if count >= TOGETHER:
            yield some
            some, count = [], 0
    if some:
        yield some
