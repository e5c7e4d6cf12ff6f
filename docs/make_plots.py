"""Draw the plots of docs/performance.md from the tables of the pages: `python docs/make_plots.py`.

The figures are read off the tables, so that a plot cannot say what no table says.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import matplotlib
from matplotlib.axes import Axes

DOCS = Path(__file__).parent
IMAGES = DOCS / "images"


def table(page: str, heading: str) -> list[list[str]]:
    """The cells of the first table under a heading, its head first. Raises ValueError when there is none."""
    text = (DOCS / page).read_text(encoding="utf-8")
    section = re.split(rf"^#+ {re.escape(heading)}$", text, maxsplit=1, flags=re.MULTILINE)[1:]
    rows = re.findall(r"(?:^\|.*\n)+", section[0], re.MULTILINE) if section else []
    if not rows:
        raise ValueError(f"{page} has no table under {heading!r}")
    head, _, *body = [[cell.strip() for cell in line.strip("|").split("|")] for line in rows[0].splitlines()]
    return [head, *body]


def number(cell: str) -> float:
    """The first number of a cell: "106 s" is 106, "1,275" is 1275, "1.1 to 1.8" is 1.1."""
    return float(re.findall(r"[\d.]+", cell.replace(",", ""))[0])


def stages(axes: Axes) -> None:
    head, seconds = table("measurements/captures.md", "Photos alone, from beginning to end")
    axes.barh(head[::-1], [number(cell) for cell in seconds][::-1])
    axes.set_xlabel("seconds of tasks, two side by side")


def sfm_growth(axes: Axes) -> None:
    head, *rows = table("measurements/captures.md", "Poses from photos")
    below = [0.0] * len(rows)
    for column in range(2, 6):
        values = [number(row[column]) for row in rows]
        axes.bar([row[0] for row in rows], values, bottom=below, label=head[column])
        below = [a + b for a, b in zip(below, values, strict=True)]
    axes.set(xlabel="photos", ylabel="processor seconds")
    axes.legend(frameon=False)


def splat_growth(axes: Axes) -> None:
    _, *rows = table("measurements/splat.md", "Time and memory")
    x, y = [number(row[1]) for row in rows], [number(row[2]) for row in rows]
    axes.plot(x, y, "o")
    for row, right, up in zip(rows, x, y, strict=True):
        axes.annotate(row[0], (right, up), xytext=(6, -12), textcoords="offset points")
    axes.set(xlabel="instances", ylabel="seconds, two workers", xlim=(0, 260), ylim=(0, 240))


def engine(axes: Axes) -> None:
    _, *rows = table("engine.md", "What it costs")
    names = [row[0] for row in rows][::-1]
    height = 0.38
    for shift, column, label in ((height / 2, 1, "first run"), (-height / 2, 3, "all there")):
        places = [place + shift for place in range(len(rows))]
        axes.barh(places, [number(row[column]) for row in rows][::-1], height, label=label)
    axes.set_yticks(range(len(rows)), names)
    axes.set(xscale="log", xlabel="milliseconds a result")
    axes.legend(frameon=False)


PLOTS: tuple[Callable[[Axes], None], ...] = (stages, sfm_growth, splat_growth, engine)


def draw(folder: Path) -> list[Path]:
    """Write all plots as SVG into a folder; the same tables give the same bytes."""
    matplotlib.use("svg")
    from matplotlib import pyplot as plt

    written = []
    with plt.rc_context(
        {"svg.hashsalt": "ss-flow", "font.size": 9, "axes.spines.top": False, "axes.spines.right": False}
    ):
        for plot in PLOTS:
            figure, axes = plt.subplots(figsize=(6.4, 2.8), layout="constrained")
            plot(axes)
            written.append(folder / f"{plot.__name__}.svg")
            figure.savefig(written[-1], metadata={"Date": None})
            plt.close(figure)
    return written


if __name__ == "__main__":
    for path in draw(IMAGES):
        print(path)
