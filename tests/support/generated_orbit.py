"""One thing, walked round with a phone that measures depth: 26 near photos of a teapot, a robot, a shoe, a handbag or a
truck, alone on a small table or on a plain floor before plain walls.

The thing fills a third of the picture. Curved surfaces of few colours that meet in soft edges, and nothing else to
tell what belongs together.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from depth_sensor import seen_near
from furniture import stool
from generated_walk import by_phone
from household import bare_room, room_of, round_table, sized, skirting_board
from toys import handbag, robot, shoe, teapot, truck

from ss_flow.flows.generated.composites import Composite, paint
from ss_flow.flows.generated.layout import COLORS
from ss_flow.flows.generated.room import Room, looking_at
from ss_flow.tasks.artifacts import Float64

_VIEWS = 26
_THINGS = teapot, robot, shoe, handbag, truck
_FAR = 1.7
"""Distance of the phone from the thing's middle, in multiples of the thing's length from end to end."""


def generate_orbit(seed: int, views: int = _VIEWS, width: int = 0, height: int = 0) -> Room:
    """Build one thing and photograph it; the same seed gives the same arrays. Raises InputError without open3d.

    Another seed is another thing, five in turn. The views are of `width` x `height` pixels; if not told, of 640 x 480,
    upright where the seed is odd. Instance 0 is the room, 1 the thing, 2 what it stands on, if not the floor. None is
    held out. Depth is 0 where it is unknown.
    """
    rng = np.random.default_rng(11000 + seed)
    things, middle, length = _furnish(seed, rng)
    size = (width, height) if width and height else (480, 640) if seed % 2 else (640, 480)
    room = room_of(things, _poses(views, middle, _FAR * length, rng), seed, size, rng)
    depth = np.stack([seen_near(of_view, rng) for of_view in room.depth])
    return replace(room, rgb=by_phone(room.rgb, rng), depth=depth)


def _furnish(seed: int, rng: np.random.Generator) -> tuple[list[Composite], Float64, float]:
    """The structure and the things, in the order of their ids; the middle [3] of the first thing and its length."""
    c = [str(name) for name in rng.permutation([*COLORS, "white", "tan"])]
    thing = sized(_THINGS[seed % len(_THINGS)](c[0], c[1], c[2]), float(rng.uniform(0.9, 1.4)))
    thing = thing.turned(rng.uniform(0, 2 * np.pi))
    low, high = thing.bounds
    stands = [None, sized(stool(c[3], c[4]), 1.2), round_table("brown", "black", 0.6)][rng.integers(3)]
    top = stands.bounds[1, 2] if stands else 0.0
    x, y = rng.uniform(-0.3, 0.3, 2)
    middle = np.array([x, y, top]) + (low + high) / 2 * (0, 0, 1)
    things = [_structure(rng), thing.moved(x, y, top)]
    if stands:
        things.append(stands.moved(x + rng.uniform(-0.05, 0.05), y, 0))
    return things, middle, float(np.linalg.norm(high - low))


def _structure(rng: np.random.Generator) -> Composite:
    """Floor, walls, a skirting board."""
    floor = [paint("tan", "ochre", "planks", 0.2), paint("grey", "sand", "noise", 0.1), paint("sand")][rng.integers(3)]
    return Composite("grey structure", (*bare_room(floor), skirting_board()))


def _poses(views: int, middle: Float64, far: float, rng: np.random.Generator) -> Float64:
    """World-to-camera [views, 4, 4]: once round the middle, up and down on the way, by hand."""
    poses = []
    for k in range(views):
        around = 2 * np.pi * (k + rng.uniform(-0.2, 0.2)) / views
        rise = 0.55 + 0.25 * np.sin(2 * around) + rng.uniform(-0.05, 0.05)
        ray = np.array([np.cos(rise) * np.cos(around), np.cos(rise) * np.sin(around), np.sin(rise)])
        poses.append(looking_at(middle + far * rng.uniform(0.95, 1.1) * ray, middle + 0.05 * far * rng.normal(size=3)))
    return np.stack(poses)
