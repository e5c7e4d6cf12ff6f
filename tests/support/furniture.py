"""Things of a bedroom, each one instance of several parts.

Lengths are metres. Every thing stands on z = 0 with its front towards -y; what hangs has its back in the plane y = 0.
"""

from __future__ import annotations

import numpy as np

from ss_flow.flows.generated.composites import Composite, Piece, paint, stretched
from ss_flow.flows.generated.prints import LIFT, ellipse, on_face, sheet
from ss_flow.flows.generated.shapes import Mesh, ball, box, can, joined, turned_profile

BED_TOP = 0.5
"""Height on which pillows lie, metres."""
CHEST = 0.8, 0.42, 0.78
"""Width, depth and height of a chest of drawers."""


def bed(frame: str, cover: str, pattern: str, width: float) -> Composite:
    """A bed, 2 m long, its head to +y: a frame, a mattress, and a cover that hangs down on both sides."""
    legs = [box(0.07, 0.07, 0.12).moved(x * (width / 2 - 0.06), y * 0.93, 0) for x in (-1, 1) for y in (-1, 1)]
    mattress = rounded(width / 2 - 0.02, 0.96, 0.11).moved(0, -0.01, 0.37)
    lying = rounded(width / 2 + 0.02, 0.69, 0.05).moved(0, -0.26, BED_TOP - 0.035)
    hanging = [box(0.03, 1.34, 0.22).moved(s * (width / 2 + 0.01), -0.26, BED_TOP - 0.26) for s in (-1, 1)]
    turned_down = box(width + 0.02, 0.16, 0.02).moved(0, 0.36, BED_TOP + 0.01)
    return Composite(
        f"{cover} bed",
        (
            Piece("frame", joined([box(width, 1.96, 0.16).moved(0, 0, 0.12), *legs]), paint(frame)),
            Piece("head", box(width + 0.06, 0.05, 0.95).moved(0, 0.975, 0), paint(frame, "brown", "planks", 0.1)),
            Piece("mattress", mattress, paint("white")),
            Piece("cover", joined([lying, *hanging]), paint(cover, "white", pattern, 0.07)),
            Piece("cover", turned_down, paint("white", cover, "noise", 0.02)),
        ),
    )


def pillow(color: str, shade: str, size: tuple[float, float, float]) -> Composite:
    """A lying pillow, striped unless both colours are one. size: along x, y, z."""
    x, y, z = np.array(size) / 2
    body = rounded(x, y, z, power=3).moved(0, 0, z)
    return Composite(f"{color} pillow", (Piece("pillow", body, paint(color, shade, "stripes", 0.06)),))


def wardrobe(body: str, doors: str, leaves: int) -> Composite:
    """A wardrobe with so many doors, each with a long handle, on a plinth."""
    width, depth, height = 0.5 * leaves, 0.55, 1.95
    front, step = -depth / 2, width / leaves
    middles = (np.arange(leaves) - (leaves - 1) / 2) * step
    door = [box(step - 0.02, 0.02, height - 0.14).moved(x, front - 0.01, 0.1) for x in middles]
    sides = np.where(np.arange(leaves) % 2, -1, 1)
    handles = [box(0.018, 0.03, 0.22).moved(x + s * (step / 2 - 0.05), front - 0.035, 0.95)
               for x, s in zip(middles, sides, strict=True)]  # fmt: skip
    return Composite(
        f"{body} wardrobe",
        (
            Piece("body", box(width, depth, height - 0.08).moved(0, 0, 0.08), paint(body)),
            Piece("plinth", box(width - 0.04, depth - 0.06, 0.08), paint("umber")),
            Piece("doors", joined(door), paint(doors)),
            Piece("handles", joined(handles), paint("black")),
        ),
    )


def chest(body: str, fronts: str, size: tuple[float, float, float], drawers: int) -> Composite:
    """A chest of drawers with two knobs on each, or one where it is narrow. size: along x, y, z."""
    width, depth, height = size
    front, step = -depth / 2, (height - 0.08) / drawers
    floors = 0.05 + step * np.arange(drawers)
    fronts_ = [box(width - 0.05, 0.018, step - 0.02).moved(0, front - 0.009, z) for z in floors]
    across = (-0.28, 0.28) if width > 0.6 else (0.0,)
    knobs = [ball(0.018).moved(x * width, front - 0.03, z + step / 2 - 0.02) for x in across for z in floors]
    return Composite(
        f"{body} chest",
        (
            Piece("body", box(width, depth, height), paint(body)),
            Piece("drawers", joined(fronts_), paint(fronts)),
            Piece("knobs", joined(knobs), paint("black")),
        ),
    )


def lamp(foot: str, shade: str) -> Composite:
    """A lamp: a foot, a stem, a shade with a hem."""
    wide, narrow, low, high = 0.14, 0.09, 0.22, 0.4
    outside, inside = [(wide, low), (narrow, high)], [(narrow - 0.004, high), (wide - 0.004, low)]
    return Composite(
        f"{shade} lamp",
        (
            Piece("foot", turned_profile([(0, 0), (0.075, 0), (0.07, 0.02), (0.02, 0.05), (0, 0.05)]), paint(foot)),
            Piece("stem", can(0.013, 0.26).moved(0, 0, 0.05), paint(foot)),
            Piece("shade", turned_profile([*outside, *inside]), paint(shade)),
            Piece("hem", turned_profile([(wide + LIFT, low), (wide - 0.005, low + 0.018)]), paint("white")),
        ),
    )


