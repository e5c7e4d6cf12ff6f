"""Sizes and durations as people write them: "8GB", "1.5 GiB", "30d", "90 min"."""

from __future__ import annotations

import math
import re

_BYTES = {"": 1, "b": 1} | {
    f"{letter}{rest}": base**power
    for power, letter in enumerate("kmgtp", start=1)
    for rest, base in (("", 1000), ("b", 1000), ("ib", 1024))
}
_SECONDS = {
    unit: seconds
    for seconds, units in (
        (1, ("", "s", "sec", "second", "seconds")),
        (60, ("m", "min", "minute", "minutes")),
        (3600, ("h", "hour", "hours")),
        (86400, ("d", "day", "days")),
        (604800, ("w", "week", "weeks")),
    )
    for unit in units
}
_NUMBER_AND_UNIT = re.compile(r"\s*(\d+\.?\d*|\.\d+)\s*([a-z]*)\s*", re.IGNORECASE | re.ASCII)


def parse_bytes(text: str) -> int:
    """A size in bytes: "500", "8GB" (powers of 1000), "1.5 GiB" (powers of 1024); K, M, G, T or P, in any case.

    Raises ValueError, with a sentence for the user, for anything else.
    """
    size = _parsed(text, _BYTES)
    if size is None:
        raise ValueError(f"{text!r} is not a size; write a number and a unit, such as 500MB, 8GB or 1.5TiB.")
    return round(size)


def parse_seconds(text: str) -> float:
    """A duration in seconds: "45", "90s", "10 min", "12h", "30d", "2 weeks".

    Raises ValueError, with a sentence for the user, for anything else.
    """
    seconds = _parsed(text, _SECONDS)
    if seconds is None:
        raise ValueError(f"{text!r} is not a duration; write a number and a unit, such as 90s, 10min, 12h, 30d or 2w.")
    return seconds


def _parsed(text: str, units: dict[str, int]) -> float | None:
    match = _NUMBER_AND_UNIT.fullmatch(text)
    if match is None or match[2].lower() not in units:
        return None
    value = float(match[1]) * units[match[2].lower()]
    return value if math.isfinite(value) else None
