"""Any artifact as a picture."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from functools import singledispatch

import numpy as np

from ss_flow.tasks.artifacts import (
    DRAWN,
    FOUND,
    PROMPTED,
    REFINED,
    Cameras,
    DepthMap,
    Descriptors,
    Float32,
    Frame,
    Gaussians,
    Hierarchy,
    InstanceMasks,
    Int32,
    LabelMap,
    MaskSet,
    Metrics,
    PointCloud,
    PointLabels,
    PointParts,
    UInt8,
    Visibility,
)
from ss_flow.tasks.deliver.compressed import Picture, Thumbnail, decompressed
from ss_flow.tasks.deliver.contact_sheet import FAINT, INK, as_picture, blank, caption, contact_sheet, table_picture
from ss_flow.tasks.deliver.palette import depth_colors, instance_colors, paint_ids, turbo
from ss_flow.tasks.deliver.point_view import draw_points, orbit_camera
from ss_flow.tasks.deliver.statistics import statistics
from ss_flow.tasks.geometry.cameras import Camera, camera_of, centers_of, level_axes, up_of
from ss_flow.tasks.geometry.images import decode_rgb
from ss_flow.tasks.models.colour_words import TERMS, ColourWords
from ss_flow.tasks.semantics.query import QueryResult

_MOST_ON_A_SHEET = 24
_NARROW = 320
"""Pixels below which the legend of a depth map takes two lines."""
_FIRST_TO_LAST = np.array([[0.13, 0.38, 0.82], [0.82, 0.19, 0.19]])
"""Blue and red: a dark page inverts the drawing and keeps its hues, so light and dark would not tell."""
_ORIGINS = {FOUND: "", PROMPTED: " (re-prompted)", REFINED: " (refined)", DRAWN: " (from points)"}
_TERM_COLORS = dict(grey="#8a8a8a", white="#e8e8e4", green="#2e8b45", yellow="#eac520", brown="#7b4a21", pink="#f08cb4")


@dataclass(frozen=True)
class Context:
    """What may help to draw an artifact; nothing is needed."""

    frame: Frame | None
    frames: Sequence[Frame]
    cameras: Cameras | None
    view: int
    points: PointCloud | None

    def photo(self, height: int, width: int, name: str | None = None) -> UInt8 | None:
        """The photo behind a picture of this size, of the view of this name; None where there is none of this size."""
        known = (*self.frames, *((self.frame,) if self.frame else ()))
        frame = self.frame if name is None else next((frame for frame in known if frame.name == name), None)
        return decode_rgb(frame) if frame is not None and (frame.height, frame.width) == (height, width) else None

    def camera(self, points: Float32) -> Camera:
        """The view's camera, or one that shows all the points."""
        return orbit_camera(points) if self.cameras is None else camera_of(self.cameras, self.view)


def draw(
    value: object,
    *,
    frame: Frame | None = None,
    frames: Sequence[Frame] = (),
    cameras: Cameras | None = None,
    view: int = 0,
    points: PointCloud | None = None,
) -> UInt8:
    """A picture of an artifact, or of a list of them: [H, W, 3] RGB.

    frame: the photo behind masks, labels or points of one view. frames: all photos, where an artifact (or a list of
    them) is about several views. cameras, view: the camera that looks at points and Gaussians; without cameras, one
    that shows all of them from outside. points: the dense points, which labels refer to.
    """
    return _draw(value, Context(frame, frames, cameras, view, points))


@singledispatch
def _draw(value: object, context: Context) -> UInt8:
    if not is_dataclass(value):
        return table_picture(type(value).__name__, [("value", _said(value))])
    return table_picture(type(value).__name__, [(f.name, _said(getattr(value, f.name))) for f in fields(value)])


def _said(value: object) -> str:
    if isinstance(value, np.ndarray):
        short = 0 < value.size <= 8 and value.dtype.kind in "iuf"
        words = ", ".join(f"{number:.4g}" for number in value.flat) if short else statistics(value)
        text = f"{value.dtype} [{', '.join(map(str, value.shape))}]{': ' if words else ''}{words}"
    else:
        text = f"{value:.6g}" if isinstance(value, float) else str(value)
    return text if len(text) <= 90 else text[:89] + "…"


@_draw.register(tuple)
@_draw.register(list)
def _(value: Sequence[object], context: Context) -> UInt8:
    if not value:
        return table_picture("an empty list", [])
    shown = value[:_MOST_ON_A_SHEET]
    of_views = len(context.frames) == len(value)
    pictures = []
    for i, item in enumerate(shown):
        frame, view = (context.frames[i], i) if of_views else (context.frame, context.view)
        pictures.append(_draw(item, replace(context, frame=frame, view=view)))
    captions = [_caption(item, i) for i, item in enumerate(shown)]
    if len(value) > len(shown):
        captions[-1] += f"   (and {len(value) - len(shown)} more)"
    return contact_sheet(pictures, captions)


