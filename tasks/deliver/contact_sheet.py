"""Several pictures on one sheet, and text as a picture."""

from __future__ import annotations

import io
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from ss_flow.tasks.artifacts import UInt8

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from matplotlib.patches import Rectangle

PAPER = (250, 250, 248)
INK = "#22242a"
FAINT = "#8a8d96"
_DPI = 100
_CAPTION = 26
_GAP = 10
_MOST_ROWS = 40
_OF_TABLE = 800
"""Width of a table's picture, pixels."""


def contact_sheet(
    pictures: Sequence[UInt8], captions: Sequence[str] = (), *, columns: int | None = None, width: int = 1400
) -> UInt8:
    """Pictures in rows on one sheet, each scaled into a cell of equal size: [H, width, 3].

    pictures: [h, w, 3] RGB, of any sizes. captions: one a picture, or none. columns: by default the count that makes
    the sheet about as wide as 4 : 3. Raises ValueError for no pictures, or captions of another count.
    """
    if not len(pictures) or (len(captions) not in (0, len(pictures))):
        raise ValueError(f"{len(pictures)} pictures and {len(captions)} captions make no sheet")
    import cv2

    aspect = float(np.median([picture.shape[1] / picture.shape[0] for picture in pictures]))
    across = columns or max(1, min(len(pictures), round((len(pictures) * 4 / 3 / aspect) ** 0.5)))
    down = -(-len(pictures) // across)
    cell_w = (width - _GAP * (across + 1)) // across
    cell_h = round(cell_w / aspect)
    below = _CAPTION if captions else 0
    sheet = np.full((down * (cell_h + below + _GAP) + _GAP, width, 3), PAPER, np.uint8)
    for i, picture in enumerate(pictures):
        x, y = _GAP + i % across * (cell_w + _GAP), _GAP + i // across * (cell_h + below + _GAP)
        h, w = picture.shape[:2]
        scale = min(cell_w / w, cell_h / h)
        size = max(1, round(w * scale)), max(1, round(h * scale))
        fitted = cv2.resize(picture, size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR)
        top, left = y + (cell_h - size[1]) // 2, x + (cell_w - size[0]) // 2
        sheet[top : top + size[1], left : left + size[0]] = fitted
        if captions:
            sheet[y + cell_h : y + cell_h + below, x : x + cell_w] = caption(captions[i], cell_w, below)
    return sheet


def caption(text: str, width: int, height: int = _CAPTION) -> UInt8:
    """A line of text, cut where it is too long: [height, width, 3]."""
    figure = blank(width, height)
    longest = max(1, int(width / 6.4))
    shown = text if len(text) <= longest else text[: longest - 1] + "…"
    figure.text(4 / width, 0.5, shown, fontsize=8, color=INK, va="center", parse_math=False)
    return as_picture(figure)


def blank(width: int, height: int) -> Figure:
    """An empty figure of a size in pixels, which needs no display."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure((width / _DPI, height / _DPI), dpi=_DPI, facecolor=f"#{bytes(PAPER).hex()}")
    FigureCanvasAgg(figure)
    return figure


def as_picture(figure: Figure) -> UInt8:
    """What a figure shows: [H, W, 3]."""
    raw = io.BytesIO()
    figure.savefig(raw, format="rgba", dpi=_DPI)
    width, height = (round(float(n) * _DPI) for n in figure.get_size_inches())
    return np.frombuffer(raw.getvalue(), np.uint8).reshape(height, width, 4)[..., :3].copy()


def table_picture(title: str, rows: Sequence[tuple[str, ...]]) -> UInt8:
    """A table as a picture: the first column as names, the others right-aligned: [H, 800, 3]."""
    line, top = 28, 64
    if len(rows) > _MOST_ROWS:
        rows = [*rows[: _MOST_ROWS - 1], (f"… and {len(rows) - _MOST_ROWS + 1} more rows",)]
    height = top + line * max(1, len(rows)) + 16
    figure = blank(_OF_TABLE, height)
    margin = 24 / _OF_TABLE
    figure.text(margin, 1 - 34 / height, title, fontsize=13, weight="bold", color=INK, va="center", parse_math=False)
    columns = max((len(row) for row in rows), default=1)
    for i, row in enumerate(rows):
        y = 1 - (top + line * (i + 0.5)) / height
        if i % 2 == 0:
            figure.add_artist(_band(figure, 1 - (top + line * (i + 1)) / height, line / height))
        figure.text(margin, y, row[0], fontsize=10, color=INK, va="center", parse_math=False)
        for j, cell in enumerate(row[1:], start=1):
            x = 1 - margin - (columns - 1 - j) * 0.18
            figure.text(x, y, cell, fontsize=10, color=INK, va="center", ha="right", parse_math=False)
    if not rows:
        figure.text(margin, 1 - (top + 14) / height, "nothing to show", fontsize=10, color=FAINT, va="center")
    return as_picture(figure)


def _band(figure: Figure, bottom: float, height: float) -> Rectangle:
    from matplotlib.patches import Rectangle

    return Rectangle((0, bottom), 1, height, transform=figure.transFigure, color="#efefec", zorder=-1)
