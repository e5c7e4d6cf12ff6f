"""Sweeps: one flow with many values of its parameters, run as one graph, so that what the variants share runs once.

    rows = sweep(flow, grid({"factor": [1.0, 2.0], "limit": [5, 10]}), store, scene="growth")

calls `flow(factor=1.0, limit=5)` and so on in flows of their own. Interrupted and called again, it goes on from there.
"""

from __future__ import annotations

import functools
import itertools
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

from ss_flow.cache.canonical import digest
from ss_flow.cache.store import Store
from ss_flow.engine import Report, Request, run_flows
from ss_flow.errors import InputError
from ss_flow.runs import DONE

T = TypeVar("T")
MOST_ROWS = 10_000
"""What a sweep may come to; each is a run of its own."""
_RANGE = re.compile(r"([^:]*):([^:]*):([^:]*?)(log)?")


@dataclass(frozen=True)
class Row:
    """One variant of a sweep and what it came to."""

    values: Mapping[str, Any]
    """The swept parameters by name."""
    report: Report
    hits: int
    """Results that were there, or were computed for an earlier row."""
    misses: int
    """Results that were computed and that no earlier row needed."""
    seconds: float
    """What computing those took, over all cores."""


def sweep(
    build: Callable[..., Mapping[str, Any]],
    variants: Sequence[Mapping[str, Any]],
    store: Store,
    *,
    scene: str,
    until: str | None = None,
    **options: Any,
) -> list[Row]:
    """Run `build(**variant)` for every variant; a row for each, in order.

    scene, until and options are those of `run_flow`. A variant is recorded as a run of its own, named after the scene
    and its values, and compared with the latest run of the scene itself.
    """
    asked = digest([in_words(v) for v in variants])
    requests = [Request(functools.partial(build, **v), scene, recorded_as(scene, v, asked), until) for v in variants]
    return rows_of(variants, run_flows(requests, store, **options))


def recorded_as(scene: str, values: Mapping[str, Any], asked: str = "") -> dict[str, Any]:
    """The header of a variant's run: a scene name of its own leaves `why` and `status` of the plain scene alone.

    asked: the same for all variants of a sweep.
    """
    texts = {name: str(value) for name, value in values.items()}
    return {"scene": f"{scene} [{in_words(texts)}]", "sweep": texts, "asked": asked}


def scene_of(header: Mapping[str, Any]) -> str:
    """The scene that a run is of, by its header: that of a variant names its values, too."""
    return str(header["scene"]).removesuffix(f" [{in_words(header.get('sweep', {}))}]")


def in_words(values: Mapping[str, Any]) -> str:
    """Values by name as words: "factor=1.0, limit=5"."""
    return ", ".join(f"{name}={value}" for name, value in values.items())


def rows_of(variants: Sequence[Mapping[str, Any]], reports: Sequence[Report]) -> list[Row]:
    """The rows of variants that ran as one graph; what several needed counts as computed for the first of them."""
    computed = {n["key"]: n["seconds"] for report in reports for n in report.nodes if n["event"] == "finished"}
    rows = []
    for values, report in zip(variants, reports, strict=True):
        keys = [node["key"] for node in report.nodes if node["event"] in DONE]
        own = [computed.pop(key) for key in dict.fromkeys(keys) if key in computed]
        rows.append(Row(values, report, len(keys) - len(own), len(own), sum(own)))
    return rows


def grid(lists: Mapping[str, Sequence[T]]) -> list[dict[str, T]]:
    """Every combination of the listed values; the last name varies fastest."""
    return [dict(zip(lists, values, strict=True)) for values in itertools.product(*lists.values())]


def zipped(lists: Mapping[str, Sequence[T]]) -> list[dict[str, T]]:
    """The first value of every list, the second of every list, and so on.

    Raises InputError when they are not equally long.
    """
    if len({len(values) for values in lists.values()}) > 1:
        lengths = ", ".join(f"{name} has {len(values)}" for name, values in lists.items())
        raise InputError(f"values that go together must be equally many, but {lengths}.")
    return [dict(zip(lists, values, strict=True)) for values in zip(*lists.values(), strict=True)]


def values_of(text: str, *, separator: str = ",") -> list[str]:
    """The values that a text lists: "1,2,3"; or an even range "lo:hi:n" of n values, both ends among them; or
    "lo:hi:nlog", of which the logarithms are even.

    Raises InputError for an empty value and a range that is none.
    """
    values: list[str] = []
    for part in (part.strip() for part in text.split(separator)):
        if not part:
            raise InputError(f"{text!r} has an empty value; write values with {separator!r} between them.")
        match = _RANGE.fullmatch(part)
        values += _spread(match, part) if match else [part]
    return values


def _spread(match: re.Match[str], part: str) -> list[str]:
    try:
        low, high, count = float(match[1]), float(match[2]), int(match[3])
    except ValueError:
        raise InputError(f"{part!r} is no range; write lo:hi:n, as in 0.5:0.9:5, or lo:hi:nlog.") from None
    if not (abs(low) < float("inf") and abs(high) < float("inf") and count >= 2):
        raise InputError(f"range {part!r} is not possible; it needs two finite ends and at least 2 values.")
    if count > MOST_ROWS:
        raise InputError(f"range {part!r} is not possible; it may have at most {MOST_ROWS:,} values.")
    if match[4] and not (low > 0 and high > 0):
        raise InputError(f"range {part!r} is not possible; both ends of a range in the logarithm must be above 0.")
    shares = [i / (count - 1) for i in range(count)]
    values = [low ** (1 - s) * high**s if match[4] else (1 - s) * low + s * high for s in shares]
    return [_written(value) for value in sorted(values, reverse=low > high)]  # in order to the last digit


def _written(value: float) -> str:
    value = float(f"{value:.12g}")  # 0.3, not 0.30000000000000004
    return str(int(value)) if value.is_integer() and abs(value) < 1e15 else repr(value)
