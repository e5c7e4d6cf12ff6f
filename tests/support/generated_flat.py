"""Two rooms and the door between them, as a depth sensor sees them that is carried through: 64 views.

A table with a mug, a book and a bowl on it, seen from both rooms, chairs, a chest of drawers, a wardrobe, a shelf of
boxes. Things in one room are seen from afar through the door, or not at all; the sensor measures nothing beyond 4 m.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from depth_sensor import sensed
from furniture import CHEST, basket, chest, lamp, pillow, rug, stool, wardrobe
from household import bag, bowl_of_fruit, jar, plant, room_of, sized, wooden_chair

from ss_flow.flows.generated.composites import (
    Composite,
    Piece,
    book,
    cup,
    paint,
    picture,
    printed_box,
    slatted_chair,
)
from ss_flow.flows.generated.layout import CEILING, COLORS
from ss_flow.flows.generated.prints import rectangle, sheet
from ss_flow.flows.generated.room import Room, looking_at
from ss_flow.flows.generated.shapes import Mesh, box, joined
from ss_flow.tasks.artifacts import Float64

_VIEWS = 64
_LONG, _HALF = 3.4, 1.7
"""Each room reaches so far from the wall between them, along x, and half as far to each side of y = 0; metres."""
_DOOR, _LINTEL, _THICK = 0.9, 2.05, 0.12
"""Width and height of the doorway, and how thick the wall is."""
_RANGE = 4.0
_TABLE = 1.1, 0.75, 0.74


def generate_flat(seed: int, views: int = _VIEWS, width: int = 480, height: int = 360) -> Room:
    """Build and photograph two rooms; the same seed gives the same arrays. Raises InputError without open3d.

    Of the views, of `width` x `height` pixels, half are taken in the one room, the next in the doorway, the rest in the
    other. Instance 0 is the rooms with the door's frame. None is held out. The depth is that of a camera as the first
    Kinect up to 4 m, 0 where it is unknown.
    """
    rng = np.random.default_rng(13000 + seed)
    things = _furnish(rng)
    flat = sensed(room_of(things, _poses(views, rng), seed, (width, height), rng), seed)
    return replace(flat, depth=np.where(flat.depth > _RANGE, 0, flat.depth))


def _furnish(rng: np.random.Generator) -> list[Composite]:
    """The structure and the things, in the order of their ids."""
    c = [str(name) for name in rng.permutation(list(COLORS))]
    wood = str(rng.choice(["tan", "brown", "white"]))
    x, y, top = -0.95, rng.uniform(-0.15, 0.15), _TABLE[2]
    things = [_structure(rng), _table(wood, "umber").moved(x, y, 0)]
    on_it = [sized(cup(c[0], "white", c[1]), 0.6), sized(book(c[2], c[3]), 0.8),
             sized(bowl_of_fruit(c[4], (c[1], c[5], c[3])), 0.9)]  # fmt: skip
    for thing, along in zip(on_it, rng.permutation([-0.38, 0.0, 0.38]).tolist(), strict=True):
        things.append(thing.turned(rng.uniform(0, 6)).moved(x + along, y + rng.uniform(-0.15, 0.15), top))
    seats = [wooden_chair(c[6], "umber"), slatted_chair(c[7], "grey"), wooden_chair(c[6], "umber")]
    at = (x - 0.2, y - 0.75, np.pi), (x + 0.25, y + 0.75, 0.0), (x - 0.95, y, np.pi / 2)
    for seat, (sx, sy, turn) in zip(seats, at, strict=True):
        away = rng.uniform(-0.1, 0.1, 2)
        things.append(seat.turned(turn + rng.uniform(-0.4, 0.4)).moved(sx + away[0], sy + away[1], 0))
    far = 0.01 - _LONG
    side = float(rng.choice([-1, 1]))
    things.append(chest(wood, c[8] if c[8] != "black" else "sky", CHEST, 3).turned(np.pi / 2)
                  .moved(far + 0.22, side * 0.9, 0))  # fmt: skip
    goods = [lamp("black", c[1]), plant(c[5], rng), jar(c[3], c[0]), bag(c[7], c[2]),
             sized(printed_box([*c[2:], *c[:2]], rng), 0.6)]  # fmt: skip
    chosen = rng.permutation(len(goods)).tolist()
    for along, i in zip((-0.22, 0.2), chosen, strict=False):
        things.append(goods[i].turned(np.pi / 2).moved(far + 0.22, side * 0.9 + along, CHEST[2]))
    things.append(picture("black", (c[3], c[5], c[7], c[0])).turned(np.pi / 2).moved(far, -side * 0.7, 1.45))

    far = _LONG - 0.01
    closet = wardrobe("white" if wood == "tan" else "grey", c[1], 2)
    things.append(closet.turned(-np.pi / 2).moved(far - 0.28, side * 0.8, 0))
    things.append(chest(wood, c[4], (0.7, 0.36, 0.5), 2).moved(1.5 + rng.uniform(-0.2, 0.2), _HALF - 0.2, 0))
    things.append(goods[chosen[2]].moved(1.4 + rng.uniform(-0.1, 0.1), _HALF - 0.2, 0.5))
    things.append(rug(c[7], c[4], (1.5, 1.0)).moved(1.7, -0.1, 0))
    things.append(stool(c[0], c[6]).moved(1.9 + rng.uniform(-0.2, 0.2), rng.uniform(-0.3, 0.1), 0.0125))
    things.append(basket("tan", c[3]).moved(0.45, -side * 1.3, 0))
    things.append(slatted_chair(c[2], "umber").turned(-np.pi / 2 - 0.4).moved(far - 0.5, -side * 0.9, 0))
    things.append(pillow(c[5], "white", (0.36, 0.36, 0.13)).moved(far - 0.52, -side * 0.9, 0.44))
    things.append(picture("umber", (c[0], c[6], c[2], c[8])).turned(np.pi).moved(1.2, -_HALF + 0.01, 1.4))
    return things


def _table(top: str, legs: str) -> Composite:
    """A table on four legs."""
    width, depth, height = _TABLE
    thick, leg = 0.04, 0.06
    x, y = width / 2 - leg, depth / 2 - leg
    posts = [box(leg, leg, height - thick).moved(i * x, j * y, 0) for i in (-1, 1) for j in (-1, 1)]
    frame = [box(2 * x, 0.02, 0.08).moved(0, j * y, height - thick - 0.08) for j in (-1, 1)]
    return Composite(
        f"{top} table",
        (
            Piece("top", box(width, depth, thick).moved(0, 0, height - thick), paint(top)),
            Piece("legs", joined([*posts, *frame]), paint(legs)),
        ),
    )


def _structure(rng: np.random.Generator) -> Composite:
    """Floors and walls of both rooms, the wall between them, the frame of its door."""
    high, beside = CEILING, _HALF - _DOOR / 2
    post = 0.07

    def walls(side: int) -> Mesh:
        ends = sheet([rectangle(0, high / 2, 2 * _HALF, high)]).turned(-side * np.pi / 2).moved(side * _LONG, 0, 0)
        long = sheet([rectangle(side * _LONG / 2, high / 2, _LONG, high)]).moved(0, _HALF, 0)
        other = sheet([rectangle(-side * _LONG / 2, high / 2, _LONG, high)]).moved(0, _HALF, 0).turned(np.pi)
        return joined([ends, long, other])

    middle = [box(_THICK, beside, high).moved(0, s * (_DOOR + beside) / 2, 0) for s in (-1, 1)]
    middle.append(box(_THICK, _DOOR, high - _LINTEL).moved(0, 0, _LINTEL))
    frame = [box(_THICK + 0.04, post, _LINTEL + post).moved(0, s * (_DOOR + post) / 2, 0) for s in (-1, 1)]
    frame.append(box(_THICK + 0.04, _DOOR, post).moved(0, 0, _LINTEL))
    floors = paint("tan", "ochre", "planks", 0.2), paint("grey", "sand", "checks", 0.3), paint("brown", "umber")
    i, j = rng.permutation(3)[:2]
    return Composite(
        "grey structure",
        (
            Piece("floor", box(_LONG, 2 * _HALF, 0.02).moved(-_LONG / 2, 0, -0.02), floors[i]),
            Piece("floor", box(_LONG, 2 * _HALF, 0.02).moved(_LONG / 2, 0, -0.02), floors[j]),
            Piece("ceiling", box(2 * _LONG, 2 * _HALF, 0.02).moved(0, 0, high), paint("white")),
            Piece("walls", walls(-1), paint("cream", "sand", "noise", 0.14)),
            Piece("walls", walls(1), paint("sky", "white", "noise", 0.14)),
            Piece("between", joined(middle), paint("cream")),
            Piece("frame", joined(frame), paint("white")),
        ),
    )


def _poses(views: int, rng: np.random.Generator) -> Float64:
    """World-to-camera [views, 4, 4]: round the table in the one room, through the door, round the other room."""
    poses = []
    way = np.array([(-0.3, 1.2), (-1.5, 1.35), (-2.4, 1.0), (-2.6, 0.0), (-2.3, -1.2), (-1.2, -1.35), (-0.35, -1.2),
                    (-0.3, -0.2), (0.1, 0.0), (0.6, 0.3), (1.0, 1.0), (2.2, 1.0), (2.6, 0.1), (2.3, -1.1), (1.0, -1.1),
                    (0.5, 0.0)])  # fmt: skip
    gaze = np.array([(-1.2, -0.2), (-1.2, -0.3), (-1.4, -0.5), (-0.9, 0.0), (-1.0, 0.3), (-1.5, 0.5), (-2.2, 0.8),
                     (-2.6, 0.0), (3.0, 0.4), (2.6, -0.4), (2.4, -1.0), (1.3, -1.2), (0.8, -0.3), (1.5, 1.5),
                     (2.9, 0.9), (-1.2, 0.0)])  # fmt: skip
    for k in range(views):
        at = (len(way) - 1) * k / max(views - 1, 1)
        steps = np.arange(len(way))
        eye, target = (np.array([np.interp(at, steps, axis) for axis in line.T]) for line in (way, gaze))
        eye = np.array([*(eye + rng.uniform(-0.05, 0.05, 2)), 1.5 + rng.uniform(-0.1, 0.1)])
        poses.append(looking_at(eye, np.array([*(target + rng.uniform(-0.15, 0.15, 2)), 0.6 + rng.uniform(-0.1, 0.2)])))
    return np.stack(poses)
