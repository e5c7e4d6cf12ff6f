"""What the masks and the depth of all views say together: about the pixels of one, and about points without a label.

Beyond Split&Splat.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ss_flow.tasks.artifacts import Bool, Float32, InstanceMasks, Int32, UInt8
from ss_flow.tasks.gaussians.views import IGNORED, NONE_OF_MINE, SceneViews
from ss_flow.tasks.geometry.cameras import surface_of_pixels
from ss_flow.tasks.geometry.clustering import dbscan, nearest_spacing
from ss_flow.tasks.geometry.fusion import depth_at
from ss_flow.tasks.geometry.images import shared_rgb
from ss_flow.tasks.geometry.sampling import first_of_each_cube
from ss_flow.tasks.packed import bounds

_Rows = NDArray[np.intp]

REACH = 8
"""Pixels of the photo on either side of a mask's border in which the other views are asked."""
MOST_VIEWS = 12
"""Views that are asked about another one, evenly spread."""
BEYOND = 2.0
"""A surface is missing where it lies farther than so many spacings from all labelled points."""
CONNECTED = 3.0
"""Spacings from one point to the next of one surface."""
LEAST_VIEWS = 4
"""Views whose masks hold a missing point, its own among them."""
STRIDE = 2
"""Every second row and column of a mask is looked at for missing points."""


def agreed(scene: SceneViews, instance: InstanceMasks, share: float) -> Iterator[Int32]:
    """The masks of an instance, less the pixels near their borders about which most other views say otherwise.

    A pixel's surface point, where its depth is known, is looked up in the other views that have a mask. Those that see
    it (Split&Splat, Eq. 2) vote, the pixel's own view among them: at least three, and a pixel on the wrong side of its
    mask's border for less than `share` of them is neither inside nor outside.

    scene: at least the views that have a mask. Yields, for each of these, the channels [H, W] that `group_view` takes.
    """
    for view, mask, others in _views(scene, instance):
        channels = np.where(mask, 0, NONE_OF_MINE).astype(np.int32)
        y, x = np.nonzero(_border(mask))
        if len(y):
            y, x, points = _surface(scene, view, y, x)
            votes, held = _votes(scene, points, others)
            same = np.where(mask[y, x], held, votes - held) + 1
            doubtful = (votes >= 2) & (same < share * (votes + 1))
            channels[y[doubtful], x[doubtful]] = IGNORED
        yield channels


def completed(scene: SceneViews, instance: InstanceMasks, share: float) -> InstanceMasks:
    """The instance with points where its masks hold a surface that has no labelled point: thin legs, mostly, which the
    borders of the masks hide from the vote on labels.

    A point joins when the masks of at least four views hold it, and those of at least `share` of the views that see
    it, and when other points lead from it to the labelled ones: what is apart is another thing. One joins for each cube
    of the points' spacing, the first; its confidence is that share.
    """
    from scipy.spatial import cKDTree

    if not (spacing := nearest_spacing(instance.points)):
        return instance
    tree = cKDTree(instance.points)
    found: list[tuple[Float32, UInt8, Float32]] = []
    for view, mask, others in _views(scene, instance):
        y, x = np.nonzero(mask[::STRIDE, ::STRIDE])
        y, x, points = _surface(scene, view, STRIDE * y, STRIDE * x)
        distance, _ = tree.query(points, distance_upper_bound=BEYOND * spacing, workers=1)
        far = np.flatnonzero(np.isinf(distance))
        if not len(far):
            continue
        votes, held = _votes(scene, points[far], others)
        joins = (held + 1 >= LEAST_VIEWS) & (held + 1 >= share * (votes + 1))
        if joins.any():
            rows = far[joins]
            colors = shared_rgb(scene.frames[view])[y[rows], x[rows]]
            found.append((points[rows], colors, ((held + 1) / (votes + 1))[joins].astype(np.float32)))
    if not found:
        return instance
    points, colors, confidence = (np.concatenate(arrays) for arrays in zip(*found, strict=True))
    first = first_of_each_cube(points, spacing)
    together = dbscan(np.concatenate([instance.points, points[first]]), CONNECTED * spacing, 1)
    own, added = np.split(together, [len(instance.points)])
    first = first[np.isin(added, own)]
    return replace(
        instance,
        points=np.concatenate([instance.points, points[first]]),
        colors=np.concatenate([instance.colors, colors[first]]),
        point_confidence=np.concatenate([instance.point_confidence, confidence[first]]),
        point_part=np.concatenate([instance.point_part, np.zeros(len(first), np.int32)]),
    )


def _views(scene: SceneViews, instance: InstanceMasks) -> Iterator[tuple[int, Bool, list[tuple[int, Bool]]]]:
    """Each view with a mask: its row, the mask, and rows and masks of the views that are asked about it."""
    row_of = scene.row_of()
    views = [row_of[name] for name in instance.views]
    asked = [(views[k], instance.mask(k)) for k in range(0, len(views), -(-len(views) // MOST_VIEWS))]
    for k, view in enumerate(views):
        yield view, instance.mask(k), [(other, held) for other, held in asked if other != view]


def _border(mask: Bool) -> Bool:
    """[H, W] the pixels within reach of a mask's border."""
    import cv2

    border = np.zeros_like(mask)
    if mask.any():
        x0, y0, x1, y1 = bounds(mask)
        box = (slice(max(y0 - REACH, 0), y1 + REACH), slice(max(x0 - REACH, 0), x1 + REACH))
        disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * REACH + 1, 2 * REACH + 1))
        image = mask[box].astype(np.uint8)
        border[box] = cv2.dilate(image, disc) > cv2.erode(image, disc, borderValue=1)
    return border


def _surface(scene: SceneViews, view: int, row: _Rows, column: _Rows) -> tuple[_Rows, _Rows, Float32]:
    """Those of some pixels of a view whose depth is known, rows and columns, and their surface points [N, 3], world."""
    camera = scene.cameras[view]
    depth = depth_at(scene.depths[view], column, row, camera.width, camera.height)
    known = depth > 0
    points = surface_of_pixels(column[known], row[known], depth[known], camera)
    return row[known], column[known], points.astype(np.float32)


def _votes(scene: SceneViews, points: Float32, others: list[tuple[int, Bool]]) -> tuple[Int32, Int32]:
    """[N] how many other views see each point, and how many of these have it in their mask."""
    seen, held = np.zeros(len(points), np.int32), np.zeros(len(points), np.int32)
    for view, mask in others:
        rows, column, row, _ = scene.surface_points(view, points)
        seen[rows] += 1
        held[rows] += mask[row, column]
    return seen, held
