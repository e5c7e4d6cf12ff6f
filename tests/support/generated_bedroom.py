"""A generated bedroom as a depth camera sees it: a bed with pillows, a wardrobe, a chest of drawers, a night stand with
a lamp, a rug, a stool, a basket, curtains and pictures, in 24 views.

Soft and large things, of which a view shows a part; what lies on the bed lies on no plane.
"""

from __future__ import annotations

import numpy as np
from depth_sensor import sensed
from furniture import BED_TOP, CHEST, basket, bed, chest, clock, curtain, lamp, pillow, rug, stool, wardrobe
from household import bag, bare_room, duck, jar, plant, room_of, sized, skirting_board

from ss_flow.flows.generated.composites import Composite, Piece, book, cup, paint, picture, printed_box, stood_up
from ss_flow.flows.generated.layout import COLORS, HALF_WIDTH
from ss_flow.flows.generated.prints import rectangle, sheet
from ss_flow.flows.generated.room import Room, looking_at
from ss_flow.flows.generated.shapes import box, can, joined
from ss_flow.tasks.artifacts import Float64

_VIEWS = 24
_WALL = HALF_WIDTH - 0.01
_WINDOW = 0.75
"""Where the middle of the window is, along the wall at -x."""


def generate_bedroom(seed: int, views: int = _VIEWS, width: int = 480, height: int = 360) -> Room:
    """Build and photograph a bedroom; the same seed gives the same arrays. Raises InputError without open3d.

    Of the views, of `width` x `height` pixels, a third each looks at the bed, the chest and the wardrobe. Instance 0 is
    the room with its window. None is held out. The depth is that of a camera as the first Kinect, 0 where it is
    unknown.
    """
    rng = np.random.default_rng(9000 + seed)
    things, middle = _furnish(rng)
    return sensed(room_of(things, _poses(views, middle, rng), seed, (width, height), rng), seed)


def _furnish(rng: np.random.Generator) -> tuple[list[Composite], float]:
    """The structure and the things, in the order of their ids; and the middle of the bed along x."""
    c = [str(name) for name in rng.permutation(list(COLORS))]
    wide, middle = float(rng.choice([1.0, 1.4])), rng.uniform(-0.4, -0.1)
    wood = str(rng.choice(["tan", "brown", "white", "grey"]))
    things = [
        _structure(),
        bed(wood, c[0], str(rng.choice(["stripes", "noise", "checks"])), wide).moved(middle, 0.96, 0),
    ]
    linen = [("white", c[2]), (c[1], c[1]), ("white", "white")][rng.integers(3)]
    for x in (-0.33, 0.33) if wide > 1.2 else (0.0,):
        lying = pillow(*linen, (0.6, 0.38, 0.15)).turned(rng.uniform(-0.15, 0.15))
        things.append(lying.moved(middle + x, 1.65, BED_TOP - 0.03))
    things.append(pillow(c[3], c[3], (0.4, 0.4, 0.16)).turned(rng.uniform(0, 1.5)).moved(middle + 0.1, 1.0, BED_TOP))
    on_bed = [sized(book(c[4], c[5]), 0.8), bag(c[4], c[5]).turned(-np.pi / 2, axis=0).moved(0, 0, 0.035)]
    on_bed.append(sized(duck("yellow", "orange"), 2.2))
    lying = on_bed[rng.integers(3)].turned(rng.uniform(0, 6))
    things.append(lying.moved(middle - 0.2, 0.5 + rng.uniform(-0.2, 0.2), BED_TOP + 0.01))

    beside = middle + wide / 2 + 0.32
    stand = 0.42, 0.36, float(rng.uniform(0.45, 0.55))
    things.append(chest(wood, c[6], stand, 2).moved(beside, _WALL - 0.2, 0))
    things.append(lamp("black", c[1]).moved(beside + 0.07, _WALL - 0.2, stand[2]))
    small = clock(c[7]) if rng.random() < 0.5 else sized(cup(c[7], "white", "white"), 0.6)
    things.append(small.turned(rng.uniform(-0.5, 0.5)).moved(beside - 0.12, _WALL - 0.27, stand[2]))

    leaves = int(rng.choice([2, 3]))
    closet = wardrobe(str(rng.choice(["white", "tan", "grey"])), c[8] if c[8] != "black" else "sky", leaves)
    things.append(closet.turned(-np.pi / 2).moved(_WALL - 0.28, -0.7 + rng.uniform(-0.15, 0.15), 0))
    along = -0.95 + rng.uniform(-0.1, 0.1)
    things.append(chest(str(rng.choice(["white", "umber", "ochre"])), c[5], CHEST, 3).turned(np.pi / 2)
                  .moved(0.22 - _WALL, along, 0))  # fmt: skip
    goods = [plant(c[2], rng), jar(c[3], c[0]), stood_up(sized(book(c[6], "white"), 0.7)), bag(c[7], c[1]),
             sized(printed_box([*c[2:], *c[:2]], rng), 0.5)]  # fmt: skip
    for y, i in zip((-0.26, 0.0, 0.26), rng.permutation(len(goods)).tolist(), strict=False):
        things.append(goods[i].turned(np.pi / 2 + rng.uniform(-0.4, 0.4)).moved(0.22 - _WALL, along + y, CHEST[2]))

    things.append(rug(c[7], c[4], (1.7, 1.0)).turned(rng.uniform(-0.08, 0.08)).moved(middle, -0.5, 0))
    things.append(stool(c[1], c[6]).moved(middle + 0.4, -0.4 + rng.uniform(-0.15, 0.1), 0.0125))
    things.append(basket(str(rng.choice(["tan", "sand"])), c[0]).moved(-1.5, -0.15 + rng.uniform(-0.1, 0.1), 0))
    for side in (-1, 1):
        hung = curtain(c[8] if c[8] != "black" else "sky", c[2], float(rng.uniform(0.3, 0.5)), 1.9)
        things.append(hung.turned(np.pi / 2).moved(-_WALL, _WINDOW + side * 0.6, 0.2))
    inks = c[3], c[5], c[7], c[0]
    things.append(picture("black", inks).moved(middle + rng.uniform(-0.2, 0.2), _WALL, 1.5))
    things.append(picture("umber", inks[::-1]).turned(-np.pi / 2).moved(_WALL, 0.85 + rng.uniform(-0.1, 0.1), 1.45))
    return things, middle


