"""A small scene to edit, and its instances.json."""

from __future__ import annotations

import numpy as np

from ss_flow.tasks.artifacts import EditedScene
from ss_flow.tasks.edit import operations
from ss_flow.tasks.gaussians.initialise import initialise


def entry(instance: int, name: str, *, points: int = 40, parts: tuple[int, ...] = (), parent: int | None = None):
    listed = [{"part_id": p, "num_points": n, "bbox": None, "centroid": None} for p, n in enumerate(parts, 1)]
    return {
        "id": instance, "name": name, "named_by": "colour words", "kind": "thing", "color": [1, 2, 3], "parent": parent,
        "parts": listed, "bbox": None, "centroid": None, "views": ["a", "b"], "confidence": 0.9,
        "num_parts": len(parts), "num_points": points, "num_gaussians": 0, "weak": False, "crumb": False, "file": None,
    }  # fmt: skip


DOCUMENT = {
    "version": 1,
    "background_id": 0,
    "num_crumbs": 0,
    "instances": [
        entry(2, "red mug"),
        entry(3, "lamp", points=60, parts=(30, 20), parent=7),
        entry(4, "red bowl", parent=7),
        entry(5, "speck"),
    ],
    "groups": [{"id": 7, "parent": None, "agreement": 0.4, "instances": [3, 4]}],
}


def scene() -> EditedScene:
    """Ten Gaussians of the background, four of each instance but the speck, which has none; the lamp in two parts."""
    ids = np.repeat([0, 2, 3, 4], [10, 4, 4, 4]).astype(np.int32)
    parts = np.where(ids == 3, [1, 2] * 11, 0).astype(np.int32)
    rng = np.random.default_rng(0)
    colors = rng.integers(0, 255, (22, 3)).astype(np.uint8)
    return operations.begin(initialise(rng.normal(size=(22, 3)).astype(np.float32), colors, ids, 1.0, parts))