def _caption(item: object, index: int) -> str:
    instance = getattr(item, "instance_id", None)
    if isinstance(instance, int):
        return f"instance {instance}"
    return str(getattr(item, "name", index))


@_draw.register
def _(value: Frame, context: Context) -> UInt8:
    return decode_rgb(value)


@_draw.register
def _(value: Picture | Thumbnail, context: Context) -> UInt8:
    return decompressed(value.content)


@_draw.register
def _(value: MaskSet, context: Context) -> UInt8:
    dense = value.dense()
    ids = np.zeros((value.height, value.width), np.int32)
    for index in np.argsort(-dense.sum(axis=(1, 2)), kind="stable"):
        ids[dense[index]] = index + 1
    return paint_ids(ids, context.photo(value.height, value.width))


@_draw.register
def _(value: LabelMap, context: Context) -> UInt8:
    return paint_ids(value.ids.astype(np.int32), context.photo(*value.ids.shape))


@_draw.register
def _(value: DepthMap, context: Context) -> UInt8:
    colors, low, high = depth_colors(value.depth)
    known = float((value.depth > 0).mean())
    return np.concatenate([colors, _depth_legend(colors.shape[1], low, high, f"{value.source}, {known:.0%} known")])


def _depth_legend(width: int, low: float, high: float, note: str) -> UInt8:
    ramp = np.repeat(turbo()[None, np.linspace(255, 0, width).astype(np.intp)], 10, axis=0)
    lines = [f"{low:.3g}   to   {high:.3g}   ({note})"]
    if width < _NARROW:
        lines = [f"{low:.3g}   to   {high:.3g}", note]
    return np.concatenate([np.full((4, width, 3), 34, np.uint8), ramp, *(caption(line, width) for line in lines)])


@_draw.register
def _(value: InstanceMasks, context: Context) -> UInt8:
    pictures, captions = [], []
    order = np.argsort(-value.areas(), kind="stable")[:12]
    for row in np.sort(order).tolist():
        ids = np.where(value.mask(row), value.instance_id, 0)
        name = value.views[row]
        width, height = value.sizes[row].tolist()
        pictures.append(paint_ids(ids, context.photo(height, width, name), 0.45))
        captions.append(name + _ORIGINS[int(value.origin[row])])
    if pictures:
        return contact_sheet(pictures, captions)
    if len(value.points):
        return _points_picture(value.points, value.colors, _spacing(value.points), context)
    return table_picture(f"instance {value.instance_id}", [("masks", "0"), ("points", "0")])


@_draw.register
def _(value: PointCloud, context: Context) -> UInt8:
    return _points_picture(value.points, value.colors, value.spacing_of(), context)


@_draw.register
def _(value: PointLabels, context: Context) -> UInt8:
    return _numbered_points("PointLabels", value.label, ("unlabelled", "label"), context)


@_draw.register
def _(value: PointParts, context: Context) -> UInt8:
    return _numbered_points("PointParts", value.part, ("whole objects", "part"), context)


def _numbered_points(title: str, number: Int32, words: tuple[str, str], context: Context) -> UInt8:
    """The dense points in the colours of their numbers, 0 grey; without the points, how many have each number.

    words: what 0 means, and what comes before another number.
    """
    if context.points is None or len(context.points.points) != len(number):
        counts = np.bincount(number)
        rows = [(f"{words[1]} {i}" if i else words[0], f"{counts[i]} points") for i in np.flatnonzero(counts)]
        return table_picture(title, rows)
    colors = instance_colors(int(number.max(initial=0)) + 1)
    colors[0] = (190, 190, 190)
    return _points_picture(context.points.points, colors[number], context.points.spacing_of(), context)


def _points_picture(points: Float32, colors: UInt8, spacing: float, context: Context) -> UInt8:
    if not len(points):
        return table_picture("points", [])
    return draw_points(points, colors, context.camera(points), spacing)


def _spacing(points: Float32) -> float:
    """A rough spacing of points on surfaces: the extent over the root of the count."""
    return float(np.linalg.norm(np.ptp(points, axis=0)) / max(1.0, len(points) ** 0.5))


@_draw.register
def _(value: Visibility, context: Context) -> UInt8:
    photo = context.photo(value.height, value.width)
    image = np.full((value.height, value.width, 3), 34, np.uint8) if photo is None else (photo * 0.45).astype(np.uint8)
    colors, low, high = depth_colors(value.depth)
    v, u = np.divmod(value.pixel, value.width)
    for dy, dx in ((0, 0), (0, 1), (1, 0), (1, 1)):
        image[np.minimum(v + dy, value.height - 1), np.minimum(u + dx, value.width - 1)] = colors
    return np.concatenate([image, _depth_legend(value.width, low, high, f"{len(value.pixel)} points")])


