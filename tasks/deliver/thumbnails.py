"""A small picture of each object: cut out of the view that shows most of it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ss_flow.task import task
from ss_flow.tasks.artifacts import Frame, LabelMap, UInt8
from ss_flow.tasks.deliver.compressed import Thumbnail, compressed
from ss_flow.tasks.geometry.images import decode_rgb
from ss_flow.tasks.packed import bounds

_SIDE = 128
_MARGIN = 0.15
"""Share of the object's longer side that is shown around it."""
_DIMMED = 0.3
"""Brightness that the surroundings keep, towards white."""


@task()
def thumbnails(frames: Sequence[Frame], maps: Sequence[LabelMap], *, turns: int = 0) -> tuple[Thumbnail, ...]:
    """A square picture [128, 128, 3] of each instance that a view shows, its surroundings faded; by rising id.

    frames, maps: of all views, in one order. Each photo is decoded once. turns: by how many quarters, counterclockwise,
    pictures are turned to stand upright.
    """
    filled: dict[int, int] = {}
    best: dict[int, tuple[int, int]] = {}
    """Pixels and view of each instance; the first of equals."""
    pixels_of_all = 0
    for view, one in enumerate(maps):
        pixels_of_all += one.ids.size
        for instance, pixels in zip(*(x.tolist() for x in np.unique(one.ids, return_counts=True)), strict=True):
            filled[instance] = filled.get(instance, 0) + pixels
            if instance and pixels > best.get(instance, (0, 0))[0]:
                best[instance] = pixels, view
    shown: dict[int, list[int]] = {}
    for instance in sorted(best):
        shown.setdefault(best[instance][1], []).append(instance)
    found = []
    for view, instances in shown.items():
        photo, ids = decode_rgb(frames[view]), maps[view].ids
        for instance in instances:
            picture = compressed(np.rot90(_cut_out(photo, ids == instance), turns))
            found.append(Thumbnail(instance, filled[instance] / pixels_of_all, picture))
    return tuple(sorted(found, key=lambda one: one.instance_id))


def _cut_out(photo: UInt8, mask: np.ndarray) -> UInt8:
    import cv2

    x0, y0, x1, y1 = bounds(mask)
    side = int(max(x1 - x0, y1 - y0) * (1 + 2 * _MARGIN)) + 2
    top, left = (y0 + y1 - side) // 2, (x0 + x1 - side) // 2
    down = np.clip(np.arange(top, top + side), 0, photo.shape[0] - 1)
    across = np.clip(np.arange(left, left + side), 0, photo.shape[1] - 1)
    inside = np.outer(down == np.arange(top, top + side), across == np.arange(left, left + side))
    square, shown = photo[np.ix_(down, across)], mask[np.ix_(down, across)] & inside
    faded = 255 - _DIMMED * (255 - square.astype(np.float32))
    picture = np.where(shown[..., None], square, faded)
    picture[~inside] = 255
    way = cv2.INTER_AREA if side > _SIDE else cv2.INTER_CUBIC
    return np.clip(np.rint(cv2.resize(picture, (_SIDE, _SIDE), interpolation=way)), 0, 255).astype(np.uint8)