def _structure() -> Composite:
    """Floor, walls, a window with a rod over it, a skirting board."""
    bars = [box(1.0, 0.05, 0.05).moved(0, -0.02, z) for z in (0.9, 1.42, 1.95)]
    bars += [box(0.05, 0.05, 1.1).moved(x, -0.02, 0.9) for x in (-0.5, 0, 0.5)]
    rod = can(0.012, 1.8).moved(0, 0, -0.9).turned(np.pi / 2, axis=1).moved(0, -0.09, 2.12)
    glass, bars_, rod = (
        mesh.turned(np.pi / 2).moved(-HALF_WIDTH, _WINDOW, 0)
        for mesh in (sheet([rectangle(0, 1.45, 1.0, 1.1)], 0.005), joined(bars), rod)
    )
    return Composite(
        "grey structure",
        (
            *bare_room(paint("tan", "ochre", "planks", 0.2)),
            skirting_board(),
            Piece("glass", glass, paint("sky")),
            Piece("bars", bars_, paint("white")),
            Piece("rod", rod, paint("umber")),
        ),
    )


def _poses(views: int, middle: float, rng: np.random.Generator) -> Float64:
    """World-to-camera [views, 4, 4]: to the bed, to the chest, to the wardrobe, in turn, each on an arc."""
    arcs = (
        ((middle, 0.8, 0.5), 2.0, (-2.5, -0.6)),
        ((-1.7, -0.25, 0.75), 2.5, (-0.65, 0.6)),
        ((0.9, -0.45, 0.7), 2.2, (2.4, 3.8)),
    )
    poses = []
    for k in range(views):
        target, far, (first, last) = arcs[k % 3]
        angle = first + (last - first) * (k / max(views - 1, 1)) + rng.uniform(-0.05, 0.05)
        eye = np.array(target) + far * np.array([np.cos(angle), np.sin(angle), 0])
        eye[:2] = np.clip(eye[:2], -HALF_WIDTH + 0.15, HALF_WIDTH - 0.15)
        eye[2] = 1.5 + rng.uniform(-0.15, 0.15)
        poses.append(looking_at(eye, np.array(target) + rng.uniform(-0.15, 0.15, 3)))
    return np.stack(poses)
