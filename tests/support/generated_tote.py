"""A generated tote of goods as a robot's depth camera sees it: ten small things in a heap, in 15 near views from above.

Cartons, bottles, a mug, a bag, a roll of tape and a book lie on each other and lean, as they were dropped. The tote's
walls are plain.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from depth_sensor import seen_near
from household import bag, bottle, carton, duck, jar, room_of, sized, tape
from numpy.typing import NDArray

from ss_flow.flows.generated.composites import Composite, Piece, book, brick, cup, paint
from ss_flow.flows.generated.layout import CEILING, COLORS
from ss_flow.flows.generated.prints import rectangle, sheet
from ss_flow.flows.generated.room import Room, looking_at
from ss_flow.flows.generated.shapes import box, joined
from ss_flow.tasks.artifacts import Float64
from ss_flow.tasks.geometry.open3d import load_open3d

_VIEWS = 15
_THINGS = 10
_INSIDE = 0.54, 0.36
"""Of the tote, along x and y, metres."""
_HIGH, _WALL, _STAND = 0.16, 0.006, 0.7
"""Height and thickness of its walls, and how high it stands."""
_CELL = 0.004
"""Side of the cells of the map of heights, metres."""
_DROPS = 120
"""Ways in which each thing may come to lie; the lowest is taken."""


def generate_tote(seed: int, views: int = _VIEWS, width: int = 640, height: int = 480) -> Room:
    """Fill and photograph a tote; the same seed gives the same arrays. Raises InputError without open3d.

    The views, of `width` x `height` pixels, look down into it from .55 to .75 m, from straight above to 50 degrees
    beside. Instance 0 is the room, 1 the tote. None is held out. Depth is 0 where it is unknown.
    """
    rng = np.random.default_rng(15000 + seed)
    c = [str(name) for name in rng.permutation(list(COLORS))]
    heap = [thing.moved(0, 0, _STAND + _WALL) for thing in dropped(_goods(c, rng), rng)]
    things = [_structure(), _tote(str(rng.choice(["grey", "sky", "sand"]))), *heap]
    room = room_of(things, _poses(views, rng), seed, (width, height), rng)
    return replace(room, depth=np.stack([seen_near(of_view, rng) for of_view in room.depth]))


def _goods(c: list[str], rng: np.random.Generator) -> list[Composite]:
    """What may lie in the tote, each standing on z = 0: ten of thirteen, in any order."""
    goods = [
        carton(c[0], "white", c[1], (0.12, 0.06, 0.2)),
        carton(c[2], c[3], "white", (0.16, 0.045, 0.1)),
        carton("white", c[4], c[5], (0.07, 0.07, 0.15)),
        carton(c[6], "white", c[7], (0.09, 0.04, 0.13)),
        bottle(c[5], "white", c[6], 0.033, 0.22),
        bottle("white", c[1], c[3], 0.03, 0.17),
        sized(cup(c[0], c[8], "white"), 0.6),
        bag(c[3], c[4]),
        tape(c[7], "tan"),
        sized(book(c[2], "white"), 0.65),
        jar(c[1], c[4]),
        duck("yellow", "orange"),
        sized(brick(c[8], "grey", rng), 0.5),
    ]
    return [goods[i] for i in rng.permutation(len(goods))[:_THINGS]]


@dataclass(frozen=True)
class _Silhouette:
    """A thing from above: which cells it covers, [n] each, and its lowest and highest points there."""

    rows: NDArray[np.intp]
    columns: NDArray[np.intp]
    low: Float64
    high: Float64


def dropped(things: list[Composite], rng: np.random.Generator) -> list[Composite]:
    """Things let fall one after the other on a floor z = 0 within the walls, each where its middle lies lowest."""
    shape = tuple(int(side / _CELL) for side in _INSIDE)
    ground = np.zeros(shape)
    lying = []
    for thing in things:
        best = np.inf, thing, ground
        for _ in range(_DROPS):
            turned = thing.turned(rng.integers(4) * np.pi / 2, axis=int(rng.integers(2)))
            turned = turned.turned(rng.uniform(0, 2 * np.pi)).turned(rng.normal(0, 0.25), axis=int(rng.integers(2)))
            low, high = turned.bounds
            room = np.array(_INSIDE) - (high - low)[:2] - 4 * _CELL
            if (room < 0).any():
                continue
            at = -np.array(_INSIDE) / 2 + 2 * _CELL + rng.random(2) * room - low[:2]
            turned = turned.moved(*at, 0)
            seen = _silhouette(turned, shape)
            here = seen.rows, seen.columns
            fall = float((ground[here] - seen.low).max())
            middle = float((seen.low + seen.high).mean() / 2) + fall
            if middle < best[0]:
                after = ground.copy()
                after[here] = np.maximum(after[here], seen.high + fall)
                best = middle, turned.moved(0, 0, fall), after
        lying.append(best[1])
        ground = best[2]
    return lying


def _silhouette(thing: Composite, shape: tuple[int, ...]) -> _Silhouette:
    """A thing within the walls, by rays through the middle of each cell, from below and from above."""
    o3d = load_open3d()
    mesh = joined([piece.mesh for piece in thing.pieces])
    scene = o3d.t.geometry.RaycastingScene(nthreads=1)
    scene.add_triangles(
        o3d.core.Tensor(mesh.vertices.astype(np.float32)), o3d.core.Tensor(mesh.triangles.astype(np.uint32))
    )
    rows, columns = np.divmod(np.arange(np.prod(shape)), shape[1])
    x, y = (_CELL * (cells + 0.5) - side / 2 for cells, side in zip((rows, columns), _INSIDE, strict=True))
    far = np.full(len(x), 1.0)
    ends = []
    for up in (1, -1):
        rays = np.stack([x, y, -up * far, 0 * far, 0 * far, up * far], axis=1).astype(np.float32)
        ends.append(up * (scene.cast_rays(o3d.core.Tensor(rays))["t_hit"].numpy() - 1))
    hit = np.isfinite(ends[0]) & np.isfinite(ends[1])
    return _Silhouette(rows[hit], columns[hit], ends[0][hit], ends[1][hit])


def _tote(color: str) -> Composite:
    """An open box with a rim, its floor at the height where it stands."""
    x, y = _INSIDE
    walls = [box(x + 2 * _WALL, _WALL, _HIGH).moved(0, s * (y + _WALL) / 2, 0) for s in (-1, 1)]
    walls += [box(_WALL, y, _HIGH).moved(s * (x + _WALL) / 2, 0, 0) for s in (-1, 1)]
    rims = [box(x + 0.04, 0.014, 0.012).moved(0, s * (y / 2 + 0.013), _HIGH - 0.012) for s in (-1, 1)]
    rims += [box(0.014, y + 0.012, 0.012).moved(s * (x / 2 + 0.013), 0, _HIGH - 0.012) for s in (-1, 1)]
    pieces = Piece("walls", joined([box(x, y, _WALL), *walls]), paint(color)), Piece("rim", joined(rims), paint(color))
    return Composite(f"{color} tote", pieces).moved(0, 0, _STAND)


def _structure() -> Composite:
    """A table top and a floor below it, walls around."""
    wall = sheet([rectangle(0, CEILING / 2, 6, CEILING)]).moved(0, 3.0, 0)
    walls = joined([wall.turned(k * np.pi / 2) for k in range(4)])
    return Composite(
        "grey structure",
        (
            Piece("walls", walls, paint("cream", "sand", "noise", 0.14)),
            Piece("floor", box(6, 6, 0.02).moved(0, 0, -0.02), paint("grey", "sand", "checks", 0.3)),
            Piece("ceiling", box(6, 6, 0.02).moved(0, 0, CEILING), paint("white")),
            Piece("stand", box(1.2, 0.8, 0.04).moved(0, 0, _STAND - 0.041), paint("brown", "umber", "noise", 0.1)),
        ),
    )


def _poses(views: int, rng: np.random.Generator) -> Float64:
    """World-to-camera [views, 4, 4]: the first from above, the others on two rings round the tote."""
    poses = []
    for k in range(views):
        around = 2 * np.pi * k * 0.381966
        beside = 0.05 if k == 0 else (0.45, 0.85)[k % 2] + rng.uniform(-0.08, 0.08)
        ray = np.array([np.sin(beside) * np.cos(around), np.sin(beside) * np.sin(around), np.cos(beside)])
        target = np.array([*rng.uniform(-0.05, 0.05, 2), _STAND + 0.05])
        poses.append(looking_at(target + rng.uniform(0.58, 0.72) * ray, target))
    return np.stack(poses)
