"""Single things of many parts, most of them curved: a teapot, a robot, a shoe, a handbag, a truck.

Lengths are metres. Every thing stands on z = 0 with its front towards -y.
"""

from __future__ import annotations

import numpy as np
from furniture import rounded

from ss_flow.flows.generated.composites import Composite, Piece, paint, tube
from ss_flow.flows.generated.prints import LIFT, ellipse, on_face, rectangle, sheet
from ss_flow.flows.generated.shapes import ball, box, can, joined, torus, turned_profile


def teapot(body: str, lid: str, trim: str) -> Composite:
    """A pot with a band of dots, a lid with a knob, a bent spout (towards -x) and a handle (towards +x)."""
    z = np.linspace(0, 1, 20)
    belly = [
        (float(r), float(h)) for r, h in zip(0.045 + 0.05 * np.sin(np.pi * (0.1 + 0.8 * z)), 0.13 * z, strict=True)
    ]
    cover = [(0.061, 0.13), (0.06, 0.138), (0.045, 0.15), (0.02, 0.157), (0, 0.158)]
    angle = np.linspace(-1.75, 1.75, 17)
    loop = np.stack([0.08 + 0.055 * np.cos(angle), 0 * angle, 0.07 + 0.042 * np.sin(angle)], axis=1)
    t = np.linspace(0, 1, 12)
    spout = np.stack([-0.08 - 0.075 * t, 0 * t, 0.045 + 0.09 * t**1.8], axis=1)
    around = 2 * np.pi * np.arange(10) / 10
    dots = [rounded(0.004, 0.011, 0.011, power=2).moved(0.094, 0, 0.062).turned(float(a)) for a in around]
    return Composite(
        f"{body} teapot",
        (
            Piece("body", turned_profile([(0.0, 0.0), *belly, (0.0, 0.13)]), paint(body)),
            Piece("dots", joined(dots), paint(trim)),
            Piece("lid", turned_profile(cover), paint(lid)),
            Piece("knob", ball(0.014).moved(0, 0, 0.154), paint(trim)),
            Piece("handle", tube(loop, 0.009), paint(lid)),
            Piece("spout", tube(spout, 0.014), paint(body)),
        ),
    )


def robot(body: str, limbs: str, trim: str) -> Composite:
    """A robot of boxes, cans and balls, with a panel on its chest and an aerial on its head."""
    chest = 0.13, 0.09, 0.14
    both = (-1, 1)
    arms = [can(0.016, 0.12).turned(-s * 0.25, axis=1).moved(s * 0.1, 0, 0.125) for s in both]
    hands = [ball(0.022).moved(s * 0.104, 0, 0.095) for s in both]
    legs = [can(0.02, 0.09).moved(s * 0.035, 0, 0.02) for s in both]
    feet = [rounded(0.03, 0.045, 0.016, power=3).moved(s * 0.036, -0.01, 0.016) for s in both]
    eyes = [ball(0.013).moved(s * 0.022, -0.036, 0.277) for s in both]
    round_, square = ellipse(-0.025, 0.02, 0.03, 0.03), rectangle(0.022, 0.02, 0.03, 0.03)
    dials = sheet([round_, square, rectangle(0, -0.03, 0.07, 0.012)], 2 * LIFT)
    panel = sheet([rectangle(0, 0, 0.1, 0.1)], LIFT)
    return Composite(
        f"{body} robot",
        (
            Piece("chest", box(*chest).moved(0, 0, 0.1), paint(body)),
            Piece("panel", on_face(panel, "front", chest).moved(0, 0, 0.1), paint("white")),
            Piece("dials", on_face(dials, "front", chest).moved(0, 0, 0.1), paint(trim)),
            Piece("arms", joined(arms), paint("grey")),
            Piece("hands", joined(hands), paint(limbs)),
            Piece("legs", joined(legs), paint("grey")),
            Piece("feet", joined(feet), paint(limbs)),
            Piece("neck", can(0.02, 0.015).moved(0, 0, 0.24), paint("grey")),
            Piece("head", box(0.09, 0.075, 0.075).moved(0, 0, 0.252), paint(body)),
            Piece("eyes", joined(eyes), paint(trim)),
            Piece("aerial", joined([can(0.004, 0.05).moved(0, 0, 0.325), ball(0.01).moved(0, 0, 0.37)]), paint(limbs)),
        ),
    )


