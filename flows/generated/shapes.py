"""Triangle meshes of the things that stand in a generated room; metres, z up, standing on z = 0 round the z axis."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from ss_flow.tasks.artifacts import Float64, Int32

_CREASE = 0.8
"""Cosine of the bend above which two faces of a turned shape are shaded as one smooth surface."""


@dataclass(frozen=True)
class Mesh:
    """Triangles with a shading normal and a texture coordinate at every vertex (vertices are doubled at creases)."""

    vertices: Float64
    """[V, 3]."""
    normals: Float64
    """[V, 3] of unit length, outwards."""
    texture: Float64
    """[V, 3] place in the solid texture, metres: it moves with the thing."""
    triangles: Int32
    """[T, 3] rows of `vertices`."""

    def moved(self, x: float, y: float, z: float) -> Mesh:
        """The mesh shifted in space; its texture comes along."""
        return Mesh(self.vertices + np.array([x, y, z]), self.normals, self.texture, self.triangles)

    def turned(self, angle: float, axis: int = 2) -> Mesh:
        """The mesh rotated by `angle` (radians) about a coordinate axis; its texture comes along."""
        c, s = np.cos(angle), np.sin(angle)
        first, second = (axis + 1) % 3, (axis + 2) % 3
        rotation = np.eye(3)
        rotation[[first, first, second, second], [first, second, first, second]] = c, -s, s, c
        return Mesh(self.vertices @ rotation.T, self.normals @ rotation.T, self.texture, self.triangles)

    def sized(self, factor: float) -> Mesh:
        """The mesh scaled about its origin; the texture keeps its scale."""
        return Mesh(self.vertices * factor, self.normals, self.texture * factor, self.triangles)

    @property
    def radius(self) -> float:
        """Distance of the farthest vertex from the z axis."""
        return float(np.hypot(self.vertices[:, 0], self.vertices[:, 1]).max())

    @property
    def height(self) -> float:
        """Highest z."""
        return float(self.vertices[:, 2].max())


def joined(parts: Sequence[Mesh]) -> Mesh:
    """Several meshes as one, the texture running through all of them."""
    starts = np.cumsum([0] + [len(p.vertices) for p in parts[:-1]])
    return Mesh(
        np.concatenate([p.vertices for p in parts]),
        np.concatenate([p.normals for p in parts]),
        np.concatenate([p.vertices for p in parts]),
        np.concatenate([p.triangles + start for p, start in zip(parts, starts, strict=True)]).astype(np.int32),
    )


def box(width: float, depth: float, height: float) -> Mesh:
    """A cuboid of the given extents along x, y, z."""
    vertices: list[Float64] = []
    normals: list[Float64] = []
    triangles: list[tuple[int, int, int]] = []
    half = np.array([width, depth, height]) / 2
    for axis in range(3):
        for sign in (-1.0, 1.0):
            normal = np.eye(3)[axis] * sign
            along, across = np.eye(3)[(axis + 1) % 3] * sign, np.eye(3)[(axis + 2) % 3]
            corners = [normal + a * along + b * across for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
            first = len(vertices)
            vertices += corners
            normals += [normal] * 4
            triangles += [(first, first + 1, first + 2), (first, first + 2, first + 3)]
    placed = np.array(vertices) * half + (0, 0, height / 2)
    return Mesh(placed, np.array(normals), placed, np.array(triangles, np.int32))


def turned_profile(profile: Sequence[tuple[float, float]], segments: int = 40) -> Mesh:
    """The surface that a profile sweeps round the z axis.

    profile: (radius, z) of its points, such that the solid lies on the left of the way along it.
    """
    points = np.array(profile, float)
    step = np.diff(points, axis=0)
    outwards = np.stack([step[:, 1], -step[:, 0]], axis=1) / np.linalg.norm(step, axis=1, keepdims=True)
    angle = np.linspace(0, 2 * np.pi, segments, endpoint=False)
    cosine, sine = np.cos(angle), np.sin(angle)
    here = np.arange(segments)
    there = (here + 1) % segments
    vertices, normals, triangles = [], [], []
    for i in range(len(step)):
        for end, neighbour in ((i, i - 1), (i + 1, i + 1)):
            normal = outwards[i]
            if 0 <= neighbour < len(step) and normal @ outwards[neighbour] > _CREASE:
                normal = normal + outwards[neighbour]
                normal = normal / np.linalg.norm(normal)
            radius, z = points[end]
            vertices.append(np.stack([radius * cosine, radius * sine, np.full(segments, z)], axis=1))
            normals.append(np.stack([normal[0] * cosine, normal[0] * sine, np.full(segments, normal[1])], axis=1))
        low, high = 2 * i * segments, (2 * i + 1) * segments
        triangles.append(np.stack([low + here, low + there, high + there], axis=1))
        triangles.append(np.stack([low + here, high + there, high + here], axis=1))
    stacked = np.concatenate(vertices)
    return Mesh(stacked, np.concatenate(normals), stacked, np.concatenate(triangles).astype(np.int32))


def _arc(
    center: tuple[float, float], radius: float, start: float, stop: float, steps: int
) -> list[tuple[float, float]]:
    angle = np.radians(np.linspace(start, stop, steps))
    return [(float(max(center[0] + radius * np.cos(a), 0)), float(center[1] + radius * np.sin(a))) for a in angle]


def ball(radius: float) -> Mesh:
    """A sphere resting on z = 0."""
    return turned_profile(_arc((0, radius), radius, -90, 90, 20))


def can(radius: float, height: float) -> Mesh:
    """A closed cylinder."""
    return turned_profile([(0, 0), (radius, 0), (radius, height), (0, height)])


def bowl(radius: float) -> Mesh:
    """An open half-sphere with a wall."""
    wall = 0.08 * radius
    outer = _arc((0, radius), radius, -90, 0, 12)
    inner = _arc((0, radius), radius - wall, 0, -90, 12)
    return turned_profile([(0.0, 0.0), *outer[1:], *inner])


def torus(radius: float, tube: float) -> Mesh:
    """A ring lying flat: `radius` from the axis to the middle of the tube."""
    return turned_profile(_arc((radius, tube), tube, -180, 180, 25))


def mug(radius: float, height: float) -> Mesh:
    """An open cylinder with a wall, a bottom and a handle."""
    inner = 0.88 * radius
    body = turned_profile([(0, 0), (radius, 0), (radius, height), (inner, height), (inner, 0.06), (0, 0.06)])
    reach = 0.3 * height
    handle = torus(reach, 0.2 * radius).turned(np.pi / 2, axis=0)
    return joined([body, handle.moved(radius, -0.2 * radius, height / 2)])


def vase(radius: float, height: float) -> Mesh:
    """A belly, a neck and an open mouth."""
    z = np.linspace(0, 1, 24)
    outline = radius * (0.62 + 0.38 * np.sin(np.pi * (1.55 * z + 0.08)))
    outer = [(float(r), float(h * height)) for r, h in zip(outline, z, strict=True)]
    mouth = 0.82 * outer[-1][0]
    return turned_profile([(0.0, 0.0), *outer, (mouth, height), (0.6 * mouth, 0.75 * height), (0.0, 0.75 * height)])


def bracket(length: float, thickness: float) -> Mesh:
    """An L: a lying and a standing bar."""
    width = 0.8 * length
    return joined(
        [
            box(length, width, thickness),
            box(thickness, width, length - thickness).moved((thickness - length) / 2, 0, thickness),
        ]
    )


def crate(width: float, depth: float, height: float) -> Mesh:
    """An open box."""
    wall = 0.09 * width
    sides = [box(wall, depth, height).moved(s * (width - wall) / 2, 0, 0) for s in (-1, 1)]
    ends = [box(width - 2 * wall, wall, height).moved(0, s * (depth - wall) / 2, 0) for s in (-1, 1)]
    return joined([*sides, *ends, box(width - 2 * wall, depth - 2 * wall, wall)])


def chair(width: float, seat: float) -> Mesh:
    """A seat on four legs, with a back."""
    leg = 0.13 * width
    inset = (width - leg) / 2
    legs = [box(leg, leg, seat).moved(x * inset, y * inset, 0) for x in (-1, 1) for y in (-1, 1)]
    back = box(width, leg, 0.9 * seat).moved(0, inset, seat + 0.12 * width)
    return joined([*legs, box(width, width, 0.12 * width).moved(0, 0, seat), back])


def table(width: float, depth: float, height: float) -> Mesh:
    """A top on four legs."""
    top, leg = 0.05, 0.08
    x, y = width / 2 - leg, depth / 2 - leg
    legs = [box(leg, leg, height - top).moved(i * x, j * y, 0) for i in (-1, 1) for j in (-1, 1)]
    return joined([*legs, box(width, depth, top).moved(0, 0, height - top)])


def shelf(width: float, depth: float, boards: Sequence[float]) -> Mesh:
    """Two sides, a back and boards whose upper faces lie at the given heights."""
    plank = 0.04
    sides = [box(plank, depth, boards[-1]).moved(s * (width + plank) / 2, 0, 0) for s in (-1, 1)]
    back = box(width, 0.02, boards[-1] - plank).moved(0, depth / 2 - 0.01, 0)
    return joined([*sides, back, *(box(width, depth - 0.02, plank).moved(0, -0.01, z - plank) for z in boards)])


def sofa(width: float, depth: float, seat: float) -> Mesh:
    """A seat with a back (towards +y) and two arms."""
    arm, back = 0.16, 0.2
    inner = width - 2 * arm
    return joined(
        [
            box(inner, depth - back, seat).moved(0, -back / 2, 0),
            box(width, back, 1.9 * seat).moved(0, (depth - back) / 2, 0),
            *(box(arm, depth - back, 1.35 * seat).moved(s * (width - arm) / 2, -back / 2, 0) for s in (-1, 1)),
        ]
    )


SHAPES: dict[str, Callable[[], Mesh]] = {
    "mug": lambda: mug(0.12, 0.26),
    "ball": lambda: ball(0.18),
    "box": lambda: box(0.32, 0.26, 0.28),
    "chair": lambda: chair(0.42, 0.4),
    "bowl": lambda: bowl(0.21),
    "ring": lambda: torus(0.18, 0.075),
    "vase": lambda: vase(0.14, 0.4),
    "crate": lambda: crate(0.4, 0.32, 0.24),
    "bracket": lambda: bracket(0.34, 0.12),
    "can": lambda: can(0.12, 0.28),
}
"""The small things, by the word that names them."""
