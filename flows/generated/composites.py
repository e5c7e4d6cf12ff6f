"""Things of several parts for a generated room: printed, slatted, bound, framed and furry ones, each one instance.

Lengths are metres. Every thing stands on z = 0 with its front towards -y; what hangs has its back in the plane y = 0.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ss_flow.flows.generated.layout import COLORS, Material, Thing
from ss_flow.flows.generated.prints import (
    FACES,
    LIFT,
    PRINTS,
    ellipse,
    face_size,
    lines_of_text,
    on_face,
    rectangle,
    sheet,
)
from ss_flow.flows.generated.shapes import Mesh, ball, box, joined, turned_profile
from ss_flow.tasks.artifacts import Float64

_AROUND = 12
"""Corners of a bar's cross-section."""
PAINTS = {
    **COLORS,
    "white": (240, 238, 230),
    "cream": (228, 216, 196),
    "sand": (202, 190, 170),
    "brown": (118, 76, 46),
    "umber": (82, 50, 30),
    "ochre": (166, 134, 98),
    "tan": (198, 158, 110),
    "grey": (136, 138, 142),
    "sky": (150, 195, 230),
}
"""sRGB of all colours that parts have."""


@dataclass(frozen=True)
class Piece:
    """One mesh of one material."""

    part: str
    """The part it belongs to; several pieces may make up one part."""
    mesh: Mesh
    material: Material


@dataclass(frozen=True)
class Composite:
    """A thing made of pieces."""

    name: str
    """Colour word and noun."""
    pieces: tuple[Piece, ...]

    def turned(self, angle: float, axis: int = 2) -> Composite:
        """All pieces rotated by `angle` (radians) about a coordinate axis."""
        return replace(self, pieces=tuple(replace(p, mesh=p.mesh.turned(angle, axis)) for p in self.pieces))

    def moved(self, x: float, y: float, z: float) -> Composite:
        """All pieces shifted."""
        return replace(self, pieces=tuple(replace(p, mesh=p.mesh.moved(x, y, z)) for p in self.pieces))

    @property
    def bounds(self) -> Float64:
        """[2, 3] the lowest and the highest coordinates."""
        vertices = np.concatenate([p.mesh.vertices for p in self.pieces])
        return np.stack([vertices.min(axis=0), vertices.max(axis=0)])

    @property
    def parts(self) -> tuple[str, ...]:
        """The names of the parts, in the order of their ids 1..; none where there is only one."""
        names = tuple(dict.fromkeys(p.part for p in self.pieces))
        return names if len(names) > 1 else ()

    def things(self, instance_id: int) -> tuple[Thing, ...]:
        """The pieces as the renderer takes them."""
        ids = {name: number for number, name in enumerate(self.parts, 1)}
        color = self.name.split()[0]
        return tuple(
            Thing(instance_id, self.name, color, p.mesh, p.material, ids.get(p.part, 0), p.part) for p in self.pieces
        )


def paint(color: str, shade: str = "", pattern: str = "noise", scale: float = 0.03) -> Material:
    """A material of one colour, or of two mixed by a pattern."""
    return Material(pattern, (PAINTS[color], PAINTS[shade or color]), scale)


def printed_box(colors: Sequence[str], rng: np.random.Generator) -> Composite:
    """A box whose six faces have a colour and a print each, with a sticker on the front. colors: at least seven."""
    size = 0.3, 0.22, 0.26
    prints = rng.permutation(list(PRINTS))
    pieces = []
    for i, (face, kind) in enumerate(zip(FACES, prints, strict=True)):
        width, height = face_size(face, size)
        ink = "white" if i % 2 else colors[i + 1]
        ground, print_ = sheet([rectangle(0, 0, width, height)]), sheet(PRINTS[kind](width, height), LIFT)
        pieces += [Piece(face, on_face(ground, face, size), paint(colors[i])),
                   Piece(face, on_face(print_, face, size), paint(ink))]  # fmt: skip
    at = float(rng.uniform(-0.05, 0.05)), float(rng.uniform(-0.04, 0.04))
    for lift, outline, color in ((2, ellipse(*at, 0.12, 0.12), "white"), (3, ellipse(*at, 0.07, 0.07), colors[6])):
        pieces.append(Piece("sticker", on_face(sheet([outline], lift * LIFT), "front", size), paint(color)))
    return Composite(f"{colors[0]} box", tuple(pieces))


