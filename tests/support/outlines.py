"""Objects of a capture's photos, outlined by hand: the truth that benchmarks compare masks with."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from ss_flow.tasks.artifacts import Int32


@dataclass(frozen=True)
class Outlines:
    """Which object each pixel of some views shows."""

    views: dict[str, Int32]
    """By the frame's name: [H, W] number of the object, 0 where nothing is said."""
    names: dict[int, str]
    """Of the objects, by their number."""

    def at_size(self, view: str, height: int, width: int) -> Int32 | None:
        """The view's objects at the size of a frame of its photo, by the nearest pixel: [height, width]; None for a
        view without outlines."""
        ids = self.views.get(view)
        return None if ids is None else cv2.resize(ids, (width, height), interpolation=cv2.INTER_NEAREST)


def read_outlines(path: Path) -> Outlines:
    """Outlines as a folder of one-channel PNG files, named like the frames, or as a JSON file of polygons.

    The JSON file has the photos' `width` and `height` in pixels and `views`: frame name -> object name -> polygons,
    each a list of the pixels [x, y] on its border, which belong to the object. A polygon inside another one is a hole.
    Where borders of two objects share a pixel, it is the later one's. Only what the photo shows of an object is
    outlined.
    """
    if path.is_dir():
        views = {file.stem: cv2.imread(str(file), cv2.IMREAD_UNCHANGED).astype(np.int32) for file in path.glob("*.png")}
        return Outlines(views, {int(i): str(i) for ids in views.values() for i in np.unique(ids[ids > 0])})
    told = json.loads(path.read_text())
    numbers: dict[str, int] = {}
    views = {}
    for view, objects in told["views"].items():
        views[view] = np.zeros((told["height"], told["width"]), np.int32)
        for name, polygons in objects.items():
            number = numbers.setdefault(name, len(numbers) + 1)
            cv2.fillPoly(views[view], [np.array(polygon, np.int32) for polygon in polygons], number)
    return Outlines(views, {number: name for name, number in numbers.items()})
