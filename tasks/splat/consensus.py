"""What the masks and the depth of all views say together about the pixels of one (cf. space carving)."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ss_flow.tasks.artifacts import Bool, Float32, InstanceMasks, Int32
from ss_flow.tasks.gaussians.views import IGNORED, NONE_OF_MINE, SceneViews, sample_depth
from ss_flow.tasks.geometry.cameras import backproject

REACH = 8
"""Pixels of the photo on either side of a mask's border in which the other views are asked."""
MOST_VIEWS = 12
"""Views that are asked about another one, evenly spread."""


def agreed(scene: SceneViews, instance: InstanceMasks, share: float) -> Iterator[Int32]:
    """The masks of an instance, less the pixels near their borders about which most other views say otherwise.

    A pixel's surface point, where its depth is known, is looked up in the other views that have a mask. Those that see
    it (Split&Splat, Eq. 2) vote, the pixel's own view among them: at least three, and a pixel on the wrong side of its
    mask's border for less than `share` of them is neither inside nor outside.

    scene: at least the views that have a mask. Yields, for each of these, the channels [H, W] that `group_view` takes.
    """
    row = {frame.name: i for i, frame in enumerate(scene.frames)}
    views, masks = [row[name] for name in instance.views], instance.dense()
    asked = views[:: -(-len(views) // MOST_VIEWS)], masks[:: -(-len(views) // MOST_VIEWS)]
    for view, mask in zip(views, masks, strict=True):
        channels = np.where(mask, 0, NONE_OF_MINE).astype(np.int32)
        y, x = np.nonzero(_border(mask))
        if len(y):
            points = _points(scene, view, y, x)
            known = points[:, 0] == points[:, 0]
            votes, held = _votes(scene, points[known], [(u, m) for u, m in zip(*asked, strict=True) if u != view])
            own = mask[y[known], x[known]]
            same = np.where(own, held, votes - held) + 1
            doubtful = (votes >= 2) & (same < share * (votes + 1))
            channels[y[known][doubtful], x[known][doubtful]] = IGNORED
        yield channels


def _border(mask: Bool) -> Bool:
    """[H, W] the pixels within reach of a mask's border."""
    import cv2

    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * REACH + 1, 2 * REACH + 1))
    image = mask.astype(np.uint8)
    return np.asarray(cv2.dilate(image, disc) > cv2.erode(image, disc, borderValue=1))


def _points(scene: SceneViews, view: int, row: Int32, column: Int32) -> Float32:
    """[N, 3] the surface points of pixels, world; NaN where no depth is known."""
    camera = scene.cameras[view]
    box = camera.cropped(int(column.min()), int(row.min()), int(column.max()) + 1, int(row.max()) + 1)
    depth = sample_depth(scene.depths[view], camera, box)
    points = backproject(np.where(depth > 0, depth, np.nan), box).reshape(*depth.shape, 3)
    return points[row - row.min(), column - column.min()].astype(np.float32)


def _votes(scene: SceneViews, points: Float32, others: list[tuple[int, Bool]]) -> tuple[Int32, Int32]:
    """[N] how many other views see each point, and how many of these have it in their mask."""
    seen, held = np.zeros(len(points), np.int32), np.zeros(len(points), np.int32)
    for view, mask in others:
        rows, column, row, _ = scene.surface_points(view, points)
        seen[rows] += 1
        held[rows] += mask[row, column]
    return seen, held