def brick(color: str, ends: str, rng: np.random.Generator) -> Composite:
    """A block with striped sides, plain ends, studs on top and a label on its front and top."""
    size = 0.32, 0.15, 0.12
    pieces = []
    for face in FACES:
        material = paint(ends) if face in ("left", "right") else paint(color, "tan", "stripes", 0.05)
        if face == "top":
            material = paint(color)
        name = {"left": "ends", "right": "ends", "top": "top"}.get(face, "sides")
        pieces.append(Piece(name, on_face(sheet([rectangle(0, 0, *face_size(face, size))]), face, size), material))
    stud = turned_profile([(0.022, 0), (0.022, 0.012), (0, 0.012)], segments=16)
    studs = [stud.moved(x, y, size[2]) for x in (-0.12, -0.06, 0.06, 0.12) for y in (-0.04, 0.04)]
    pieces.append(Piece("studs", joined(studs), paint(color, ends)))
    x = float(rng.uniform(-0.06, 0.06))
    for face, width, height, at in (("front", 0.16, 0.08, x), ("top", 0.06, 0.12, 0.0)):
        ground = sheet([rectangle(0, 0, width, height)], LIFT).moved(at, 0, 0)
        words = sheet(lines_of_text(width, height), 2 * LIFT).moved(at, 0, 0)
        pieces += [Piece("label", on_face(ground, face, size), paint("white")),
                   Piece("label", on_face(words, face, size), paint("black"))]  # fmt: skip
    return Composite(f"{color} brick", tuple(pieces))


