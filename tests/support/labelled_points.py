"""Labels of points, as if no mask had given them, and a camera for what needs no picture."""

from __future__ import annotations

import numpy as np

from ss_flow.tasks.artifacts import Cameras, PointLabels


def labels_of(label, num_labels: int | None = None) -> PointLabels:
    """Points with these labels [N], sure of them; the highest label is the highest id ever given, if none is told."""
    label, none = np.asarray(label, np.int32), np.zeros(0, np.int32)
    highest = int(label.max(initial=0)) if num_labels is None else num_labels
    return PointLabels(label, np.ones(len(label), np.float32), highest, none, none, none)


def one_camera(pose: np.ndarray) -> Cameras:
    """The only one; pose: [4, 4] world to camera."""
    return Cameras(("a",), np.array([[8, 8]], np.int32), np.array([[8.0, 8, 4, 4]]), pose[None], True)


def lying(width: float, depth: float, height: float = 0.0, step: float = 0.01) -> np.ndarray:
    """[N, 3] points of a level rectangle about the z axis."""
    x, y = np.meshgrid(np.arange(-width / 2, width / 2, step), np.arange(-depth / 2, depth / 2, step))
    return np.stack([x.ravel(), y.ravel(), np.full(x.size, height)], axis=1)
