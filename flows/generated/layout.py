"""Furnishing a generated room: what there is, what it is made of, and where it stands."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ss_flow.flows.generated.shapes import SHAPES, Mesh, box, shelf, sofa, table

HALF_WIDTH = 2.0
"""The room reaches from -HALF_WIDTH to HALF_WIDTH in x and y, metres; the floor is z = 0."""
CEILING = 2.6

COLORS: dict[str, tuple[int, int, int]] = {
    "red": (205, 40, 40),
    "yellow": (240, 205, 50),
    "blue": (45, 85, 200),
    "green": (55, 155, 65),
    "orange": (240, 130, 30),
    "purple": (125, 65, 170),
    "pink": (240, 140, 180),
    "teal": (30, 160, 165),
    "black": (48, 48, 52),
}
"""sRGB of the colour words that small things go by."""

_PATTERNS = {"checked": "checks", "striped": "stripes", "mottled": "noise"}
"""Words for the patterns; they tell things apart when the names of colour and shape are used up."""

_PLAIN_NAMES = len(SHAPES) * len(COLORS)
MAX_OBJECTS = _PLAIN_NAMES * (1 + len(_PATTERNS))
"""Every small thing is the only one with its name."""

_FLOOR, _TABLE, _SHELF_TOP, _SHELF_MIDDLE, _SOFA = range(5)
_TURNS = (_TABLE, _SHELF_TOP, _FLOOR, _FLOOR, _TABLE, _FLOOR, _TABLE, _FLOOR, _TABLE, _SOFA, _SHELF_TOP, _SHELF_MIDDLE)
_FLOOR_ONLY = ("chair", "crate")
_GAP = 0.04
_TRIES = 300


@dataclass(frozen=True)
class Material:
    """A solid texture: two shades of one colour, mixed by a pattern."""

    pattern: str
    """"noise", "checks", "stripes" or "planks"."""
    shades: tuple[tuple[int, int, int], tuple[int, int, int]]
    """sRGB."""
    scale: float
    """Size of the pattern's cells, metres."""


@dataclass(frozen=True)
class Thing:
    """A piece of the room of one material; an instance is one of them, or several with the same id."""

    instance_id: int
    """0 for walls, floor and ceiling."""
    name: str
    color: str
    """The word for its colour; the first word of its name."""
    mesh: Mesh
    material: Material
    part_id: int = 0
    """1.. within the instance; 0 where it has no parts."""
    part: str = ""
    """What the part is called."""


@dataclass(frozen=True)
class _Surface:
    """A rectangle on which small things may stand."""

    center: tuple[float, float, float]
    half: tuple[float, float]
    angle: float
    headroom: float


