"""Ray casting of a generated room: colour with shadows, exact depth, exact instance and part ids."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ss_flow.flows.generated.layout import Thing
from ss_flow.tasks.artifacts import Bool, Float32, Float64, Int32, UInt8
from ss_flow.tasks.geometry.cameras import Camera
from ss_flow.tasks.geometry.open3d import load_open3d

_PATTERNS = ("noise", "checks", "stripes", "planks")
_GAMMA = 2.2
_SUN = np.array([0.42, -0.5, 0.76]) / np.linalg.norm([0.42, -0.5, 0.76])
_FILL = np.array([-0.7, 0.45, 0.35]) / np.linalg.norm([-0.7, 0.45, 0.35])
_SUN_LIGHT = np.array([0.78, 0.74, 0.66])
_FILL_LIGHT = np.array([0.12, 0.14, 0.17])
_AMBIENT = np.array([0.36, 0.38, 0.41])
_LATTICE = 32
"""Values along each side of the cube that all noise is made of; a power of two."""
_SENSOR_NOISE = 1.5
"""Standard deviation of the colour noise, in 8-bit steps."""


@dataclass(frozen=True)
class _Hits:
    """Where a bundle of N rays met the room. One row a coordinate: operations on short rows of three take longer."""

    depth: Float32
    """[N] z-depth, metres."""
    thing: Int32
    """[N] index of the thing that was hit."""
    normal: Float64
    """[3, N] shading normal, towards the viewer."""
    lit: Bool
    """[N] whether the sun reaches the place."""
    color: Float64
    """[3, N] linear light."""


class Renderer:
    """Casts rays into a furnished room. Deterministic: the same room, camera and generator give the same image."""

    def __init__(self, things: Sequence[Thing], seed: int) -> None:
        o3d = load_open3d()
        sizes = [len(t.mesh.vertices) for t in things]
        starts = np.cumsum([0, *sizes[:-1]])
        triangles = [t.mesh.triangles + s for t, s in zip(things, starts, strict=True)]
        self._triangles = np.concatenate(triangles)
        self._thing = np.repeat(np.arange(len(things), dtype=np.int32), [len(t) for t in triangles])
        self._normals = np.ascontiguousarray(np.concatenate([t.mesh.normals for t in things]).T)
        self._texture = np.ascontiguousarray(np.concatenate([t.mesh.texture for t in things]).T)
        self._ids = np.array([t.instance_id for t in things], np.uint16)
        self._parts = np.array([t.part_id for t in things], np.uint8)
        vertices = np.concatenate([t.mesh.vertices for t in things]).astype(np.float32)
        self._vertices = vertices
        self._scene = _scene(o3d, vertices, self._triangles)
        # The sun shines through the walls and the ceiling.
        self._blockers = _scene(o3d, vertices, self._triangles[self._ids[self._thing] > 0])
        self._o3d = o3d
        self._to_tensor = o3d.core.Tensor
        self._pattern = np.array([_PATTERNS.index(t.material.pattern) for t in things])
        self._scale = np.array([t.material.scale for t in things])
        shades = (np.array([t.material.shades for t in things]) / 255.0) ** _GAMMA
        self._shades = np.ascontiguousarray(shades.transpose(1, 2, 0))
        rng = np.random.default_rng(seed)
        lattice = rng.random((_LATTICE, _LATTICE, _LATTICE)).astype(np.float32)
        self._lattice = lattice.ravel()
        self._rise = (np.roll(lattice, -1, axis=2) - lattice).ravel()
        self._offset = np.ascontiguousarray(rng.uniform(0, 7, (len(things), 3)).T)

    def render(self, camera: Camera, rng: np.random.Generator) -> tuple[UInt8, Float32, NDArray[np.uint16], UInt8]:
        """One view: rgb [H, W, 3], z-depth [H, W] in metres, instance ids and part ids [H, W], through pixel centres.

        Colour is averaged over five rays where a pixel holds an edge; depth and ids are those of the centre.
        """
        h, w = camera.height, camera.width
        row, column = (n.ravel() for n in np.mgrid[:h, :w])
        hits = self._cast(camera, column + 0.5, row + 0.5)
        color = hits.color
        edge = np.flatnonzero(_edges(hits, h, w))
        for du, dv in ((-0.3, -0.1), (0.1, -0.3), (0.3, 0.1), (-0.1, 0.3)):
            color[:, edge] += self._cast(camera, column[edge] + 0.5 + du, row[edge] + 0.5 + dv).color
        color[:, edge] /= 5
        image = 255 * np.clip(color.T, 0, 1) ** (1 / _GAMMA) + rng.normal(0, _SENSOR_NOISE, (h * w, 3))
        rgb = np.clip(np.round(image), 0, 255).astype(np.uint8).reshape(h, w, 3)
        thing = hits.thing.reshape(h, w)
        return rgb, hits.depth.reshape(h, w), self._ids[thing], self._parts[thing]

    def alone(self, camera: Camera, instance_id: int) -> tuple[Float32, Float32, Float32]:
        """One instance without the rest of the room, in the light that it has there: the others' shadows stay.

        Returns rgb [H, W, 3] 0..1 before black and alpha [H, W], both averaged over nine rays a pixel, and z-depth
        [H, W] of the ray through the centre, 0 where it misses.
        """
        h, w = camera.height, camera.width
        row, column = (n.ravel() for n in np.mgrid[:h, :w])
        own = np.flatnonzero(self._ids[self._thing] == instance_id)
        scene = _scene(self._o3d, self._vertices, self._triangles[own])
        light, hits, depth = np.zeros((3, h * w)), np.zeros(h * w), np.zeros(h * w, np.float32)
        for du, dv in itertools.product((0.5, 1 / 6, 5 / 6), repeat=2):
            met = self._reached(scene, camera, column + du, row + dv)
            found = self._cast(camera, column[met] + du, row[met] + dv, scene, own)
            light[:, met] += found.color
            hits[met] += 1
            if du == dv == 0.5:
                depth[met] = found.depth
        alpha = hits / 9
        rgb = np.clip(light / np.maximum(hits, 1), 0, 1) ** (1 / _GAMMA) * alpha
        return rgb.T.reshape(h, w, 3).astype(np.float32), alpha.reshape(h, w).astype(np.float32), depth.reshape(h, w)

    def _reached(self, scene: Any, camera: Camera, u: Float64, v: Float64) -> NDArray[np.intp]:
        """Which of the rays through image points meet anything of a scene."""
        rays = self._rays(camera.center, _directions(camera, u, v))
        return np.flatnonzero(np.isfinite(scene.cast_rays(rays)["t_hit"].numpy()))

    def _cast(
        self, camera: Camera, u: Float64, v: Float64, scene: Any = None, own: NDArray[np.intp] | None = None
    ) -> _Hits:
        """Where the rays through image points [N] meet the room, or a scene of the triangles `own` alone: all do."""
        direction = _directions(camera, u, v)
        answer = (scene or self._scene).cast_rays(self._rays(camera.center, direction))
        # The rays' directions have z = 1 in the camera, so the distance along them is the z-depth.
        depth = answer["t_hit"].numpy()
        triangle = answer["primitive_ids"].numpy().astype(np.intp)
        triangle = triangle if own is None else own[triangle]
        second, third = answer["primitive_uvs"].numpy().T
        weights = 1 - second - third, second, third
        corners = self._triangles.take(triangle, axis=0).T
        normal = _blend(self._normals, corners, weights)
        normal /= np.sqrt((normal * normal).sum(axis=0))
        normal *= -np.sign((normal * direction).sum(axis=0))
        thing = self._thing.take(triangle)
        place = camera.center[:, None] + direction * depth
        lit = ~self._blockers.test_occlusions(self._rays(place + 0.004 * normal, _SUN)).numpy()
        albedo = self._albedo(_blend(self._texture, corners, weights), thing, depth / camera.fx)
        light = (
            _AMBIENT[:, None] * (0.8 + 0.2 * normal[2])
            + _SUN_LIGHT[:, None] * (np.maximum(_SUN @ normal, 0) * lit)
            + _FILL_LIGHT[:, None] * np.maximum(_FILL @ normal, 0)
        )
        return _Hits(depth, thing, normal, lit, albedo * light)

    def _rays(self, origin: Float64, direction: Float64) -> Any:
        """Rays as Open3D takes them; of origin and direction one is [3, N], the other that or [3]."""
        rays = np.empty((np.broadcast_shapes(origin.T.shape, direction.T.shape)[0], 6), np.float32)
        rays[:, :3], rays[:, 3:] = origin.T, direction.T
        return self._to_tensor(rays)

    def _albedo(self, place: Float64, thing: Int32, footprint: Float64) -> Float64:
        """[3, N] linear colour of the solid textures. place: [3, N] in each thing's frame; footprint: [N] metres a
        pixel."""
        scale = self._scale.take(thing)
        cell = place / scale + self._offset.take(thing, axis=1)
        sharpness = np.clip(0.35 * scale / footprint, 0.3, 8)
        pattern = self._pattern.take(thing)
        mix = np.empty(len(thing))
        for kind in range(len(_PATTERNS)):
            of_kind = np.flatnonzero(pattern == kind)
            if of_kind.size:
                mix[of_kind] = self._mix(kind, cell.take(of_kind, axis=1), sharpness.take(of_kind))
        grain = 0.86 + 0.28 * self._noise(cell * 2.3 + 5)
        dark, bright = (shade.take(thing, axis=1) for shade in self._shades)
        return (dark + (bright - dark) * mix) * grain

    def _mix(self, kind: int, cell: Float64, sharpness: Float64) -> Float64:
        """Share of the second shade, 0..1; edges are as soft as a pixel is large. cell: [3, N]."""
        pattern = _PATTERNS[kind]
        if pattern == "noise":
            return np.clip(1.8 * (0.65 * self._noise(cell) + 0.35 * self._noise(2.1 * cell + 9)) - 0.4, 0, 1)
        if pattern == "planks":
            plank = np.floor(cell[0])
            seam = np.abs(cell[0] - plank - 0.5) > 0.5 - np.minimum(0.2 / sharpness, 0.05)
            grain = self._noise(cell * [[9.0], [0.6], [3.0]] + plank * [[0.0], [11.3], [5.1]])
            tone = (np.sin(plank * 12.9898) * 43758.5453) % 1.0
            return np.clip(0.55 * grain + 0.4 * tone + 0.4 * seam - 0.05, 0, 1)
        if pattern == "stripes":
            product = np.sin(np.pi * (np.array([0.35, 0.35, 0.87]) @ cell))
        else:
            product = np.sin(np.pi * cell).prod(axis=0) * 1.6
        return 0.5 + 0.5 * np.clip(product * sharpness, -1, 1)

    def _noise(self, place: Float64) -> Float64:
        """Value noise in 0..1 with cells of size one: smooth interpolation of a random lattice. place: [3, N]."""
        base = np.floor(place)
        f = (place - base).astype(np.float32)
        f = f * f * (3 - 2 * f)
        x, y, z = base.astype(np.int32) & (_LATTICE - 1)
        planes = x * _LATTICE**2, ((x + 1) & (_LATTICE - 1)) * _LATTICE**2
        rows = y * _LATTICE + z, ((y + 1) & (_LATTICE - 1)) * _LATTICE + z
        value = np.zeros(len(x), np.float32)
        for dx in (0, 1):
            wx = f[0] if dx else 1 - f[0]
            for dy in (0, 1):
                wy = f[1] if dy else 1 - f[1]
                at = (planes[dx] + rows[dy]).astype(np.intp)  # as `take` wants it
                value += wx * wy * (self._lattice.take(at) + self._rise.take(at) * f[2])
        return value.astype(np.float64)


def _directions(camera: Camera, u: Float64, v: Float64) -> Float64:
    """[3, N] of z = 1 in the camera, of the rays through image points."""
    local = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones_like(u)])
    return np.asarray(camera.world_to_camera[:3, :3].T @ local)


def _scene(o3d: Any, vertices: Float32, triangles: Int32) -> Any:
    scene = o3d.t.geometry.RaycastingScene(nthreads=1)
    scene.add_triangles(o3d.core.Tensor(vertices), o3d.core.Tensor(triangles.astype(np.uint32)))
    return scene


def _blend(values: Float64, corners: Int32, weights: Sequence[Float32]) -> Float64:
    """[3, N] the means of values [3, V] at corners [3, N]; weights: [N] of each."""
    first, second, third = (values.take(at, axis=1) * weight for at, weight in zip(corners, weights, strict=True))
    return first + second + third


def _edges(hits: _Hits, h: int, w: int) -> Bool:
    """[h * w] the pixels that differ from a neighbour in thing, shadow, orientation or depth."""
    thing, lit = hits.thing.reshape(h, w), hits.lit.reshape(h, w)
    depth, normal = hits.depth.reshape(h, w), hits.normal.reshape(3, h, w)
    edge = np.zeros((h, w), bool)
    for here, there in (
        ((slice(1, None), slice(None)), (slice(None, -1), slice(None))),
        ((slice(None), slice(1, None)), (slice(None), slice(None, -1))),
    ):
        differs = (thing[here] != thing[there]) | (lit[here] != lit[there])
        differs |= (normal[:, *here] * normal[:, *there]).sum(axis=0) < 0.85
        differs |= np.abs(depth[here] - depth[there]) > 0.04 * depth[here]
        edge[here] |= differs
        edge[there] |= differs
    return edge.ravel()
