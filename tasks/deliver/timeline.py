"""When each step of a run computed, and what memory it took."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

_THINNEST = 0.15
"""Per cent of the whole time that a bar is wide at least; bars that touch become one."""


def timeline(nodes: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """A row for each step that computed something, by its first start: name, and its bars (left, width) in per cent of
    the whole time.

    nodes: those of run.json ("step", "hit", "seconds", "ended" - the time in seconds). What came from the cache took
    no time; without any "ended" there are no rows.
    """
    spans: dict[str, list[tuple[float, float]]] = {}
    for node in nodes:
        if not node.get("hit") and node.get("ended"):
            end = float(node["ended"])
            spans.setdefault(str(node["step"]), []).append((end - float(node.get("seconds") or 0), end))
    if not spans:
        return []
    first = min(start for of_step in spans.values() for start, _ in of_step)
    last = max(end for of_step in spans.values() for _, end in of_step)
    scale = 100 / max(last - first, 1e-9)
    rows = sorted(spans.items(), key=lambda item: min(item[1]))
    return [
        {"name": name, "bars": _joined([((a - first) * scale, (b - first) * scale) for a, b in sorted(of_step)])}
        for name, of_step in rows
    ]


def _joined(spans: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """Left and width of the bars. spans: start and end, by rising start."""
    bars: list[list[float]] = []
    for start, end in spans:
        end = max(end, start + _THINNEST)
        if bars and start <= bars[-1][1]:
            bars[-1][1] = max(bars[-1][1], end)
        else:
            bars.append([start, end])
    return [(round(min(start, 100 - _THINNEST), 2), round(min(end, 100) - start, 2)) for start, end in bars]
