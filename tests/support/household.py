"""Things of a kitchen and of a shop's shelf, each one instance of several parts, and the photos of a room of them.

Lengths are metres. Every thing stands on z = 0 with its front towards -y.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ss_flow.flows.generated.composites import Composite, Piece, paint, stretched, tube
from ss_flow.flows.generated.layout import CEILING, HALF_WIDTH, Material
from ss_flow.flows.generated.prints import LIFT, ellipse, lines_of_text, on_face, rectangle, sheet
from ss_flow.flows.generated.render import Renderer
from ss_flow.flows.generated.room import Room, RoomParams, furnished_room, photographed
from ss_flow.flows.generated.shapes import Mesh, ball, bowl, box, can, joined, turned_profile
from ss_flow.tasks.artifacts import Float64


def room_of(
    things: Sequence[Composite], poses: Float64, seed: int, size: tuple[int, int], rng: np.random.Generator
) -> Room:
    """The photos of things, of which the first is the room itself (id 0), with exact depth; none is held out.

    poses: [K, 4, 4] world to camera. size: width and height of the photos.
    """
    pieces = tuple(piece for number, thing in enumerate(things) for piece in thing.things(number))
    renderer, (width, height) = Renderer(pieces, seed), size
    params = RoomParams(composite=True, views=len(poses), width=width, height=height, seed=seed, held_out=0)
    seen = photographed(renderer, poses, params, rng)
    return furnished_room(seen, photographed(renderer, np.zeros((0, 4, 4)), params, rng), pieces)


def bare_room(floor: Material) -> tuple[Piece, ...]:
    """Floor, walls and ceiling of an empty room, twice `HALF_WIDTH` wide and deep."""
    size = 2 * HALF_WIDTH
    wall = sheet([rectangle(0, CEILING / 2, size, CEILING)]).moved(0, HALF_WIDTH, 0)
    walls = joined([wall.turned(k * np.pi / 2) for k in range(4)])
    return (
        Piece("floor", box(size, size, 0.02).moved(0, 0, -0.02), floor),
        Piece("walls", walls, paint("cream", "sand", "noise", 0.14)),
        Piece("ceiling", box(size, size, 0.02).moved(0, 0, CEILING), paint("white")),
    )


def skirting_board() -> Piece:
    """The one round such a room."""
    board = box(2 * HALF_WIDTH, 0.012, 0.08).moved(0, HALF_WIDTH - 0.006, 0)
    return Piece("skirting", joined([board.turned(k * np.pi / 2) for k in range(4)]), paint("white"))


def sized(thing: Composite, factor: float) -> Composite:
    """All pieces scaled about the origin."""
    return replace(thing, pieces=tuple(replace(piece, mesh=piece.mesh.sized(factor)) for piece in thing.pieces))


def bottle(glass: str, label: str, cap: str, radius: float, height: float) -> Composite:
    """A bottle with a label and a band round it, and a cap."""
    neck = 0.38 * radius
    outline = [(0, 0), (radius, 0), (radius, 0.62 * height), (neck, 0.8 * height), (neck, 0.93 * height)]
    return Composite(
        f"{glass} bottle",
        (
            Piece("glass", turned_profile([*outline, (0, 0.93 * height)]), paint(glass)),
            Piece("label", _band(radius + LIFT, 0.18 * height, 0.5 * height), paint(label)),
            Piece("band", _band(radius + 2 * LIFT, 0.3 * height, 0.36 * height), paint("black")),
            Piece("cap", can(0.44 * radius, 0.09 * height).moved(0, 0, 0.93 * height), paint(cap)),
        ),
    )


def jar(glass: str, lid: str) -> Composite:
    """A jar with a label and a lid."""
    radius, height = 0.045, 0.13
    return Composite(
        f"{glass} jar",
        (
            Piece("glass", can(radius, 0.82 * height), paint(glass)),
            Piece("label", _band(radius + LIFT, 0.2 * height, 0.6 * height), paint("white")),
            Piece("lid", can(1.03 * radius, 0.18 * height).moved(0, 0, 0.82 * height), paint(lid)),
        ),
    )


def kettle(body: str, dark: str) -> Composite:
    """A kettle: a spout to -x, a handle to +x, a knob on top."""
    radius, height = 0.085, 0.2
    outline = [(0, 0), (radius, 0), (0.95 * radius, 0.4 * height), (0.66 * radius, 0.86 * height), (0, 0.95 * height)]
    angle = np.linspace(-np.pi / 2, np.pi / 2, 15)
    loop = np.stack([0.07 + 0.055 * np.cos(angle), 0 * angle, height * (0.55 + 0.42 * np.sin(angle))], axis=1)
    spout = turned_profile([(0.02, 0), (0.012, 0.07), (0, 0.07)], 16).turned(-0.7, axis=1)
    return Composite(
        f"{body} kettle",
        (
            Piece("body", turned_profile(outline), paint(body)),
            Piece("handle", tube(loop, 0.011), paint(dark)),
            Piece("spout", spout.moved(-0.075, 0, 0.55 * height), paint(body)),
            Piece("base", can(1.06 * radius, 0.018), paint(dark)),
            Piece("knob", ball(0.014).moved(0, 0, 0.94 * height), paint(dark)),
        ),
    )


def toaster(body: str, dark: str) -> Composite:
    """A toaster with two slots, dark ends and a lever."""
    width, depth, height = 0.28, 0.16, 0.18
    slots = [box(0.2, 0.025, 0.004).moved(0, y, height) for y in (-0.03, 0.03)]
    ends = [box(0.012, depth, height - 0.02).moved(s * (width / 2 + 0.006), 0, 0) for s in (-1, 1)]
    return Composite(
        f"{body} toaster",
        (
            Piece("body", box(width, depth, height), paint(body)),
            Piece("slots", joined(slots), paint("black")),
            Piece("ends", joined(ends), paint(dark)),
            Piece("lever", box(0.02, 0.03, 0.02).moved(width / 2 + 0.022, 0, 0.12), paint("black")),
        ),
    )


def bowl_of_fruit(color: str, fruit: Sequence[str]) -> Composite:
    """A bowl with three fruits in it. fruit: their colours."""
    places = (-0.045, -0.03), (0.045, -0.025), (0.0, 0.05)
    return Composite(
        f"{color} bowl",
        (
            Piece("bowl", bowl(0.11), paint(color)),
            *(
                Piece("fruit", ball(0.042).moved(x, y, 0.045), paint(c))
                for c, (x, y) in zip(fruit, places, strict=True)
            ),
        ),
    )


def wooden_chair(seat: str, frame: str) -> Composite:
    """A chair with a solid seat and a board to lean on, on legs of another colour."""
    width, height, top, leg = 0.42, 0.45, 0.9, 0.035
    side, rail = (width - leg) / 2, 0.6 * leg
    posts = [box(leg, leg, height if y < 0 else top).moved(x * side, y * side, 0) for x in (-1, 1) for y in (-1, 1)]
    rails = [box(width - 2 * leg, rail, 0.04).moved(0, y * side, height - 0.06) for y in (-1, 1)]
    rails += [box(rail, width - 2 * leg, 0.04).moved(x * side, 0, height - 0.06) for x in (-1, 1)]
    return Composite(
        f"{seat} chair",
        (
            Piece("legs", joined([*posts, *rails]), paint(frame)),
            Piece("seat", box(width, width, 0.035).moved(0, 0, height), paint(seat)),
            Piece("back", box(width - leg, 0.022, 0.22).moved(0, side, 0.64), paint(seat)),
        ),
    )


def round_table(top: str, foot: str, height: float) -> Composite:
    """A round table on one foot, its top at `height`."""
    thick = 0.035
    return Composite(
        f"{top} table",
        (
            Piece("top", can(0.45, thick).moved(0, 0, height - thick), paint(top, "ochre", "planks", 0.1)),
            Piece("column", can(0.035, height - thick), paint(foot)),
            Piece("foot", can(0.22, 0.025), paint(foot)),
        ),
    )


def plant(pot: str, rng: np.random.Generator) -> Composite:
    """A pot with fourteen leaves."""
    leaves = []
    for _ in range(14):
        around, tilt, length = rng.uniform(0, 2 * np.pi), rng.uniform(0.25, 1.1), rng.uniform(0.1, 0.17)
        leaf = _ellipsoid(0.028, 0.006, length / 2).moved(0, 0, length / 2)
        leaves.append(leaf.turned(tilt, axis=1).turned(around).moved(0, 0, 0.12))
    outline = [(0, 0), (0.055, 0), (0.075, 0.12), (0.066, 0.12), (0.06, 0.105), (0, 0.105)]
    return Composite(
        f"{pot} plant",
        (
            Piece("pot", turned_profile(outline), paint(pot)),
            Piece("soil", can(0.06, 0.004).moved(0, 0, 0.104), paint("umber")),
            Piece("leaves", joined(leaves), paint("green", "teal", "noise", 0.05)),
        ),
    )


def knife_block(wood: str, handles: str) -> Composite:
    """A leaning block with six knives in it."""
    grips = [box(0.018, 0.026, 0.1).moved(x, y, 0.2) for x in (-0.028, 0, 0.028) for y in (-0.018, 0.02)]

    def leaning(mesh: Mesh) -> Mesh:
        return mesh.turned(0.35, axis=0).moved(0, 0, 0.02)

    return Composite(
        f"{wood} block",
        (
            Piece("block", leaning(box(0.1, 0.09, 0.2)), paint(wood, "brown", "planks", 0.05)),
            Piece("handles", joined([leaning(grip) for grip in grips]), paint(handles)),
        ),
    )


def cutting_board(wood: str) -> Composite:
    """A lying board with a darker middle."""
    return Composite(
        f"{wood} board",
        (
            Piece("board", box(0.36, 0.24, 0.018), paint(wood, "ochre", "planks", 0.06)),
            Piece("middle", box(0.3, 0.18, 0.0012).moved(0, 0, 0.018), paint("brown")),
        ),
    )


def microwave(color: str, dark: str) -> Composite:
    """A microwave oven: a dark door with a handle, a panel with twelve keys."""
    width, depth, height = 0.46, 0.32, 0.27
    front = -depth / 2
    keys = [box(0.02, 0.004, 0.016).moved(0.13 + 0.025 * i, front - 0.008, 0.05 + 0.03 * j)
            for i in range(3) for j in range(4)]  # fmt: skip
    return Composite(
        f"{color} microwave",
        (
            Piece("body", box(width, depth, height), paint(color)),
            Piece("door", box(0.3, 0.012, 0.22).moved(-0.06, front - 0.006, 0.025), paint(dark)),
            Piece("panel", box(0.09, 0.006, 0.22).moved(0.155, front - 0.003, 0.025), paint("grey")),
            Piece("keys", joined(keys), paint("white")),
            Piece("handle", box(0.012, 0.03, 0.18).moved(0.08, front - 0.025, 0.045), paint("grey")),
        ),
    )


def bag(color: str, print_: str) -> Composite:
    """A filled bag with a round print and a seam on top."""
    return Composite(
        f"{color} bag",
        (
            Piece("bag", _ellipsoid(0.07, 0.035, 0.1).moved(0, 0, 0.1), paint(color)),
            Piece("print", _ellipsoid(0.045, 0.036, 0.05).moved(0, -0.0025, 0.1), paint(print_)),
            Piece("seam", box(0.1, 0.004, 0.02).moved(0, 0, 0.19), paint("white")),
        ),
    )


def duck(color: str, beak: str) -> Composite:
    """A bath duck that looks to +x."""
    eyes = [ball(0.005).moved(0.042, s * 0.016, 0.095) for s in (-1, 1)]
    return Composite(
        f"{color} duck",
        (
            Piece("body", _ellipsoid(0.05, 0.04, 0.038).moved(0, 0, 0.038), paint(color)),
            Piece("body", ball(0.03).moved(0.02, 0, 0.062), paint(color)),
            Piece("beak", _ellipsoid(0.016, 0.014, 0.007).moved(0.052, 0, 0.088), paint(beak)),
            Piece("eyes", joined(eyes), paint("black")),
        ),
    )


def pencils(pot: str, colors: Sequence[str]) -> Composite:
    """A pot with pencils of these colours, which lean outwards."""
    radius, height = 0.04, 0.1
    inner = 0.92 * radius
    outline = [(0, 0), (radius, 0), (radius, height), (inner, height), (inner, 0.006), (0, 0.006)]
    pieces = [Piece("pot", turned_profile(outline), paint(pot))]
    for color, around in zip(colors, 2 * np.pi * np.arange(len(colors)) / len(colors), strict=True):
        pencil = can(0.004, 0.17).turned(0.18, axis=1).turned(float(around))
        at = 0.012 * np.cos(around), 0.012 * np.sin(around), 0.008
        pieces.append(Piece("pencils", pencil.moved(*at), paint(color)))
    return Composite(f"{pot} pot", tuple(pieces))


def carton(color: str, ink: str, shade: str, size: tuple[float, float, float]) -> Composite:
    """A carton with words and a picture in front, and printed sides and top. size: along x, y, z."""
    width, depth, height = size
    words = sheet(lines_of_text(0.8 * width, 0.4 * height, 3), LIFT).moved(0, 0, 0.15 * height)
    prints = [
        ("front", words, ink),
        ("front", sheet([ellipse(0, -0.2 * height, 0.6 * width, 0.35 * height)], LIFT), shade),
        ("right", sheet([rectangle(0, 0, 0.7 * depth, 0.8 * height)], LIFT), ink),
        ("left", sheet([rectangle(0, 0, 0.7 * depth, 0.8 * height)], LIFT), shade),
        ("top", sheet([rectangle(0, 0, 0.8 * width, 0.7 * depth)], LIFT), shade),
    ]
    return Composite(
        f"{color} carton",
        (
            Piece("box", box(*size), paint(color)),
            *(Piece(face, on_face(mesh, face, size), paint(c)) for face, mesh, c in prints),
        ),
    )


def tape(color: str, core: str) -> Composite:
    """A lying roll of tape on its core, with a hole through it."""
    rings = [[(r, 0), (r + w, 0), (r + w, 0.045), (r, 0.045), (r, 0)] for r, w in ((0.037, 0.018), (0.033, 0.004))]
    roll, inside = (turned_profile(ring) for ring in rings)
    return Composite(f"{color} tape", (Piece("roll", roll, paint(color)), Piece("core", inside, paint(core))))


def _band(radius: float, low: float, high: float) -> Mesh:
    """What goes round something, between two heights."""
    return turned_profile([(radius, low), (radius, high)])


def _ellipsoid(x: float, y: float, z: float) -> Mesh:
    """An ellipsoid about the origin, by its half axes."""
    return stretched(ball(1.0).moved(0, 0, -1), (x, y, z))
