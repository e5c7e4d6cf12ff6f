"""A generated shelf of goods as a depth camera sees it: cartons, a book, a bag, a bottle, a pot of pencils, a duck and
a brick on three boards, in 15 near views from in front of it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from depth_sensor import seen_near
from household import bag, bottle, carton, duck, pencils, room_of, sized

from ss_flow.flows.generated.composites import Composite, Piece, book, brick, paint, printed_box, stood_up
from ss_flow.flows.generated.layout import CEILING, COLORS
from ss_flow.flows.generated.prints import rectangle, sheet
from ss_flow.flows.generated.room import Room, looking_at
from ss_flow.flows.generated.shapes import box, joined
from ss_flow.tasks.artifacts import Float64

_VIEWS = 15
_WIDTH, _DEPTH, _HEIGHT, _BOARD = 0.62, 0.4, 0.3, 0.018
"""Inner width and depth, height of a compartment and thickness of a board, metres."""
_MIDDLE = 0.9
"""Height of the middle board."""


def generate_shelf(seed: int, views: int = _VIEWS, width: int = 640, height: int = 480) -> Room:
    """Build and photograph a shelf; the same seed gives the same arrays. Raises InputError without open3d.

    The views, of `width` x `height` pixels, stand in rows of five, half a metre to .7 m before the shelf. Instance 0 is
    the shelf and the room. None is held out. Depth is 0 where it is unknown.
    """
    rng = np.random.default_rng(7000 + seed)
    things = _furnish(rng)
    room = room_of(things, _poses(views, rng), seed, (width, height), rng)
    return replace(room, depth=np.stack([seen_near(of_view, rng) for of_view in room.depth]))


def _furnish(rng: np.random.Generator) -> list[Composite]:
    """The structure and the things, in the order of their ids."""
    c = [str(name) for name in rng.permutation(list(COLORS))]
    goods = [
        carton(c[0], "white", c[1], (0.12, 0.06, 0.2)).turned(rng.uniform(-0.3, 0.3)),
        stood_up(sized(book(c[2], "white"), 0.7)).turned(np.pi / 2 + rng.uniform(-0.15, 0.15)),
        bag(c[3], c[4]).turned(rng.uniform(-0.5, 0.5)),
        bottle(c[5], "white", c[6], 0.033, 0.22),
        pencils(c[7], [c[i] for i in (0, 1, 3, 4, 6)]),
        duck("yellow", "orange").turned(rng.uniform(-2.4, -0.8)),
        sized(printed_box([*c[3:], *c[:3]], rng), 0.42).turned(rng.uniform(-0.5, 0.5)),
    ]
    order = rng.permutation(len(goods)).tolist()
    upper = _MIDDLE + _HEIGHT + _BOARD
    things = [_structure(), *_in_a_row([goods[i] for i in order[:4]], 0.12, (-0.02, 0.03), _MIDDLE, rng)]
    things += _in_a_row([goods[i] for i in order[4:]], 0.2, (-0.05, 0.05), upper, rng)
    lower = _MIDDLE - _HEIGHT - _BOARD
    lying = carton(c[8], c[0], "white", (0.16, 0.045, 0.24)).turned(-np.pi / 2, axis=0)
    lying = lying.moved(0, 0, -float(lying.bounds[0, 2])).turned(rng.uniform(-0.4, 0.4))
    things.append(lying.moved(rng.uniform(-0.1, 0.1), 0.22, lower))
    toy = sized(brick(c[1], "grey", rng), 0.6).turned(rng.uniform(-0.3, 0.3))
    things.append(toy.moved(rng.choice([-1, 1]) * 0.2, 0.16, lower))
    return things


def _in_a_row(
    things: list[Composite], y: float, off: tuple[float, float], z: float, rng: np.random.Generator
) -> list[Composite]:
    """Things side by side on a board, about equally far apart; off: how far from y they may stand."""
    widths = [float(np.ptp(thing.bounds[:, 0])) for thing in things]
    gap = max((0.94 * _WIDTH - sum(widths)) / (len(things) + 1), 0.002)
    x, placed = -0.47 * _WIDTH, []
    for thing, width in zip(things, widths, strict=True):
        x += gap * rng.uniform(0.5, 1.1)
        placed.append(thing.moved(x - float(thing.bounds[0, 0]), y + rng.uniform(*off), z))
        x += width
    return placed


def _structure() -> Composite:
    """The shelf, which opens to -y, in an empty room."""
    wall = sheet([rectangle(0, CEILING / 2, 6, CEILING)]).moved(0, 2.0, 0)
    walls = [wall.turned(k * np.pi / 2) for k in range(4)]
    step = _HEIGHT + _BOARD
    wood = paint("tan", "ochre", "planks", 0.1)
    across = _WIDTH + 2 * _BOARD
    boards = [box(across, _DEPTH, _BOARD).moved(0, _DEPTH / 2, _MIDDLE + k * step - _BOARD) for k in (-1, 0, 1, 2)]
    side = box(_BOARD, _DEPTH, 3 * step).moved(0, _DEPTH / 2, _MIDDLE - step)
    sides = [side.moved(s * (_WIDTH + _BOARD) / 2, 0, 0) for s in (-1, 1)]
    lips = [box(across, 0.008, 0.03).moved(0, -0.004, _MIDDLE - 0.012 + k * step) for k in (0, 1)]
    return Composite(
        "grey structure",
        (
            Piece("walls", joined(walls), paint("cream", "sand", "noise", 0.14)),
            Piece("floor", box(6, 6, 0.02).moved(0, 0, -0.02), paint("grey", "sand", "checks", 0.3)),
            Piece("ceiling", box(6, 6, 0.02).moved(0, 0, CEILING), paint("white")),
            Piece("boards", joined(boards), wood),
            Piece("sides", joined(sides), wood),
            Piece(
                "back",
                box(_WIDTH, 0.006, 3 * step).moved(0, _DEPTH, _MIDDLE - step),
                paint("brown", "umber", "noise", 0.1),
            ),
            Piece("lips", joined(lips), paint("white")),
        ),
    )


def _poses(views: int, rng: np.random.Generator) -> Float64:
    """World-to-camera [views, 4, 4]: in rows of five, one above the other."""
    poses = []
    rows = max((views + 4) // 5 - 1, 1)
    for k in range(views):
        u, v = k % 5 / 4 - 0.5, k // 5 / rows - 0.5
        x, y = 0.7 * u + rng.uniform(-0.03, 0.03), 0.12 * abs(u) - 0.62 + rng.uniform(-0.05, 0.05)
        eye = np.array([x, y, _MIDDLE + 0.2 + 0.5 * v + rng.uniform(-0.03, 0.03)])
        poses.append(looking_at(eye, np.array([0.15 * u, 0.15, _MIDDLE + 0.14 + 0.25 * v])))
    return np.stack(poses)
