"""The picture of a sweep: figures over one parameter, or a map over two."""

from __future__ import annotations

import io
import itertools
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from ss_flow.flows import paper
from ss_flow.flows.cli.sweep_report import Document, in_short, scene_names, short_names

if TYPE_CHECKING:
    from matplotlib.axes import Axes

MOST_PANELS = 9
DECADES = 100.0
"""Values that span at least this factor are drawn over a logarithmic axis."""


def plot(rows: Sequence[Document], metrics: Sequence[str], *, zipped: bool) -> bytes | None:
    """A PNG file of the figures of a sweep; None when there are none.

    Over one parameter, a panel for each kind of figure (miou, psnr, ...) with a line for each stage and scene, and the
    paper's own curve where it prints one. Over two that were combined, a map of the first figure for each scene. Else
    the variants stand side by side.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    if not metrics:
        return None
    params = list(rows[0]["params"])
    scenes = scene_names(rows)
    as_map = len(params) == 2 and not zipped
    kinds = list(dict.fromkeys(name.rpartition(".")[2] for name in metrics))[:MOST_PANELS]
    panels = len(scenes) if as_map else len(kinds)
    columns = 2 if panels == 4 else min(panels, 3)
    lines = -(-panels // columns)
    figure = Figure(figsize=(4.6 * columns, 3.6 * lines), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(lines, columns, squeeze=False).ravel()
    for unused in axes[panels:]:
        unused.set_axis_off()
    if as_map:
        known = [row["metrics"][metrics[0]] for row in rows if metrics[0] in row["metrics"]]
        for axis, (scene, name) in zip(axes, scenes.items(), strict=False):
            _map(axis, [row for row in rows if row["scene"] == scene], params, metrics[0], (min(known), max(known)))
            axis.set_title(metrics[0] if len(scenes) == 1 else f"{name}: {metrics[0]}")
    else:
        for axis, kind in zip(axes, kinds, strict=False):
            _lines(axis, rows, params, [name for name in metrics if name.rpartition(".")[2] == kind], scenes)
            axis.set_title(kind)
    picture = io.BytesIO()
    figure.savefig(picture, format="png", dpi=120)
    return picture.getvalue()


def _lines(
    axis: Axes, rows: Sequence[Document], params: Sequence[str], metrics: Sequence[str], scenes: Mapping[str, str]
) -> None:
    """Figures of one kind over the only parameter, or over the variants in order."""
    from matplotlib.ticker import MaxNLocator

    numeric = len(params) == 1 and all(_is_number(row["params"][params[0]]) for row in rows)
    over = [_words(row, params) for row in rows]
    places = {text: place for place, text in enumerate(dict.fromkeys(over))}
    markers = itertools.cycle("osD^v")
    seen: list[float] = []
    for scene, scene_name in scenes.items():
        own = [(row, text) for row, text in zip(rows, over, strict=True) if row["scene"] == scene]
        for metric in metrics:
            points = [
                (row["params"][params[0]] if numeric else places[text], row["metrics"][metric])
                for row, text in own
                if metric in row["metrics"]
            ]
            stage = metric.rpartition(".")[0]
            label = stage if len(scenes) == 1 else f"{scene_name}: {stage}"
            if points:
                axis.plot(*zip(*sorted(points), strict=True), marker=next(markers), label=label, alpha=0.8)
            seen += [x for x, _ in points]
    for metric in metrics if numeric else ():
        if (published := paper.curves().get((params[0], metric))) is not None:
            drawn = (published.values, published.figures)
            axis.plot(*drawn, linestyle="--", marker="x", color="0.4", label=published.label)
            seen += published.values
    if numeric and _is_logarithmic(seen):
        axis.set_xscale("log")
    if not numeric:
        axis.set_xticks(list(places.values()), list(places), rotation=30, ha="right")
    if all(isinstance(value, int) for row in rows for name, value in row["metrics"].items() if name in metrics):
        axis.yaxis.set_major_locator(MaxNLocator(integer=True, min_n_ticks=1))
    axis.set_xlabel(params[0] if len(params) == 1 else "")
    axis.grid(alpha=0.3)
    axis.legend(fontsize="small")


def _is_logarithmic(values: Sequence[float]) -> bool:
    """Whether values span two decades, or are evenly spaced in the logarithm."""
    ascending = sorted(set(values))
    if len(ascending) < 2 or ascending[0] <= 0:
        return False
    ratios = [b / a for a, b in itertools.pairwise(ascending)]
    return ascending[-1] / ascending[0] >= DECADES or (len(ratios) > 1 and max(ratios) < 1.001 * min(ratios))


def _map(axis: Axes, rows: Sequence[Document], params: Sequence[str], metric: str, span: tuple[float, float]) -> None:
    """One figure over two parameters, as colours and numbers. span: the figures that the darkest and brightest mean."""
    places = [tuple(in_short(row["params"][name]) for name in params) for row in rows]
    down, across = (list(dict.fromkeys(values)) for values in zip(*places, strict=True))
    found = [[float("nan")] * len(across) for _ in down]
    for row, (first, second) in zip(rows, places, strict=True):
        found[down.index(first)][across.index(second)] = row["metrics"].get(metric, float("nan"))
    shades = axis.imshow(found, aspect="auto", cmap="viridis", vmin=span[0], vmax=span[1])
    axis.figure.colorbar(shades, ax=axis)
    for y, line in enumerate(found):
        for x, value in enumerate(line):
            if value == value:
                axis.text(x, y, f"{value:.3g}", ha="center", va="center", color="w" if value < sum(span) / 2 else "k")
    axis.set_xticks(range(len(across)), across)
    axis.set_yticks(range(len(down)), down)
    axis.set_xlabel(params[1])
    axis.set_ylabel(params[0])


def _words(row: Document, params: Sequence[str]) -> str:
    short = short_names(params)
    if len(params) == 1:
        return in_short(row["params"][params[0]])
    return "\n".join(f"{name}={in_short(row['params'][full])}" for name, full in zip(short, params, strict=True))


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)
