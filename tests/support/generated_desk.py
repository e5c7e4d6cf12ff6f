"""A generated desk as a depth camera sees it: small things close together on a table, in a few near views of one side.

On the table of a composite room stand a mug, a printed box, a brick, a lying book and a vase, and a page without
thickness and a coaster of 6 mm lie there. The depth is a sensor's: noise, holes, lost edges, and a focal length that is
not quite the photos'.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from depth_sensor import seen_near
from household import sized

from ss_flow.flows.generated.composite_room import TABLE, in_a_row, structure, table
from ss_flow.flows.generated.composites import Composite, Piece, book, brick, cup, paint, picture, printed_box
from ss_flow.flows.generated.layout import COLORS, HALF_WIDTH, Thing
from ss_flow.flows.generated.prints import LIFT, lines_of_text, rectangle, sheet
from ss_flow.flows.generated.render import Renderer
from ss_flow.flows.generated.room import Room, RoomParams, furnished_room, looking_at, photographed
from ss_flow.flows.generated.shapes import can, vase
from ss_flow.tasks.artifacts import Float32, Float64
from ss_flow.tasks.geometry.cameras import camera_of

_PAGE = 0.21, 0.297
_FOCAL_RATIO = 526 / 585
"""Focal length of the depth over that of the photos, as of a sensor's two lenses taken for one."""
_LATTICE = 9
"""Every so many rows and columns are without depth, as a warped depth map leaves them."""


def generate_desk(seed: int, views: int = 10, width: int = 640, height: int = 480) -> Room:
    """Build and photograph a desk; the same seed gives the same arrays. Raises InputError without open3d.

    The views, of `width` x `height` pixels, stand on an arc of 86 degrees, .75 to .95 m from the things. Instance 0 is
    walls, ceiling and floor. None is held out. Depth is 0 where it is unknown.
    """
    rng = np.random.default_rng(1000 + seed)
    things = _furnish(rng)
    renderer = Renderer(things, seed)
    params = RoomParams(composite=True, views=views, width=width, height=height, seed=seed, held_out=0)
    seen = photographed(renderer, _poses(views, rng), params, rng)
    other = replace(seen.cameras, intrinsics=seen.cameras.intrinsics * [_FOCAL_RATIO, _FOCAL_RATIO, 1, 1])
    exact = [renderer.render(camera_of(other, i), np.random.default_rng(0))[1] for i in range(views)]
    depth = np.stack([_as_measured(of_view, rng) for of_view in exact])
    nothing = photographed(renderer, np.zeros((0, 4, 4)), params, rng)
    room = furnished_room(seen, nothing, things)
    return replace(room, depth=depth)


def renderer_of_desk(seed: int) -> Renderer:
    """What photographs the desk of a seed from anywhere."""
    return Renderer(_furnish(np.random.default_rng(1000 + seed)), seed)


def _furnish(rng: np.random.Generator) -> tuple[Thing, ...]:
    """Everything on and around the desk; the walls and the floor have id 0."""
    c = [str(name) for name in rng.permutation(list(COLORS))]
    turn = rng.uniform(-0.2, 0.2)
    mug = sized(cup(c[0], c[8], "white"), 0.6).turned(rng.uniform(-2.6, -0.2))
    printed = sized(printed_box(c[2:], rng), 0.6).turned(rng.uniform(-0.6, 0.6))
    toy = sized(brick(c[1], "grey", rng), 0.75).turned(rng.uniform(-0.5, 0.5))
    flowers = Composite(f"{c[5]} vase", (Piece("vase", vase(0.06, 0.2), paint(c[5])),))
    lying = sized(book(c[3], c[4]), 0.8).turned(rng.uniform(-0.4, 0.4))
    on_desk = [*in_a_row([mug, printed, toy], -0.08, rng), *in_a_row([lying, flowers], 0.22, rng)]
    paper = _page().turned(rng.uniform(-0.5, 0.5))
    on_desk.append(paper.moved(rng.choice([-1, 1]) * rng.uniform(0.25, 0.35), -0.1 + rng.uniform(-0.1, 0.1), 0))
    on_desk.append(_coaster(c[6], "cream").moved(rng.uniform(-0.12, 0.12), -0.28, 0))
    on_desk = [thing.moved(0, 0, TABLE[2]).turned(turn) for thing in on_desk]
    hung = picture(c[2], [c[3], "yellow", c[0], c[6]]).moved(rng.uniform(-0.3, 0.3), HALF_WIDTH - 0.005, 0.9)
    pieces = structure(c[8], rng).things(0)
    for instance_id, thing in enumerate([table().turned(turn), *on_desk, hung], 1):
        pieces += thing.things(instance_id)
    return pieces


def _page() -> Composite:
    """A printed sheet of paper, without thickness."""
    width, height = _PAGE
    paper = sheet([rectangle(0, 0, width, height)], 0.0004)
    text = sheet(lines_of_text(0.8 * width, 0.7 * height, 8), 0.0004 + LIFT)
    flat = [mesh.turned(-np.pi / 2, axis=0) for mesh in (paper, text)]
    return Composite("white page", (Piece("paper", flat[0], paint("white")), Piece("text", flat[1], paint("black"))))


def _coaster(color: str, ring: str) -> Composite:
    """A disc of 6 mm with a lighter middle."""
    disc, middle = can(0.055, 0.006), can(0.035, 0.0068)
    return Composite(f"{color} coaster", (Piece("disc", disc, paint(color)), Piece("ring", middle, paint(ring))))


def _poses(views: int, rng: np.random.Generator) -> Float64:
    """World-to-camera [views, 4, 4] on an arc before the desk."""
    angles = np.linspace(-0.75, 0.75, views) + rng.uniform(-0.04, 0.04, views) - np.pi / 2
    poses = []
    for angle in angles:
        distance, rise = rng.uniform(0.75, 0.95), rng.uniform(0.45, 0.7)
        target = np.array([rng.uniform(-0.05, 0.05), 0.03 + rng.uniform(-0.05, 0.05), TABLE[2] + 0.05])
        out = np.array([np.cos(rise) * np.cos(angle), np.cos(rise) * np.sin(angle), np.sin(rise)])
        poses.append(looking_at(target + distance * out, target))
    return np.stack(poses)


def _as_measured(depth: Float32, rng: np.random.Generator) -> Float32:
    """What a sensor measures of a depth map [H, W]; 0 where nothing."""
    measured = seen_near(depth, rng)
    measured[4::_LATTICE] = 0
    measured[:, 4::_LATTICE] = 0
    return measured
