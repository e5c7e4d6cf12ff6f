"""Things of a work place, each one instance of several parts.

Lengths are metres. Every thing stands on z = 0 with its front towards -y.
"""

from __future__ import annotations

import numpy as np
from furniture import rounded

from ss_flow.flows.generated.composites import Composite, Piece, paint, tube
from ss_flow.flows.generated.prints import LIFT, ellipse, lines_of_text, rectangle, sheet
from ss_flow.flows.generated.shapes import ball, box, can, joined, turned_profile


def monitor(frame: str, dark: str, colors: tuple[str, str]) -> Composite:
    """A monitor on a foot: a frame, a dark screen with windows of two colours on it. dark: of the screen."""
    width, height, low = 0.54, 0.32, 0.13
    front = -0.018
    screen = sheet([rectangle(0, 0, width - 0.03, height - 0.04)], LIFT)
    windows = sheet([rectangle(-0.12, 0.02, 0.22, 0.18), rectangle(0.15, 0.06, 0.16, 0.1)], 2 * LIFT)
    words = [outline + np.array([-0.12, 0.02]) for outline in lines_of_text(0.2, 0.16, 5)]
    shown = sheet([*words, ellipse(0.15, 0.06, 0.06, 0.06)], 3 * LIFT)
    middle = low + height / 2 + 0.005
    return Composite(
        f"{frame} monitor",
        (
            Piece("frame", box(width, 0.036, height).moved(0, 0, low), paint(frame)),
            Piece("screen", screen.moved(0, front, middle), paint(dark)),
            Piece("screen", windows.moved(0, front, middle), paint(colors[0])),
            Piece("screen", shown.moved(0, front, middle), paint(colors[1])),
            Piece("foot", box(0.05, 0.025, low + 0.1).moved(0, 0.03, 0), paint("grey")),
            Piece("foot", box(0.24, 0.18, 0.012).moved(0, 0.02, 0), paint("grey")),
        ),
    )


def keyboard(body: str, keys: str) -> Composite:
    """A keyboard of five rows of keys."""
    step = 0.0285
    caps = [box(0.024, 0.024, 0.008).moved(x, y, 0.014)
            for x in (np.arange(15) - 7) * step for y in (np.arange(-1, 4) - 1) * step]  # fmt: skip
    space = box(0.16, 0.024, 0.008).moved(-0.02, -3 * step, 0.014)
    return Composite(
        f"{body} keyboard",
        (Piece("body", box(0.45, 0.17, 0.015), paint(body)), Piece("keys", joined([*caps, space]), paint(keys))),
    )


def mouse(color: str, wheel: str, length: float) -> Composite:
    """A mouse, its cable of so many metres in waves to +y."""
    y = np.linspace(0, length, 60)
    way = np.stack([0.03 * np.sin(9 * y) * np.minimum(8 * y, 1), 0 * y, y], axis=1)
    cable = tube(way, 0.0022).turned(-np.pi / 2, axis=0).moved(0, 0.05, 0.003)
    return Composite(
        f"{color} mouse",
        (
            Piece("body", rounded(0.032, 0.055, 0.018, power=3).moved(0, 0, 0.018), paint(color)),
            Piece("wheel", box(0.008, 0.022, 0.006).moved(0, -0.03, 0.031), paint(wheel)),
            Piece("cable", cable, paint("black")),
        ),
    )


def desk_lamp(color: str, metal: str) -> Composite:
    """A lamp: a round foot, two thin arms that meet in a joint, a shade that looks down to +x."""
    joint, head = np.array([-0.08, 0, 0.24]), np.array([0.08, 0, 0.42])
    arms = [tube(np.linspace(a, b, 8), 0.006) for a, b in (((0, 0, 0.015), joint), (joint, head))]
    outside, inside = [(0.075, 0), (0.03, 0.1), (0, 0.1)], [(0, 0.096), (0.027, 0.096), (0.071, 0)]
    shade = turned_profile([*outside, *inside]).turned(-0.5, axis=1)
    return Composite(
        f"{color} lamp",
        (
            Piece("foot", can(0.08, 0.018), paint(color)),
            Piece("arms", joined([*arms, ball(0.012).moved(*(joint - (0, 0, 0.012)))]), paint(metal)),
            Piece("shade", shade.moved(*(head + np.array([0.04, 0, -0.08]))), paint(color)),
        ),
    )


def office_chair(cloth: str, frame: str) -> Composite:
    """A chair that turns: five feet on castors, a column, a seat, a back on a bar, two arm rests."""
    feet = [box(0.3, 0.035, 0.03).moved(0.15, 0, 0.06).turned(k * 2 * np.pi / 5) for k in range(5)]
    castors = [ball(0.028).moved(0.29, 0, 0).turned(k * 2 * np.pi / 5) for k in range(5)]
    bar = box(0.06, 0.02, 0.36).moved(0, 0.26, 0.4)
    rests = [box(0.05, 0.24, 0.03).moved(s * 0.27, 0, 0.66) for s in (-1, 1)]
    posts = [box(0.03, 0.04, 0.22).moved(s * 0.27, 0, 0.44) for s in (-1, 1)]
    return Composite(
        f"{cloth} chair",
        (
            Piece("feet", joined([*feet, can(0.03, 0.36).moved(0, 0, 0.06)]), paint(frame)),
            Piece("castors", joined(castors), paint("black")),
            Piece("seat", rounded(0.25, 0.24, 0.045).moved(0, 0, 0.46), paint(cloth)),
            Piece("back", rounded(0.22, 0.035, 0.26).moved(0, 0.235, 0.86), paint(cloth)),
            Piece("frame", joined([bar, *rests, *posts, box(0.56, 0.05, 0.02).moved(0, 0, 0.42)]), paint(frame)),
        ),
    )


def writing_desk(top: str, legs: str, size: tuple[float, float, float]) -> Composite:
    """A table with a case of three drawers under its right end. size: along x, y, z."""
    width, depth, height = size
    thick, leg = 0.03, 0.05
    posts = [box(leg, leg, height - thick).moved(x, y * (depth / 2 - leg), 0)
             for x in (leg - width / 2, width / 2 - leg) for y in (-1, 1)]  # fmt: skip
    case = box(0.38, depth - 0.14, 0.42).moved(width / 2 - 0.28, 0, height - thick - 0.42)
    fronts = [box(0.35, 0.016, 0.12).moved(width / 2 - 0.28, 0.07 - depth / 2, height - 0.17 - 0.137 * k)
              for k in range(3)]  # fmt: skip
    return Composite(
        f"{top} desk",
        (
            Piece("top", box(width, depth, thick).moved(0, 0, height - thick), paint(top, "ochre", "planks", 0.12)),
            Piece("legs", joined(posts), paint(legs)),
            Piece("case", case, paint("white")),
            Piece("drawers", joined(fronts), paint("grey")),
        ),
    )


def papers(rng: np.random.Generator) -> Composite:
    """Three printed sheets that lie across each other."""
    pieces = []
    for k in range(3):
        paper = sheet([rectangle(0, 0, 0.21, 0.297)], 0.0004 + 2 * k * LIFT)
        text = sheet(lines_of_text(0.17, 0.22, 9), 0.0004 + (2 * k + 1) * LIFT)
        turn, (x, y) = rng.uniform(-0.5, 0.5), rng.uniform(-0.04, 0.04, 2)
        for name, mesh, color in (("paper", paper, "white"), ("text", text, "black")):
            pieces.append(Piece(name, mesh.turned(-np.pi / 2, axis=0).turned(turn).moved(x, y, 0), paint(color)))
    return Composite("white papers", tuple(pieces))
