"""A generated walk round a table in a garden, as a phone's photos show it: 28 photos on two rings, nothing else.

On a table stand seven things of several parts, and one beside it in the grass. There are no walls: hedges, a fence and
trees stand some metres off, and the sky has no depth that photos could tell. Exposure and white balance drift, corners
are darker, photos are a little blurred, some by a moving hand.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from household import (
    bag,
    bottle,
    bowl_of_fruit,
    carton,
    duck,
    jar,
    kettle,
    knife_block,
    pencils,
    plant,
    room_of,
    round_table,
    sized,
    toaster,
    wooden_chair,
)

from ss_flow.flows.generated.composites import Composite, Piece, book, brick, cup, paint, printed_box
from ss_flow.flows.generated.layout import COLORS
from ss_flow.flows.generated.prints import ellipse, sheet
from ss_flow.flows.generated.room import Room, looking_at
from ss_flow.flows.generated.shapes import ball, box, can, joined
from ss_flow.tasks.artifacts import Float64, UInt8

_VIEWS = 28
_THINGS = 7
_RINGS = (1.25, 0.45), (1.0, 0.85)
"""Distance from the table's axis and height above its top, of the lower and of the upper ring, metres."""
_HEDGES, _SKY = (5.0, 8.0), 14.0
"""How far off the hedges stand, and the sky, metres."""
_TRIES = 2000
_GAMMA = 2.2


def generate_walk(seed: int, views: int = _VIEWS, width: int = 0, height: int = 0) -> Room:
    """Build and photograph a table in a garden; the same seed gives the same arrays. Raises InputError without open3d.

    The views are of `width` x `height` pixels; if not told, of 640 x 480, upright where the seed is odd. Instance 0 is
    the garden. None is held out. Depth and poses are exact: the truth, which the photos come without.
    """
    rng = np.random.default_rng(9000 + seed)
    things, top = _furnish(rng)
    size = (width, height) if width and height else (480, 640) if seed % 2 else (640, 480)
    garden = room_of(things, _poses(views, top, rng), seed, size, rng)
    return replace(garden, rgb=by_phone(garden.rgb, rng))


def _furnish(rng: np.random.Generator) -> tuple[list[Composite], float]:
    """The garden and the things, in the order of their ids; and the height of the table's top."""
    c = [str(name) for name in rng.permutation(list(COLORS))]
    goods = [
        sized(cup(c[0], c[8], "white"), 0.6),
        sized(book(c[3], c[4]), 0.8),
        sized(printed_box([*c[2:], *c[:2]], rng), 0.6),
        sized(brick(c[1], "grey", rng), 0.7),
        kettle(c[2], "black"),
        bottle("green", c[1], c[3], 0.038, 0.26),
        jar(c[7], c[0]),
        bowl_of_fruit(c[0], (c[1], c[4], c[3])),
        plant(c[5], rng),
        toaster("grey", "black"),
        knife_block("tan", "black"),
        bag(c[3], c[4]),
        duck("yellow", "orange"),
        pencils(c[7], [c[i] for i in (0, 1, 3, 4, 6)]),
        carton(c[6], "white", c[1], (0.14, 0.07, 0.21)),
    ]
    wide, deep, top = (0.8, 0.8, 0.6) if rng.random() < 0.3 else (1.1, 0.65, 0.45)
    stand = round_table("brown", "black", top) if wide == deep else _coffee_table(wide, deep, top)
    turn = rng.uniform(0, np.pi)
    chosen = [goods[i] for i in rng.permutation(len(goods))[:_THINGS]]
    things = [_garden(rng), stand, *_strewn(chosen, 0.5 * wide, 0.5 * deep, top, rng)]
    beside = wooden_chair(c[6], "umber") if rng.random() < 0.5 else sized(plant(c[5], rng), 2.2)
    angle = rng.uniform(0, 2 * np.pi)
    away = beside.turned(rng.uniform(0, 6)).moved(0.95 * np.cos(angle), 0.95 * np.sin(angle), 0)
    return [things[0], *(thing.turned(turn) for thing in (*things[1:], away))], top


def _strewn(things: list[Composite], x: float, y: float, z: float, rng: np.random.Generator) -> list[Composite]:
    """Things turned anyhow on a table of these half widths, some of them a finger's breadth apart."""
    placed: list[Composite] = []
    taken: list[tuple[Float64, float]] = []
    for thing in sorted(things, key=lambda thing: -_reach(thing)):
        reach = _reach(thing)
        for _ in range(_TRIES):
            at = rng.uniform((-1, -1), (1, 1)) * (np.array([x, y]) - 0.8 * reach)
            if all(np.linalg.norm(at - other) > 0.85 * (reach + far) for other, far in taken):
                taken.append((at, reach))
                placed.append(thing.turned(rng.uniform(0, 2 * np.pi)).moved(*at, z))
                break
    return placed