def furnish(objects: int, rng: np.random.Generator) -> tuple[Thing, ...]:
    """Everything in the room: the structure (id 0), the furniture (ids 1..3), the small things (ids 4..).

    objects: 1..MAX_OBJECTS.
    """
    furniture, surfaces, blocked = _furniture(rng)
    things = [*_structure(), *furniture]
    colors = list(rng.permutation(list(COLORS)))
    shapes = list(SHAPES)
    names = [(shapes[i % len(shapes)], str(colors[i % len(colors)])) for i in range(objects)]
    taken: list[list[tuple[float, float, float]]] = [[] for _ in surfaces]
    taken[_FLOOR] = blocked
    crowded = min(1.0, (14 / objects) ** 0.35)
    meshes = [
        SHAPES[shape]().sized(crowded * rng.uniform(1.0, 1.2)).turned(rng.uniform(0, 2 * np.pi)) for shape, _ in names
    ]
    # Chairs and crates have the floor only, so they choose first.
    for i in sorted(range(objects), key=lambda i: names[i][0] not in _FLOOR_ONLY):
        meshes[i] = _place(meshes[i], _choices(names[i][0], i), surfaces, taken, rng)
    for i, (shape, color) in enumerate(names):
        material = _painted(color, rng)
        name = f"{color} {shape}"
        if i >= _PLAIN_NAMES:
            word = list(_PATTERNS)[i // _PLAIN_NAMES - 1]
            name, material = f"{color} {word} {shape}", replace(material, pattern=_PATTERNS[word])
        things.append(Thing(len(furniture) + 1 + i, name, color, meshes[i], material))
    return tuple(things)


def _choices(shape: str, turn: int) -> list[int]:
    """The surfaces to try, in this order: chairs and crates go on the floor, the others take turns."""
    if shape in _FLOOR_ONLY:
        return [_FLOOR]
    first = _TURNS[turn % len(_TURNS)]
    return [first, *(s for s in (_TABLE, _FLOOR, _SHELF_TOP, _SOFA, _SHELF_MIDDLE) if s != first)]


def _place(
    mesh: Mesh,
    choices: list[int],
    surfaces: tuple[_Surface, ...],
    taken: list[list[tuple[float, float, float]]],
    rng: np.random.Generator,
) -> Mesh:
    """Stand a mesh where it touches nothing; where there is no room, make it smaller until there is."""
    while True:
        for choice in choices:
            surface, radius = surfaces[choice], mesh.radius
            limit = np.array(surface.half) - radius
            if (limit < 0).any() or mesh.height > surface.headroom:
                continue
            c, s = np.cos(surface.angle), np.sin(surface.angle)
            u, v = rng.uniform(-limit, limit, (_TRIES, 2)).T
            x, y = surface.center[0] + c * u - s * v, surface.center[1] + s * u + c * v
            p, q, r = np.reshape(taken[choice], (-1, 3)).T
            free = (np.hypot(x[:, None] - p, y[:, None] - q) > radius + r + _GAP).all(axis=1)
            if free.any():
                first = free.argmax()
                taken[choice].append((x[first], y[first], radius))
                return mesh.moved(x[first], y[first], surface.center[2])
        mesh = mesh.sized(0.9)


def _painted(color: str, rng: np.random.Generator) -> Material:
    base = np.array(COLORS[color])
    other = base + 0.35 * (255 - base) if color == "black" or rng.random() < 0.4 else base * 0.55
    pattern = str(rng.choice(["noise", "checks", "stripes"]))
    shade = tuple(int(n) for n in other)
    return Material(pattern, (COLORS[color], (shade[0], shade[1], shade[2])), float(rng.uniform(0.045, 0.075)))


def _structure() -> list[Thing]:
    wall = Material("noise", ((228, 216, 196), (202, 190, 170)), 0.14)
    wood = Material("planks", ((206, 176, 138), (166, 134, 98)), 0.2)
    inside = box(2 * HALF_WIDTH, 2 * HALF_WIDTH, CEILING + 0.01).moved(0, 0, -0.01)
    floor = box(2 * HALF_WIDTH, 2 * HALF_WIDTH, 0.02).moved(0, 0, -0.02)
    return [Thing(0, "walls", "grey", inside, wall), Thing(0, "floor", "brown", floor, wood)]


def _furniture(
    rng: np.random.Generator,
) -> tuple[list[Thing], tuple[_Surface, ...], list[tuple[float, float, float]]]:
    """A table in the middle, a shelf and a sofa along two walls; the surfaces they offer (in the order of _FLOOR,
    _TABLE, ...), and the circles (x, y, radius) that they block on the floor."""
    turn = float(rng.uniform(-0.3, 0.3))
    x, y = (float(n) for n in rng.uniform(-0.12, 0.12, 2))
    along_shelf, along_sofa = (float(n) for n in rng.uniform(-0.3, 0.3, 2))
    back = HALF_WIDTH - 0.01
    brown = Material("planks", ((118, 76, 46), (82, 50, 30)), 0.12)
    white = Material("noise", ((240, 238, 232), (214, 212, 206)), 0.1)
    grey = Material("checks", ((122, 126, 134), (92, 96, 104)), 0.05)
    things = [
        Thing(1, "brown table", "brown", table(1.25, 0.85, 0.5).turned(turn).moved(x, y, 0), brown),
        Thing(2, "white shelf", "white", shelf(1.5, 0.46, (0.06, 0.4, 0.74)).moved(along_shelf, back - 0.23, 0), white),
        Thing(3, "grey sofa", "grey", sofa(1.6, 0.75, 0.36).turned(np.pi / 2).moved(0.375 - back, along_sofa, 0), grey),
    ]
    surfaces = (
        _Surface((0.0, 0.0, 0.0), (1.55, 1.55), 0.0, 2.0),
        _Surface((x, y, 0.5), (0.62, 0.42), turn, 0.5),
        _Surface((along_shelf, back - 0.24, 0.74), (0.75, 0.22), 0.0, 0.45),
        _Surface((along_shelf, back - 0.24, 0.4), (0.73, 0.22), 0.0, 0.29),
        _Surface((0.475 - back, along_sofa, 0.36), (0.27, 0.62), 0.0, 0.45),
    )
    blocked = [(x, y, 0.8)]
    blocked += [(along_shelf + t, back - 0.23, 0.3) for t in np.linspace(-0.75, 0.75, 7)]
    blocked += [(0.375 - back, along_sofa + t, 0.48) for t in np.linspace(-0.8, 0.8, 7)]
    return things, surfaces, blocked