@_draw.register
def _(value: Gaussians, context: Context) -> UInt8:
    if not len(value):
        return table_picture("Gaussians", [])
    from ss_flow.tasks.gaussians.render import render

    rendering = render(value, context.camera(value.means), background=(0.957, 0.961, 0.969))
    return np.rint(255 * rendering.rgb.clip(0, 1)).astype(np.uint8)


@_draw.register
def _(value: Cameras, context: Context) -> UInt8:
    poses = value.world_to_camera
    if not len(value):
        return table_picture("Cameras", [])
    plane = np.stack(level_axes(up_of(poses)), axis=1)
    seen, looks = centers_of(poses) @ plane, poses[:, 2, :3] @ plane
    figure = blank(560, 500)  # about as wide as a report shows it, so that its words keep their size
    axes = figure.add_axes((0.11, 0.11, 0.85, 0.81))
    axes.set_facecolor("none")
    background = context.points.points if context.points is not None else value.sparse_points
    if len(background):
        thinned = background[:: max(1, len(background) // 20_000)] @ plane
        axes.scatter(thinned[:, 0], thinned[:, 1], s=1, color="#c9ccd4", linewidths=0)
        low, high = np.percentile(thinned, (1, 99), axis=0)
    else:
        low, high = seen.min(axis=0), seen.max(axis=0)
    order = np.linspace(0, 1, len(value))
    axes.plot(*seen.T, color=FAINT, linewidth=0.6, zorder=2)
    colors = np.stack([1 - order, order], axis=1) @ _FIRST_TO_LAST
    axes.quiver(*seen.T, *looks.T, color=colors, width=0.004, scale=22, zorder=3)
    low, high = np.minimum(low, seen.min(axis=0)), np.maximum(high, seen.max(axis=0))
    pad = 0.08 * max(float((high - low).max()), 1e-6)
    box = np.array(axes.bbox.size)  # filled whatever the way's shape: beside a narrow one the title would be cut off
    reach = box * float(np.max(((high - low) / 2 + pad) / box))
    ends = (low + high) / 2 + np.outer((-1, 1), reach)
    axes.set(xlim=ends[:, 0], ylim=ends[:, 1], aspect="equal")
    axes.set_title(f"{len(value)} cameras from above, first blue to last red", fontsize=11, color=INK, loc="left")
    axes.set_xlabel("metres" if value.metric else "world units", fontsize=9, color=INK)
    axes.tick_params(labelsize=8, colors=INK)
    axes.spines[["top", "right"]].set_visible(False)
    return as_picture(figure)


@_draw.register
def _(value: Descriptors, context: Context) -> UInt8:
    title = f"instance {value.instance_id}: {value.encoder}, {len(value.views)} views"
    if value.encoder != ColourWords.name:
        rows = [("dimensions", str(len(value.embedding))), ("length", f"{np.linalg.norm(value.embedding):.3f}")]
        seen = zip(value.views, value.weights, strict=True)
        return table_picture(title, [*rows, *((view, f"{area:.0f} px") for view, area in seen)])
    figure = blank(800, 420)
    axes = figure.add_axes((0.12, 0.1, 0.84, 0.76))
    colors = [_TERM_COLORS.get(term, term) for term in TERMS]
    axes.barh(TERMS, value.embedding**2, color=colors, edgecolor="#b8bac0", linewidth=0.6)
    axes.invert_yaxis()
    axes.set(xlim=(0, 1))
    axes.set_title(title, fontsize=11, color=INK, loc="left")
    axes.tick_params(labelsize=9, colors=INK)
    axes.spines[["top", "right"]].set_visible(False)
    return as_picture(figure)


@_draw.register
def _(value: QueryResult, context: Context) -> UInt8:
    rows: list[tuple[str, ...]] = [("instance", "score", "delta", "relevancy", "matches")]
    for i, instance in enumerate(value.instance_id[:20]):
        figures = (f"{x[i]:.3f}" for x in (value.score, value.delta, value.relevancy))
        rows.append((str(instance), *figures, "yes" if value.matched[i] else "no"))
    return table_picture(f"“{value.text}” ({value.encoder})", rows)


@_draw.register
def _(value: Hierarchy, context: Context) -> UInt8:
    row_of, rows = value.row_of(), [("node", "kind", "agreement")]

    def down(node: int, depth: int) -> None:
        row = row_of[node]
        below = value.node[value.parent == node].tolist()
        kind = "stuff" if value.stuff[row] else "thing"
        rows.append(("    " * depth + str(node), kind, f"{value.agreement[row]:.2f}" if below else ""))
        for child in below:
            down(child, depth + 1)

    for node in value.node[value.parent == 0].tolist():
        if (value.parent == node).any():
            down(node, 0)
    return table_picture("What the labels make up", rows)


@_draw.register
def _(value: Metrics, context: Context) -> UInt8:
    return table_picture("Metrics", [(name, f"{figure:.4f}") for name, figure in value.values.items()])
