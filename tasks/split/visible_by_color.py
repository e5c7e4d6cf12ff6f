"""Which dense points a view sees where it has no depth: those in front whose colour it shows. Beyond Split&Splat.

Sensors measure nothing on what is black, shiny or far away. Other views, from elsewhere or nearer, have points there.
"""

from __future__ import annotations

import math

import numpy as np

from ss_flow.task import task
from ss_flow.tasks.artifacts import (
    Bool,
    ColourTransform,
    DepthMap,
    Float32,
    Float64,
    Frame,
    Int32,
    PointCloud,
    UInt8,
    Visibility,
)
from ss_flow.tasks.geometry.cameras import Camera, pixels_in_view
from ss_flow.tasks.geometry.fusion import depth_at
from ss_flow.tasks.geometry.images import decode_valid, scene_rgb

_BEHIND = 0.02
"""Share of the depth by which a point may lie behind the nearest one around."""
_SPACINGS = 2.0
"""And so many spacings of the points."""


@task()
def visible_by_color(
    points: PointCloud,
    camera: Camera,
    depth: DepthMap,
    frame: Frame,
    seen: Visibility,
    colours: tuple[ColourTransform, ...] = (),
    *,
    color: float,
) -> Visibility:
    """What a view sees, with the points that fall where its depth is unknown and that it shows in their own colour.

    camera, depth, frame: of this view; seen: the points that it sees by its depth; colours: the photo's transform to
    the colours of the points, if any. A point counts when nothing that the view sees, or may see, lies in front of it,
    its pixel is valid, and the photo differs by less than `color` (CIELAB) from the point's colour there or at a pixel
    beside it. What is hidden behind a surface that the view does not measure still counts where both have one colour.
    """
    rows, column, row, z = pixels_in_view(points.points, camera)
    unknown = depth_at(depth, column, row, camera.width, camera.height) <= 0
    visible = np.zeros(len(points.points), bool)
    visible[seen.point_index] = True
    front = _in_front(points, camera, (rows, column, row, z), unknown | visible[rows])
    asked = unknown & front & decode_valid(frame)[row, column]
    if not asked.any():
        return seen
    rows, column, row, z = rows[asked], column[asked], row[asked], z[asked]
    shown = _differences(scene_rgb(frame, *colours), column, row, points.colors[rows]) < color
    found = np.concatenate([seen.point_index, rows[shown]])
    order = np.argsort(found, kind="stable")
    pixel = (row * camera.width + column)[shown].astype(np.int32)
    return Visibility(
        name=seen.name,
        point_index=found[order],
        pixel=np.concatenate([seen.pixel, pixel])[order],
        depth=np.concatenate([seen.depth, z[shown].astype(np.float32)])[order],
        height=seen.height,
        width=seen.width,
    )


def _in_front(points: PointCloud, camera: Camera, at: tuple[Int32, Int32, Int32, Float64], counts: Bool) -> Bool:
    """[M] which points no other one hides; only those that `counts` [M] hide. at: their rows, pixel columns and rows,
    z-depths [M].

    A point hides what lies in its square of pixels and in those around, each as wide as the points lie apart.
    """
    import cv2

    own, column, row, z = at
    if not counts.any():
        return np.zeros(len(z), bool)
    side = max(1, math.ceil(points.spacing_of(own[counts]) * max(camera.fx, camera.fy) / float(np.median(z[counts]))))
    nearest = np.full((camera.height // side + 1, camera.width // side + 1), np.inf)
    np.minimum.at(nearest, (row[counts] // side, column[counts] // side), z[counts])
    around = cv2.erode(nearest, np.ones((3, 3), np.uint8))
    return np.asarray((z - _SPACINGS * points.spacing[own]) / (1 + _BEHIND) <= around[row // side, column // side])


def _differences(photo: UInt8, column: Int32, row: Int32, colors: UInt8) -> Float32:
    """[M] how far the photo [H, W, 3] is from the colours [M, 3] of points, in CIELAB: the least of the point's pixel
    and the eight around it."""
    import cv2

    lab = cv2.cvtColor(photo.astype(np.float32) / 255, cv2.COLOR_RGB2LAB)
    own = cv2.cvtColor(colors[None].astype(np.float32) / 255, cv2.COLOR_RGB2LAB)[0]
    least = np.full(len(colors), np.inf, np.float32)
    for down in (-1, 0, 1):
        for right in (-1, 0, 1):
            there = lab[np.clip(row + down, 0, len(lab) - 1), np.clip(column + right, 0, lab.shape[1] - 1)]
            least = np.minimum(least, np.linalg.norm(there - own, axis=1))
    return least
