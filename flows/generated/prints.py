"""Flat shapes, and what is printed with them on the faces of a cuboid; metres."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from ss_flow.flows.generated.shapes import Mesh
from ss_flow.tasks.artifacts import Float64

LIFT = 0.0008
"""How far a print lies above what it is printed on."""


def sheet(outlines: Sequence[Float64], lift: float = 0.0) -> Mesh:
    """Flat shapes in the plane y = -lift, seen from -y.

    outlines: each [n, 2] (x, z), counterclockwise for who looks from -y, and starlike about its mean.
    """
    vertices, triangles, first = [], [], 0
    for outline in outlines:
        n = len(outline)
        corners = np.vstack([outline, outline.mean(axis=0)])
        vertices.append(np.stack([corners[:, 0], np.full(n + 1, -lift), corners[:, 1]], axis=1))
        here = np.arange(n)
        triangles.append(first + np.stack([here, (here + 1) % n, np.full(n, n)], axis=1))
        first += n + 1
    placed = np.concatenate(vertices)
    return Mesh(placed, np.tile([0.0, -1.0, 0.0], (first, 1)), placed, np.concatenate(triangles).astype(np.int32))


def rectangle(x: float, z: float, width: float, height: float) -> Float64:
    """[4, 2] an upright rectangle about (x, z)."""
    return np.array([x, z]) + np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * (width / 2, height / 2)


def ellipse(x: float, z: float, width: float, height: float, tilt: float = 0.0, dents: int = 0) -> Float64:
    """[n, 2] an ellipse about (x, z), tilted (radians); with `dents`, a star or flower of so many points."""
    angle = np.linspace(0, 2 * np.pi, 40 if dents else 20, endpoint=False)
    radius = 0.7 + 0.3 * np.cos(dents * angle) if dents else np.ones_like(angle)
    c, s = np.cos(tilt), np.sin(tilt)
    points = np.stack([radius * np.cos(angle) * width / 2, radius * np.sin(angle) * height / 2], axis=1)
    return np.array([x, z]) + points @ np.array([[c, s], [-s, c]])


def lines_of_text(width: float, height: float, rows: int = 4) -> list[Float64]:
    """Bars that look like words from afar."""
    lengths = 0.8 - 0.5 * (np.arange(rows) * 0.618 % 1)
    step = 0.8 * height / rows
    return [
        rectangle(0.4 * width * (length / 0.8 - 1), (rows / 2 - i - 0.5) * step, length * width, 0.45 * step)
        for i, length in enumerate(lengths)
    ]


def _grid(width: float, height: float, n: int) -> list[tuple[float, float, float]]:
    """Places (x, z) and size of about n x n cells of a face."""
    cell = min(width, height) / n
    columns, rows = int(width / cell), int(height / cell)
    return [((i - (columns - 1) / 2) * cell, (j - (rows - 1) / 2) * cell, cell)
            for i in range(columns) for j in range(rows)]  # fmt: skip


PRINTS: dict[str, Callable[[float, float], list[Float64]]] = {
    "stripes": lambda w, h: [rectangle((i - 2) * w / 5, 0, w / 10, h) for i in range(5)],
    "dots": lambda w, h: [ellipse(x, z, 0.6 * c, 0.6 * c) for x, z, c in _grid(w, h, 4)],
    "checks": lambda w, h: [rectangle(x, z, c, c) for i, (x, z, c) in enumerate(_grid(w, h, 3)) if i % 2],
    "star": lambda w, h: [ellipse(0, 0, 0.85 * min(w, h), 0.85 * min(w, h), 0.3, dents=5)],
    "text": lambda w, h: lines_of_text(0.9 * w, h, 5),
    "bars": lambda w, h: [rectangle(0, z, w, h / 6) for z in (-0.3 * h, 0.0, 0.3 * h)],
}
"""What is printed on a face, for its width and height."""

FACES = ("front", "right", "back", "left", "top", "bottom")


def on_face(mesh: Mesh, face: str, size: tuple[float, float, float]) -> Mesh:
    """A sheet about the origin, laid on a face of a cuboid that stands on z = 0. size: its extents along x, y, z."""
    side = FACES.index(face)
    width, depth, height = size
    if side < 4:
        out = (depth, width)[side % 2] / 2
        return mesh.moved(0, -out, height / 2).turned(side * np.pi / 2)
    return mesh.turned((-1 if face == "top" else 1) * np.pi / 2, axis=0).moved(0, 0, height if face == "top" else 0)


def face_size(face: str, size: tuple[float, float, float]) -> tuple[float, float]:
    """Width and height of a face of a cuboid."""
    width, depth, height = size
    return (width, depth) if face in ("top", "bottom") else ((width, depth)[FACES.index(face) % 2], height)