def tube(path: Float64, radius: float) -> Mesh:
    """A round bar along a path. path: [n, 3], all in one plane y = constant."""
    along = np.gradient(path, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    across = np.cross(along, (0.0, 1.0, 0.0))
    angle = np.linspace(0, 2 * np.pi, _AROUND, endpoint=False)
    normals = np.cos(angle)[None, :, None] * across[:, None] + np.sin(angle)[None, :, None] * np.array([0.0, 1.0, 0.0])
    vertices = (path[:, None] + radius * normals).reshape(-1, 3)
    here = np.arange((len(path) - 1) * _AROUND)
    beside = here // _AROUND * _AROUND + (here + 1) % _AROUND
    triangles = np.concatenate(
        [np.stack([here, beside + _AROUND, beside], 1), np.stack([here, here + _AROUND, beside + _AROUND], 1)]
    )
    return Mesh(vertices, normals.reshape(-1, 3), vertices, triangles.astype(np.int32))


def cup(outside: str, inside: str, band: str) -> Composite:
    """A mug: a body with a band round it, a handle (towards +x), another colour inside."""
    radius, height, wall = 0.085, 0.2, 0.008
    inner = radius - wall
    angle = np.linspace(-np.pi / 2, np.pi / 2, 15)
    loop = np.stack([radius - 0.004 + 0.06 * np.cos(angle), 0 * angle, height / 2 + 0.058 * np.sin(angle)], axis=1)
    return Composite(
        f"{outside} mug",
        (
            Piece("body", turned_profile([(0, 0), (radius, 0), (radius, height), (inner, height)]), paint(outside)),
            Piece("body", turned_profile([(radius + LIFT, 0.12), (radius + LIFT, 0.165)]), paint(band)),
            Piece("inside", turned_profile([(inner, height), (inner, 0.02), (0, 0.02)]), paint(inside)),
            Piece("handle", tube(loop, 0.013), paint(band)),
        ),
    )


def slatted_chair(slats: str, frame: str) -> Composite:
    """A chair: a seat of slats, a back of slats, legs of another colour."""
    width, seat, top, leg = 0.46, 0.42, 0.88, 0.04
    side = (width - leg) / 2
    posts = [box(leg, leg, seat if y < 0 else top).moved(x * side, y * side, 0) for x in (-1, 1) for y in (-1, 1)]
    rails = [box(leg, width, 0.05).moved(x * side, 0, seat - 0.05) for x in (-1, 1)]
    seats = [box(width, 0.068, 0.022).moved(0, y, seat) for y in np.linspace(-0.4, 0.27, 5) * width]
    backs = [box(width - leg, 0.02, 0.06).moved(0, side - 0.03, z) for z in np.linspace(seat + 0.1, top - 0.08, 4)]
    return Composite(
        f"{slats} chair",
        (
            Piece("legs", joined([*posts, *rails]), paint(frame)),
            Piece("seat", joined(seats), paint(slats)),
            Piece("back", joined(backs), paint(slats)),
        ),
    )


def book(color: str, title: str) -> Composite:
    """A book lying on its back: covers with a title, a spine (towards -x), pages."""
    width, depth, thick, board = 0.22, 0.3, 0.06, 0.006
    boards = [box(width, depth, board).moved(0, 0, z) for z in (0, thick - board)]
    size = width, depth, thick
    words = [*lines_of_text(0.16, 0.1, 3), rectangle(0, -0.09, 0.12, 0.06)]
    on_spine = [rectangle(0.03, 0, 0.14, 0.02), rectangle(-0.1, 0, 0.04, 0.035)]
    spine = box(board, depth, thick).moved(-width / 2 - board / 2, 0, 0)
    size_with_spine = width + 2 * board, depth, thick
    return Composite(
        f"{color} book",
        (
            Piece("cover", joined(boards), paint(color)),
            Piece("cover", on_face(sheet(words, LIFT).moved(0, 0, 0.05), "top", size), paint(title)),
            Piece(
                "pages",
                box(width - 0.01, depth - 0.016, thick - 2 * board).moved(-0.004, 0, board),
                paint("white", "tan", "stripes", 0.008),
            ),
            Piece("spine", spine, paint(title)),
            Piece("spine", on_face(sheet(on_spine, LIFT), "left", size_with_spine), paint(color)),
        ),
    )


def stood_up(lying: Composite) -> Composite:
    """A book on its lower edge, its cover to the front, its spine to the left."""
    up = lying.turned(np.pi / 2, axis=0)
    return up.moved(0, 0, -float(up.bounds[0, 2]))


def stretched(mesh: Mesh, factors: tuple[float, float, float]) -> Mesh:
    """A mesh scaled differently along x, y, z."""
    normals = mesh.normals / factors
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return Mesh(mesh.vertices * factors, normals, mesh.texture * factors, mesh.triangles)


def tufts(radius: float, count: int, rng: np.random.Generator) -> Mesh:
    """Hair on a ball about the origin: thin pyramids that lean this way and that."""
    height = 1 - 2 * (np.arange(count) + 0.5) / count
    turn = np.pi * (1 + 5**0.5) * np.arange(count)
    out = np.stack([np.sqrt(1 - height**2) * np.cos(turn), np.sqrt(1 - height**2) * np.sin(turn), height], axis=1)
    lean = out + rng.normal(0, 0.35, out.shape) - (0, 0, 0.35)
    tip = radius * out + lean * rng.uniform(0.12, 0.26, (count, 1)) * radius
    side = np.cross(out, rng.normal(size=out.shape))
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    other = np.cross(out, side)
    angle = 2 * np.pi * np.arange(3) / 3
    width = 0.045 * radius
    base = 0.97 * radius * out[:, None] + width * (
        np.cos(angle)[:, None] * side[:, None] + np.sin(angle)[:, None] * other[:, None]
    )
    corners = np.stack([base, np.roll(base, -1, axis=1), np.repeat(tip[:, None], 3, axis=1)], axis=2)
    face = np.cross(corners[:, :, 1] - corners[:, :, 0], corners[:, :, 2] - corners[:, :, 0])
    # Half the ball's own normal: hair is lit as a coat, not strand by strand.
    normals = face / np.linalg.norm(face, axis=-1, keepdims=True) + out[:, None]
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    vertices = corners.reshape(-1, 3)
    triangles = np.arange(len(vertices), dtype=np.int32).reshape(-1, 3)
    return Mesh(vertices, np.repeat(normals.reshape(-1, 3), 3, axis=0), vertices, triangles)


def furry_head(fur: str, shade: str, inner: str, rng: np.random.Generator) -> Composite:
    """A furry round head about the origin: ears, a muzzle, a nose and eyes of other colours."""
    r = 0.15
    coat = paint(fur, shade, "noise", 0.02)

    def lump(size: tuple[float, float, float], x: float, y: float, z: float) -> Mesh:
        return stretched(ball(1.0).moved(0, 0, -1), (size[0] * r, size[1] * r, size[2] * r)).moved(x * r, y * r, z * r)

    ears = [lump((0.36, 0.2, 0.42), s * 0.82, 0, 0.95) for s in (-1, 1)]
    hollows = [lump((0.2, 0.14, 0.25), s * 0.82, -0.13, 0.95) for s in (-1, 1)]
    eyes = [lump((0.13, 0.13, 0.15), s * 0.42, -1.0, 0.38) for s in (-1, 1)]
    return Composite(
        f"{fur} head",
        (
            Piece("fur", ball(0.99 * r).moved(0, 0, -0.99 * r), coat),
            Piece("fur", tufts(r, 2600, rng), coat),
            Piece("ears", joined(ears), coat),
            Piece("ears", joined(hollows), paint(inner)),
            Piece("muzzle", lump((0.5, 0.45, 0.4), 0, -0.95, -0.3), paint("tan", "white", "noise", 0.02)),
            Piece("nose", lump((0.16, 0.12, 0.12), 0, -1.4, -0.15), paint("black")),
            Piece("eyes", joined(eyes), paint("black")),
        ),
    )


def slab(outline: Float64, thickness: float) -> Mesh:
    """A flat thing with its back in the plane y = 0. outline: [n, 2] as for `sheet`."""
    n = len(outline)
    following = np.roll(outline, -1, axis=0)
    edge = following - outline
    normal = np.stack([edge[:, 1], 0 * edge[:, 0], -edge[:, 0]], axis=1) / np.linalg.norm(edge, axis=1, keepdims=True)
    corners = [(outline, 0.0), (following, 0.0), (following, thickness), (outline, thickness)]
    vertices = np.stack([np.stack([p[:, 0], np.full(n, -y), p[:, 1]], axis=1) for p, y in corners], axis=1)
    first = 4 * np.arange(n)[:, None]
    triangles = np.concatenate([first + np.array(corner) for corner in ((0, 1, 2), (0, 2, 3))]).astype(np.int32)
    placed = vertices.reshape(-1, 3)
    return joined([sheet([outline], thickness), Mesh(placed, np.repeat(normal, 4, axis=0), placed, triangles)])


def plaque(board: str, rim: str) -> Composite:
    """A shield to hang things on: a board with a rim of another colour."""
    shield = np.array(
        [(-0.26, 0.26), (-0.28, 0.0), (-0.22, -0.2), (0.0, -0.4), (0.22, -0.2), (0.28, 0.0), (0.26, 0.26)]
    )
    return Composite(
        f"{board} plaque",
        (
            Piece("board", sheet([0.86 * shield], 0.03 + LIFT), paint(board, "brown", "planks", 0.09)),
            Piece("rim", slab(shield, 0.03), paint(rim)),
        ),
    )


def picture(frame: str, colors: Sequence[str]) -> Composite:
    """A landscape in a frame. colors: of the hills, the sun, the house and its roof."""
    width, height, bar, deep = 0.62, 0.46, 0.04, 0.03
    w, h = width - 2 * bar, height - 2 * bar
    bars = [slab(rectangle(0, s * (height - bar) / 2, width, bar), deep) for s in (-1, 1)]
    bars += [slab(rectangle(s * (width - bar) / 2, 0, bar, h), deep) for s in (-1, 1)]
    x = np.linspace(-w / 2, w / 2, 25)
    crest = h * (-0.1 + 0.13 * np.sin(9 * x / w + 1))
    ends = zip(x, x[1:], crest, crest[1:], strict=False)
    hills = [np.array([(left, -h / 2), (right, -h / 2), (right, after), (left, before)])
             for left, right, before, after in ends]  # fmt: skip
    roof = np.array([(-0.14, 0), (0.14, 0), (0, 0.17)]) * (w, h) - (0.16 * w, 0.11 * h)
    painted = (
        ([rectangle(0, 0, w, h)], "sky"),
        (hills, colors[0]),
        ([ellipse(0.26 * w, 0.27 * h, 0.08, 0.08)], colors[1]),
        ([rectangle(-0.16 * w, -0.24 * h, 0.22 * w, 0.26 * h)], colors[2]),
        ([roof], colors[3]),
    )
    return Composite(
        f"{frame} picture",
        (
            Piece("frame", joined(bars), paint(frame)),
            *(Piece("picture", sheet(o, 0.008 + i * LIFT), paint(c)) for i, (o, c) in enumerate(painted)),
        ),
    )