def shoe(upper: str, sole: str, trim: str) -> Composite:
    """A shoe, its toe to -y: a sole, an upper with a cap, a tongue, laces and a patch at the heel."""
    laces = [rounded(0.03, 0.005, 0.004, power=3).moved(0, y, z)
             for y, z in ((-0.045, 0.083), (-0.025, 0.096), (-0.005, 0.108))]  # fmt: skip
    return Composite(
        f"{upper} shoe",
        (
            Piece("sole", rounded(0.05, 0.145, 0.016, power=3).moved(0, 0, 0.016), paint(sole)),
            Piece("upper", rounded(0.046, 0.135, 0.05, power=3).moved(0, 0, 0.034), paint(upper)),
            Piece("upper", rounded(0.044, 0.07, 0.07, power=3).moved(0, 0.062, 0.06), paint(upper)),
            Piece("cap", rounded(0.047, 0.05, 0.047, power=3).moved(0, -0.09, 0.033), paint(trim)),
            Piece(
                "tongue", rounded(0.026, 0.075, 0.012, power=3).turned(0.55, axis=0).moved(0, -0.01, 0.1), paint(sole)
            ),
            Piece("laces", joined(laces), paint("white")),
            Piece("inside", rounded(0.03, 0.05, 0.004, power=3).moved(0, 0.065, 0.129), paint("black")),
            Piece("heel", rounded(0.028, 0.012, 0.035, power=3).moved(0, 0.127, 0.065), paint(trim)),
        ),
    )


def handbag(leather: str, flap: str, trim: str) -> Composite:
    """A bag with a flap, a buckle, two side patches and a handle over it."""
    angle = np.linspace(0, np.pi, 21)
    loop = np.stack([0.075 * np.cos(angle), 0 * angle, 0.165 + 0.085 * np.sin(angle)], axis=1)
    rings = [torus(0.012, 0.003).turned(np.pi / 2, axis=0).moved(s * 0.075, 0.003, 0.165) for s in (-1, 1)]
    return Composite(
        f"{leather} handbag",
        (
            Piece("body", rounded(0.12, 0.05, 0.085, power=4).moved(0, 0, 0.085), paint(leather)),
            Piece("flap", rounded(0.112, 0.053, 0.05, power=4).moved(0, -0.002, 0.125), paint(flap)),
            Piece("buckle", rounded(0.018, 0.006, 0.014, power=4).moved(0, -0.054, 0.095), paint(trim)),
            Piece("rings", joined(rings), paint(trim)),
            Piece("handle", tube(loop, 0.007), paint(flap)),
        ),
    )


def truck(cabin: str, load: str, trim: str) -> Composite:
    """A toy truck that drives to -x: a chassis on six wheels, a cabin with panes, a box with a stripe."""
    tyre = can(0.03, 0.024).turned(np.pi / 2, axis=0)
    hub = can(0.014, 0.026).turned(np.pi / 2, axis=0)
    places = [(x, s * 0.05 + 0.012, 0.03) for x in (-0.09, 0.04, 0.105) for s in (-1, 1)]
    front, freight = (0.075, 0.096, 0.085), (0.17, 0.11, 0.1)
    faces = ("front", "back", "left")
    panes = [on_face(sheet([rectangle(0, 0.015, 0.055, 0.035)], LIFT), face, front) for face in faces]
    stripes = [on_face(sheet([rectangle(0, 0, 0.17, 0.03)], LIFT), face, freight) for face in ("front", "back")]
    lamps = [ball(0.008).moved(-0.132, s * 0.034, 0.055) for s in (-1, 1)]
    return Composite(
        f"{load} truck",
        (
            Piece("chassis", box(0.27, 0.07, 0.02).moved(0, 0, 0.03), paint("grey")),
            Piece("wheels", joined([tyre.moved(*at) for at in places]), paint("black")),
            Piece("hubs", joined([hub.moved(x, y + 0.001, z) for x, y, z in places]), paint(trim)),
            Piece("cabin", box(*front).moved(-0.095, 0, 0.05), paint(cabin)),
            Piece("panes", joined(panes).moved(-0.095, 0, 0.05), paint("sky")),
            Piece("lamps", joined(lamps), paint("yellow")),
            Piece("load", box(*freight).moved(0.05, 0, 0.05), paint(load)),
            Piece("stripes", joined(stripes).moved(0.05, 0, 0.05), paint(trim)),
        ),
    )