def _reach(thing: Composite) -> float:
    """How far a thing reaches from its axis, metres."""
    return max(piece.mesh.radius for piece in thing.pieces)


def _coffee_table(width: float, depth: float, height: float) -> Composite:
    """A low table of planks on four legs, with a board below."""
    thick, leg = 0.04, 0.05
    x, y = width / 2 - leg, depth / 2 - leg
    legs = [box(leg, leg, height - thick).moved(i * x, j * y, 0) for i in (-1, 1) for j in (-1, 1)]
    return Composite(
        "tan table",
        (
            Piece("top", box(width, depth, thick).moved(0, 0, height - thick), paint("tan", "ochre", "planks", 0.11)),
            Piece("legs", joined(legs), paint("umber")),
            Piece("board", box(2 * x, 2 * y, 0.02).moved(0, 0, 0.3 * height), paint("brown")),
        ),
    )


def _garden(rng: np.random.Generator) -> Composite:
    """Grass with leaves on it; hedges, fences and trees around; the sky."""
    fallen = [ellipse(x, y, 0.09, 0.04, turn) for x, y, turn in rng.uniform((-3, -3, 0), (3, 3, 3), (160, 3))]
    pieces = [
        Piece("grass", can(_SKY, 0.1).moved(0, 0, -0.1), paint("green", "ochre", "noise", 0.11)),
        Piece("leaves", sheet(fallen, 0.004).turned(-np.pi / 2, axis=0), paint("orange", "brown")),
        Piece("sky", can(_SKY, 10).moved(0, 0, -0.2), paint("sky", "white", "noise", 2.5)),
    ]
    kinds = paint("green", "black", "noise", 0.25), paint("brown", "tan", "planks", 0.18), paint("cream", "grey")
    for angle in np.arange(0, 2 * np.pi, np.pi / 8):
        high, far = rng.uniform(1.2, 2.6), rng.uniform(*_HEDGES)
        wall = box(2.9, 0.5, high).moved(0, far, 0).turned(angle)
        pieces.append(Piece("hedges", wall, kinds[rng.integers(3)]))
    for angle in rng.uniform(0, 2 * np.pi, 6):
        tree = [(can(0.13, 1.6), paint("umber", "brown")), (ball(0.9), paint("green", "teal", "noise", 0.2))]
        for mesh, bark in tree:
            pieces.append(Piece("trees", mesh.moved(0, 4.0, mesh.height - 1.6).turned(angle), bark))
    return Composite("green garden", tuple(pieces))


def _poses(views: int, top: float, rng: np.random.Generator) -> Float64:
    """World-to-camera [views, 4, 4]: once round below, once round above, by hand."""
    poses = []
    for k in range(views):
        lap, along = divmod(2 * k / views, 1)
        far, rise = _RINGS[int(lap)]
        angle = 2 * np.pi * along + rng.uniform(-0.05, 0.05)
        eye = np.array([far * np.cos(angle), far * np.sin(angle), top + rise]) + rng.uniform(-0.06, 0.06, 3)
        poses.append(looking_at(eye, np.array([0, 0, top]) + rng.uniform(-0.06, 0.06, 3)))
    return np.stack(poses)


def by_phone(photos: UInt8, rng: np.random.Generator) -> UInt8:
    """Photos [K, H, W, 3] as a phone takes them: exposed and balanced anew on the way, blurred, corners dark."""
    import cv2

    count, h, w, _ = photos.shape
    drift = np.cumsum(rng.normal(0, (0.04, 0.01, 0.0, 0.01), (count, 4)), axis=0)
    v, u = np.mgrid[:h, :w] + 0.5
    corner = ((u - w / 2) ** 2 + (v - h / 2) ** 2) / ((w / 2) ** 2 + (h / 2) ** 2)
    taken = []
    for photo, change in zip(photos, drift - drift.mean(axis=0), strict=True):
        light = (photo / 255) ** _GAMMA * np.exp(change[0] + change[1:]) * (1 - 0.25 * corner[..., None])
        light = cv2.GaussianBlur(light, (0, 0), rng.uniform(0.4, 0.8) * w / 640)
        if rng.random() < 0.25:
            length, angle = rng.uniform(1, 3) * w / 640, rng.uniform(0, np.pi)
            steps = length * np.linspace(-0.5, 0.5, 5)
            moves = [np.array([[1, 0, s * np.cos(angle)], [0, 1, s * np.sin(angle)]]) for s in steps]
            light = np.mean([cv2.warpAffine(light, m, (w, h), borderMode=cv2.BORDER_REPLICATE) for m in moves], axis=0)
        taken.append(np.round(255 * np.clip(light, 0, 1) ** (1 / _GAMMA)))
    return np.stack(taken).astype(np.uint8)