def clock(color: str) -> Composite:
    """A round alarm clock on two feet, with a dial, hands and two bells."""
    radius, deep = 0.055, 0.05
    dial = sheet([ellipse(0, 0, 1.7 * radius, 1.7 * radius)], deep / 2 + LIFT)
    hands = sheet([ellipse(0.012, 0, 0.03, 0.006), ellipse(0, 0.016, 0.006, 0.04)], deep / 2 + 2 * LIFT)
    middle = radius + 0.015
    feet = [can(0.008, 0.03).turned(s * 0.4, axis=1).moved(s * -0.03, 0, 0) for s in (-1, 1)]
    bells = [ball(0.02).moved(s * 0.03, 0, middle + 0.04) for s in (-1, 1)]
    return Composite(
        f"{color} clock",
        (
            Piece("case", can(radius, deep).turned(np.pi / 2, axis=0).moved(0, deep / 2, middle), paint(color)),
            Piece("dial", dial.moved(0, 0, middle), paint("white")),
            Piece("hands", hands.moved(0, 0, middle), paint("black")),
            Piece("bells", joined([*feet, *bells]), paint("grey")),
        ),
    )


def rug(color: str, border: str, size: tuple[float, float]) -> Composite:
    """A rug with a border and a pattern of stars in the middle. size: along x, y."""
    width, depth = size
    thick = 0.012
    places = [(x, z) for x in np.linspace(-0.35, 0.35, 4) * width for z in (-0.18 * depth, 0.18 * depth)]
    stars = sheet([ellipse(x, z, 0.2, 0.2, dents=6) for x, z in places], LIFT)
    middle = box(width - 0.2, depth - 0.2, 0.0015).moved(0, 0, thick)
    return Composite(
        f"{color} rug",
        (
            Piece("border", box(width, depth, thick), paint(border)),
            Piece("middle", middle, paint(color)),
            Piece("stars", on_face(stars, "top", (width, depth, thick + 0.0015)), paint(border)),
        ),
    )


def stool(seat: str, foot: str) -> Composite:
    """A round stool: a cushion on a drum with a band."""
    return Composite(
        f"{seat} stool",
        (
            Piece("drum", can(0.2, 0.3), paint(foot)),
            Piece("band", turned_profile([(0.2 + LIFT, 0.12), (0.2 + LIFT, 0.16)]), paint("white")),
            Piece("seat", rounded(0.22, 0.22, 0.05, power=3).moved(0, 0, 0.34), paint(seat)),
        ),
    )


def basket(color: str, rim: str) -> Composite:
    """An open laundry basket with a rim and two handles of another colour."""
    low, high, height = 0.16, 0.2, 0.45
    outline = [(0, 0), (low, 0), (high, height), (high - 0.012, height), (low - 0.012, 0.012), (0, 0.012)]
    grips = [box(0.02, 0.12, 0.04).moved(s * 0.2, 0, height - 0.1) for s in (-1, 1)]
    hoop = [(high + 0.006, height - 0.03), (high + 0.006, height + 0.004), (high - 0.016, height + 0.004)]
    return Composite(
        f"{color} basket",
        (
            Piece("body", turned_profile(outline), paint(color, "white", "stripes", 0.03)),
            Piece("rim", turned_profile(hoop), paint(rim)),
            Piece("grips", joined(grips), paint(rim)),
        ),
    )


def curtain(color: str, shade: str, width: float, height: float) -> Composite:
    """A curtain in folds with a hem of another colour; its lower edge is at z = 0."""
    hem = 0.12
    return Composite(
        f"{color} curtain",
        (
            Piece("cloth", _folds(width, hem, height), paint(color)),
            Piece("hem", _folds(width, 0.0, hem), paint(shade)),
        ),
    )


def _folds(width: float, low: float, high: float, deep: float = 0.03) -> Mesh:
    """A wavy sheet between two heights, seen from -y."""
    x = np.linspace(-width / 2, width / 2, max(int(width / 0.008), 8))
    turn = 2 * np.pi / 0.11
    bend = deep * turn * np.cos(turn * x)
    normals = np.stack([bend, -np.ones_like(x), 0 * x], axis=1)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    rows = [np.stack([x, deep * np.sin(turn * x) - 3 * deep, np.full_like(x, z)], axis=1) for z in (low, high)]
    i, n = np.arange(len(x) - 1), len(x)
    triangles = np.concatenate([np.stack([i, i + 1, n + i + 1], 1), np.stack([i, n + i + 1, n + i], 1)])
    placed = np.concatenate(rows)
    return Mesh(placed, np.tile(normals, (2, 1)), placed, triangles.astype(np.int32))


def rounded(x: float, y: float, z: float, power: float = 8) -> Mesh:
    """A body about the origin, by its half axes: an ellipsoid (power 2) to a cuboid with round edges (large ones)."""
    unit = ball(1.0).moved(0, 0, -1)
    places = unit.vertices / (np.abs(unit.vertices) ** power).sum(axis=1, keepdims=True) ** (1 / power)
    normals = np.sign(places) * np.abs(places) ** (power - 1)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return stretched(Mesh(places, normals, places, unit.triangles), (x, y, z))
