"""A generated room of composite things: what stands and hangs where, where to look at it from, and a gripper."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ss_flow.flows.generated.composites import (
    Composite,
    Piece,
    book,
    brick,
    cup,
    furry_head,
    paint,
    picture,
    plaque,
    printed_box,
    slatted_chair,
    stood_up,
)
from ss_flow.flows.generated.layout import CEILING, COLORS, HALF_WIDTH, Thing
from ss_flow.flows.generated.prints import ellipse, rectangle, sheet
from ss_flow.flows.generated.shapes import ball, box, joined, vase
from ss_flow.tasks.artifacts import Float64

GAZE = 0.8
"""Height that the views round the room look at, metres: between the table and what hangs on the wall."""

TABLE = 1.3, 0.85, 0.5
"""Width, depth and height, metres."""
_CABINET = 0.9, 0.36, 0.62
_MOTIF = 0.34
"""Distance between the motifs of the wallpaper, metres."""


@dataclass(frozen=True)
class Station:
    """Something to photograph from close by."""

    target: tuple[float, float, float]
    facing: float
    """Direction, about z in radians, in which the camera stands from the target."""
    spread: float
    """How far to either side of it the camera may stand, radians."""
    rise: tuple[float, float]
    """Least and greatest elevation of the camera, radians."""
    distance: tuple[float, float]
    """Least and greatest distance, metres."""


def furnish_composites(rng: np.random.Generator) -> tuple[tuple[Thing, ...], tuple[Station, ...]]:
    """Everything in the room (structure: id 0, its parts the floor, the ceiling and the walls), and the stations.

    On a table, side by side or all but touching: a mug, a printed box, a brick, a lying book, a vase. A chair of
    slats beside it; a cabinet with a standing book; a furry head on a plaque and a picture on a papered wall.
    """
    c = [str(name) for name in rng.permutation(list(COLORS))]
    x, y, turn = rng.uniform(-0.12, 0.12), 0.2 + rng.uniform(-0.1, 0.1), rng.uniform(-0.2, 0.2)
    front = [cup(c[0], c[8], "white"), printed_box(c[2:], rng), brick(c[1], "grey", rng)]
    back = [book(c[3], c[4]), Composite(f"{c[5]} vase", (Piece("vase", vase(0.1, 0.32), paint(c[5])),))]
    on_table = [*in_a_row(front, -0.19, rng), *in_a_row(back, 0.22, rng)]
    on_table = [thing.moved(0, 0, TABLE[2]).turned(turn).moved(x, y, 0) for thing in on_table]
    side = rng.choice([-1.0, 1.0])
    chair_at = side * rng.uniform(1.1, 1.3), y + rng.uniform(-0.8, -0.5)
    chair = slatted_chair(c[6], "umber").turned(rng.uniform(0, 2 * np.pi)).moved(*chair_at, 0)
    wall = HALF_WIDTH - 0.005
    along = rng.uniform(-0.4, 0.4)
    cabinet_at = _CABINET[1] / 2 - wall, along
    standing = stood_up(book(c[7], c[8])).turned(rng.uniform(0.3, 0.9))
    on_cabinet = [cabinet("white", c[4]), standing.moved(rng.uniform(-0.25, 0.25), 0, _CABINET[2])]
    on_cabinet = [thing.turned(np.pi / 2).moved(*cabinet_at, 0) for thing in on_cabinet]
    left = rng.choice([-1.0, 1.0])
    head_at, picture_at = (left * rng.uniform(0.45, 0.7), 1.22), (-left * rng.uniform(0.45, 0.7), 1.25)
    hung = [plaque("tan", c[1]).moved(head_at[0], wall, head_at[1])]
    hung.append(furry_head("brown", "tan", "pink", rng).moved(head_at[0], wall - 0.16, head_at[1] + 0.02))
    hung.append(picture(c[2], [c[3], "yellow", c[0], c[6]]).moved(picture_at[0], wall, picture_at[1]))
    things = [table().turned(turn).moved(x, y, 0), *on_table, chair, *on_cabinet, *hung]
    pieces = structure(c[8], rng).things(0)
    for instance_id, thing in enumerate(things, 1):
        pieces += thing.things(instance_id)
    middle = [tuple(thing.bounds.mean(axis=0)) for thing in on_table]
    # Across the rows, so that no thing stands before its neighbour.
    across = [-np.pi / 2] * len(front) + [np.pi / 2] * len(back)
    over_table = [Station(m, a + turn, 0.9, (0.4, 0.75), (0.5, 0.75)) for m, a in zip(middle, across, strict=True)]
    to_head, to_picture = (
        Station((at[0], wall, at[1]), -np.pi / 2, 0.8, (-0.1, 0.2), (0.8, 1.1)) for at in (head_at, picture_at)
    )
    to_chair = Station((*chair_at, 0.45), float(np.arctan2(-chair_at[1], -chair_at[0])), 0.8, (0.5, 0.8), (0.9, 1.2))
    to_cabinet = Station((*cabinet_at, 0.7), 0.0, 0.7, (0.3, 0.6), (0.9, 1.2))
    others = [to_head, to_cabinet, to_picture, to_chair, to_cabinet]
    stations = [s for pair in zip(over_table, others, strict=True) for s in pair]
    return pieces, tuple(stations)


def close_up(station: Station, rng: np.random.Generator) -> tuple[Float64, Float64]:
    """Where a camera stands for a station, and what it looks at: two points, world."""
    angle = station.facing + station.spread * rng.uniform(-1, 1)
    rise, distance = rng.uniform(*station.rise), rng.uniform(*station.distance)
    out = np.array([np.cos(rise) * np.cos(angle), np.cos(rise) * np.sin(angle), np.sin(rise)])
    target = np.array(station.target)
    return target + distance * out, target + rng.uniform(-0.05, 0.05, 3)


def in_a_row(things: list[Composite], y: float, rng: np.random.Generator) -> list[Composite]:
    """Things in random order along x, each a little turned and at most 2 cm from the next."""
    placed: list[Composite] = []
    edge = 0.0
    for i in rng.permutation(len(things)):
        thing = things[i].turned(rng.uniform(-0.2, 0.2))
        edge += rng.uniform(0.002, 0.02)
        placed.append(thing.moved(edge - float(thing.bounds[0, 0]), y, 0))
        edge = float(placed[-1].bounds[1, 0])
    return [thing.moved(-edge / 2, 0, 0) for thing in placed]


def table() -> Composite:
    """A table: a top on four legs."""
    width, depth, height = TABLE
    x, y, thick, leg = width / 2 - 0.08, depth / 2 - 0.08, 0.05, 0.08
    legs = [box(leg, leg, height - thick).moved(i * x, j * y, 0) for i in (-1, 1) for j in (-1, 1)]
    return Composite(
        "brown table",
        (
            Piece("top", box(width, depth, thick).moved(0, 0, height - thick), paint("brown", "umber", "planks", 0.12)),
            Piece("legs", joined(legs), paint("umber")),
        ),
    )


def cabinet(body: str, doors: str) -> Composite:
    """A cabinet: two doors of another colour, with knobs."""
    width, depth, height = _CABINET
    leaf = [box(width / 2 - 0.04, 0.015, height - 0.1).moved(s * width / 4, -depth / 2, 0.05) for s in (-1, 1)]
    knobs = [ball(0.018).moved(s * 0.06, -depth / 2 - 0.02, 0.6 * height) for s in (-1, 1)]
    return Composite(
        f"{body} cabinet",
        (
            Piece("body", box(width, depth, height), paint(body)),
            Piece("doors", joined(leaf), paint(doors)),
            Piece("knobs", joined(knobs), paint("black")),
        ),
    )


def structure(ink: str, rng: np.random.Generator) -> Composite:
    """Floor, ceiling and walls; the wall at +y has a paper with flowers."""
    size = 2 * HALF_WIDTH
    wall = sheet([rectangle(0, CEILING / 2, size, CEILING)]).moved(0, HALF_WIDTH, 0)
    plain = paint("cream", "sand", "noise", 0.14)
    places = [
        (u + row % 2 * _MOTIF / 2, v)
        for row, v in enumerate(np.arange(rng.uniform(0.15, 0.3), CEILING - 0.1, _MOTIF))
        for u in np.arange(-HALF_WIDTH + 0.1, HALF_WIDTH - 0.3, _MOTIF)
    ]
    stems = [ellipse(u, v - 0.09, 0.03, 0.14, 0.2) for u, v in places]
    flowers = [ellipse(u, v, 0.15, 0.15, dents=5) for u, v in places]
    hearts = [ellipse(u, v, 0.045, 0.045) for u, v in places]
    printed = (stems, "green"), (flowers, ink), (hearts, "yellow")
    return Composite(
        "grey structure",
        (
            Piece("floor", box(size, size, 0.02).moved(0, 0, -0.02), paint("tan", "ochre", "planks", 0.2)),
            Piece("ceiling", box(size, size, 0.02).moved(0, 0, CEILING), paint("white")),
            *(Piece("walls", wall.turned(k * np.pi / 2), plain) for k in range(4)),
            *(
                Piece("walls", sheet(outlines, 0.0008 * i).moved(0, HALF_WIDTH, 0), paint(color))
                for i, (outlines, color) in enumerate(printed, 1)
            ),
        ),
    )


def gripper() -> tuple[Thing, ...]:
    """Two fingers and a palm as the lens sees them: in the camera's frame (x right, y down, z forward), before nothing
    (id 0)."""
    fingers = [box(0.022, 0.02, 0.09).turned(s * 0.35, axis=1).moved(s * 0.05, 0.062, 0.15) for s in (-1, 1)]
    palm = box(0.15, 0.04, 0.05).moved(0, 0.085, 0.13)
    pieces = Piece("fingers", joined(fingers), paint("black")), Piece("palm", palm, paint("grey"))
    nothing = box(20, 20, 20).moved(0, 0, -10)
    return (Thing(0, "nothing", "grey", nothing, paint("grey")), *Composite("black gripper", pieces).things(1))
