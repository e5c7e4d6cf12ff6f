"""A generated work place as a phone with a depth sensor sees it: a desk with a monitor, a keyboard, a mouse on a cable,
a lamp, papers, pencils and a plant, a chair that turns before it, notes on the wall behind; 28 photos from both sides.

The screen is dark and glossy: it has no depth. Photos are exposed anew on the way.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from depth_sensor import structured_light
from generated_walk import by_phone
from household import pencils, plant, room_of, sized
from office import desk_lamp, keyboard, monitor, mouse, office_chair, papers, writing_desk

from ss_flow.flows.generated.composites import Composite, Piece, book, cup, paint
from ss_flow.flows.generated.layout import CEILING, COLORS, HALF_WIDTH
from ss_flow.flows.generated.prints import LIFT, lines_of_text, rectangle, sheet
from ss_flow.flows.generated.room import Room, looking_at
from ss_flow.flows.generated.shapes import box, joined
from ss_flow.tasks.artifacts import Float64

_VIEWS = 28
_SIZE = 1.4, 0.7, 0.74
"""Of the desk, along x, y, z, metres."""
_LOST = 0.9
"""Share of the screen that has no depth."""


def generate_office(seed: int, views: int = _VIEWS, width: int = 0, height: int = 0) -> Room:
    """Build and photograph a work place; the same seed gives the same arrays. Raises InputError without open3d.

    The views are of `width` x `height` pixels; if not told, of 640 x 480, upright where the seed is odd. Every second
    one is near. Instance 0 is the room with the notes. None is held out. The depth is that of a camera as the first
    Kinect, 0 where it is unknown.
    """
    rng = np.random.default_rng(17000 + seed)
    things, chair = _furnish(rng)
    size = (width, height) if width and height else (480, 640) if seed % 2 else (640, 480)
    room = room_of(things, _poses(views, chair, rng), seed, size, rng)
    depth = np.stack([structured_light(of_view, rng) for of_view in room.depth])
    shown = next(thing for thing in room.objects if thing.name.endswith("monitor"))
    screen = (room.ids == shown.instance_id) & (room.parts == 1 + shown.parts.index("screen"))
    depth = np.where(screen & (rng.random(screen.shape) < _LOST), 0, depth)
    return replace(room, rgb=by_phone(room.rgb, rng), depth=depth)


def _furnish(rng: np.random.Generator) -> tuple[list[Composite], Float64]:
    """The structure and the things, in the order of their ids; and where the chair is, [2]."""
    c = [str(name) for name in rng.permutation(list(COLORS))]
    dark, light = (
        [("black", "grey"), ("grey", "white"), ("white", "grey")][rng.integers(3)],
        str(rng.choice(["tan", "white"])),
    )
    side = float(rng.choice([-1, 1]))
    y, top = HALF_WIDTH - 0.4, _SIZE[2]
    on_it = [
        monitor(dark[0], "black", (c[0], "white")).turned(rng.uniform(-0.15, 0.15)).moved(0, 0.18, 0),
        keyboard(dark[0], dark[1]).turned(rng.uniform(-0.1, 0.1)).moved(rng.uniform(-0.03, 0.03), -0.12, 0),
        mouse(dark[0], c[1], 0.3).turned(rng.uniform(-0.2, 0.2)).moved(0.31, -0.14, 0),
        desk_lamp(c[2], "grey").turned(np.pi * (side > 0) + rng.uniform(-0.5, 0.5)).moved(side * 0.52, 0.18, 0),
        plant(c[3], rng).moved(-side * 0.48, 0.2, 0),
        pencils(c[4], [c[i] for i in (0, 1, 3, 5, 6)]).moved(side * 0.38, 0.1, 0),
        papers(rng).turned(rng.uniform(-0.4, 0.4)).moved(-0.45, -0.12, 0),
        sized(cup(c[5], "white", c[6]), 0.55).turned(rng.uniform(0, 6)).moved(0.52, -0.08, 0),
    ]
    if rng.random() < 0.5:
        on_it.append(sized(book(c[7], "white"), 0.7).turned(rng.uniform(-1, 1)).moved(-side * 0.3, 0.2, 0))
    chair = np.array([rng.uniform(-0.15, 0.15), y - 0.75 + rng.uniform(-0.1, 0.05)])
    things = [_structure(rng, y), writing_desk(light, "umber", _SIZE).moved(0, y, 0)]
    things += [thing.moved(0, y, top) for thing in on_it]
    things.append(
        office_chair(c[6], "black" if rng.random() < 0.6 else "grey")
        .turned(np.pi + rng.uniform(-0.9, 0.9))
        .moved(*chair, 0)
    )
    return things, chair


def _structure(rng: np.random.Generator, y: float) -> Composite:
    """Floor and walls, notes on the wall behind the desk."""
    size = 2 * HALF_WIDTH
    wall = sheet([rectangle(0, CEILING / 2, size, CEILING)]).moved(0, HALF_WIDTH, 0)
    floor = [paint("tan", "ochre", "planks", 0.2), paint("grey", "sand", "noise", 0.1)][rng.integers(2)]
    pieces = [
        Piece("floor", box(size, size, 0.02).moved(0, 0, -0.02), floor),
        Piece("walls", joined([wall.turned(k * np.pi / 2) for k in range(4)]), paint("cream", "sand", "noise", 0.14)),
        Piece("ceiling", box(size, size, 0.02).moved(0, 0, CEILING), paint("white")),
    ]
    for x, color in zip(np.linspace(-0.7, 0.7, 6), rng.choice(["yellow", "pink", "white", "sky"], 6), strict=True):
        at = x + rng.uniform(-0.05, 0.05), HALF_WIDTH, 1.35 + rng.uniform(-0.1, 0.15)
        pieces.append(Piece("notes", sheet([rectangle(0, 0, 0.12, 0.12)], LIFT).moved(*at), paint(str(color))))
        pieces.append(Piece("notes", sheet(lines_of_text(0.1, 0.09, 4), 2 * LIFT).moved(*at), paint("black")))
    return Composite("grey structure", tuple(pieces))


def _poses(views: int, chair: Float64, rng: np.random.Generator) -> Float64:
    """World-to-camera [views, 4, 4]: in an arc before the desk and its chair, from afar and near in turn."""
    poses = []
    middle = np.array([0.0, HALF_WIDTH - 0.45])
    for k in range(views):
        angle = -np.pi / 2 + 2.2 * (k / max(views - 1, 1) - 0.5) + rng.uniform(-0.03, 0.03)
        far = rng.uniform(1.9, 2.3) if k % 2 == 0 else rng.uniform(0.95, 1.2)
        eye = middle + far * np.array([np.cos(angle), np.sin(angle)])
        eye[0] = np.clip(eye[0], -1.85, 1.85)
        low = 0.62 if k % 2 == 0 else 0.82
        target = np.array([*(0.75 * middle + 0.25 * chair if k % 2 == 0 else middle), low]) + rng.uniform(
            -0.08, 0.08, 3
        )
        poses.append(looking_at(np.array([*eye, 1.4 + rng.uniform(-0.15, 0.2)]), target))
    return np.stack(poses)
