"""A generated kitchen as a depth camera sees it: a counter along a wall with eight things on it, a table with three and
two chairs, in 25 views.

Photographed from the room, from farther off than a desk: what stands on the table and on the counter is small and has
few points, and much of each chair is beside the picture or behind the table.
"""

from __future__ import annotations

import numpy as np
from depth_sensor import sensed
from household import (
    bare_room,
    bottle,
    bowl_of_fruit,
    cutting_board,
    jar,
    kettle,
    knife_block,
    microwave,
    plant,
    room_of,
    round_table,
    sized,
    toaster,
    wooden_chair,
)

from ss_flow.flows.generated.composites import Composite, Piece, book, cup, paint
from ss_flow.flows.generated.layout import COLORS, HALF_WIDTH
from ss_flow.flows.generated.prints import rectangle, sheet
from ss_flow.flows.generated.room import Room, looking_at
from ss_flow.flows.generated.shapes import box, joined
from ss_flow.tasks.artifacts import Float64

_VIEWS = 25
_DEPTH, _TOP = 0.6, 0.9
"""Depth of the counter and height of its worktop, metres."""
_TABLE_TOP = 0.735
_BEHIND = HALF_WIDTH - _DEPTH / 2
"""Where the things on the counter stand, along y."""


def generate_kitchen(seed: int, views: int = _VIEWS, width: int = 480, height: int = 360) -> Room:
    """Build and photograph a kitchen; the same seed gives the same arrays. Raises InputError without open3d.

    Of the views, of `width` x `height` pixels, every second looks at the counter, the others at the table. Instance 0
    is the room, the counter and the cupboards. None is held out. The depth is that of a camera as the first Kinect, 0
    where it is unknown.
    """
    rng = np.random.default_rng(5000 + seed)
    things, table = _furnish(rng)
    return sensed(room_of(things, _poses(views, table, rng), seed, (width, height), rng), seed)


def _furnish(rng: np.random.Generator) -> tuple[list[Composite], tuple[float, float]]:
    """The structure and the things, in the order of their ids; and where the table stands."""
    c = [str(name) for name in rng.permutation(list(COLORS))]
    places = np.linspace(-1.25, 1.25, 8) + rng.uniform(-0.05, 0.05, 8)
    goods = [
        microwave("white" if rng.random() < 0.5 else "grey", "black"),
        kettle(c[2], "black"),
        toaster("grey" if rng.random() < 0.5 else c[6], "black"),
        bowl_of_fruit(c[0], (c[1], c[4], c[3])),
        knife_block("tan", "black"),
        plant(c[5], rng),
        jar(c[7], c[0]),
        bottle("green", c[1], c[3], 0.038, 0.26),
    ]
    things = [_structure(c[8] if c[8] != "black" else "sky")]
    for x, i in zip(places.tolist(), rng.permutation(len(goods)).tolist(), strict=True):
        y, turn = _BEHIND - 0.03 + rng.uniform(-0.08, 0.08), rng.uniform(-0.35, 0.35)
        things.append(goods[i].turned(turn).moved(x, y, _TOP))
    leaning = cutting_board("tan").turned(1.25, axis=0)
    things.append(leaning.moved(float(places[3:5].mean()), HALF_WIDTH - 0.06, _TOP + 0.11))
    x, y = rng.uniform(-0.3, 0.3), -0.35 + rng.uniform(-0.1, 0.1)
    mug, lying = sized(cup(c[3], "white", "white"), 0.6), sized(book(c[7], c[1]), 0.8)
    things += [
        round_table("brown", "black", _TABLE_TOP).moved(x, y, 0),
        mug.turned(rng.uniform(0, 6)).moved(x - 0.15, y - 0.1, _TABLE_TOP),
        bottle(c[4], "white", "black", 0.038, 0.26).moved(x + 0.14, y + 0.08, _TABLE_TOP),
        lying.turned(rng.uniform(0, 6)).moved(x + 0.05, y - 0.2, _TABLE_TOP),
    ]
    for side, color in ((-1, c[6]), (1, c[2])):
        turn = rng.uniform(-0.3, 0.3) - side * np.pi / 2
        things.append(wooden_chair(color, "umber").turned(turn).moved(x + side * 0.68, y + rng.uniform(-0.1, 0.1), 0))
    return things, (x, y)


def _structure(doors: str) -> Composite:
    """Floor, walls, tiles, a counter with six doors, two cupboards on the wall."""
    front = HALF_WIDTH - _DEPTH
    tiles = [rectangle(x, z, 0.14, 0.14) for x in np.arange(-1.5, 1.51, 0.15) for z in np.arange(0.98, 1.4, 0.15)]
    leaves = np.linspace(-1.25, 1.25, 6)
    handles = [box(0.14, 0.02, 0.012).moved(x, front - 0.02, 0.7) for x in leaves]
    cupboards = [box(0.9, 0.32, 0.6).moved(x, HALF_WIDTH - 0.16, 1.5) for x in (-1, 1)]
    return Composite(
        "grey structure",
        (
            *bare_room(paint("grey", "sand", "checks", 0.3)),
            Piece("tiles", sheet(tiles, 0.004).moved(0, HALF_WIDTH, 0), paint("white")),
            Piece("counter", box(3.0, _DEPTH - 0.03, _TOP - 0.04).moved(0, _BEHIND + 0.01, 0), paint("white")),
            Piece(
                "worktop",
                box(3.04, _DEPTH + 0.02, 0.04).moved(0, _BEHIND - 0.01, _TOP - 0.04),
                paint("umber", "brown", "noise", 0.03),
            ),
            Piece("doors", joined([box(0.47, 0.018, 0.68).moved(x, front, 0.1) for x in leaves]), paint(doors)),
            Piece("handles", joined(handles), paint("grey")),
            Piece("cupboards", joined(cupboards), paint("white")),
        ),
    )


def _poses(views: int, table: tuple[float, float], rng: np.random.Generator) -> Float64:
    """World-to-camera [views, 4, 4]: along the counter, and round the table, in turn."""
    poses = []
    for k in range(views):
        along = k / max(views - 1, 1)
        if k % 2 == 0:
            eye = np.array([2.4 * along - 1.2 + rng.uniform(-0.05, 0.05), rng.uniform(-0.2, 0.25), 1.5])
            eye[2] += rng.uniform(-0.1, 0.15)
            target = np.array([0.85 * eye[0], _BEHIND, _TOP + 0.1])
        else:
            angle = 3.6 * (along - 0.5) - np.pi / 2
            eye = np.array([*(table + 1.25 * np.array([np.cos(angle), np.sin(angle)])), 1.45 + rng.uniform(-0.1, 0.2)])
            eye[:2] = np.clip(eye[:2], -1.85, 1.2)
            target = np.array([*table, 0.65])
        poses.append(looking_at(eye, target))
    return np.stack(poses)
