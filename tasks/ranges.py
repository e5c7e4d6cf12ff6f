"""Ranges of parameters, declared in their types: `tau_label: Fraction = 0.7`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated


@dataclass(frozen=True)
class Range:
    """An interval; `open_below` and `open_above` leave out its ends."""

    low: float
    high: float
    open_below: bool = False
    open_above: bool = False

    def __contains__(self, value: float) -> bool:
        above = value > self.low if self.open_below else value >= self.low
        return above and (value < self.high if self.open_above else value <= self.high)

    def __str__(self) -> str:
        if self.high == float("inf"):
            return f"{'greater than' if self.open_below else 'at least'} {self.low:g}"
        if self.open_below or self.open_above:
            below = "less than" if self.open_above else "at most"
            return f"{'greater than' if self.open_below else 'at least'} {self.low:g} and {below} {self.high:g}"
        return f"between {self.low:g} and {self.high:g}"


Fraction = Annotated[float, Range(0.0, 1.0)]
Positive = Annotated[float, Range(0.0, float("inf"), open_below=True)]
NonNegative = Annotated[float, Range(0.0, float("inf"))]
Angle = Annotated[float, Range(0.0, 180.0, open_below=True)]
"""Degrees."""
Count = Annotated[int, Range(1, float("inf"))]
"""A whole number of at least one."""
Natural = Annotated[int, Range(0, float("inf"))]
"""A whole number, or none."""
JpegQuality = Annotated[int, Range(0, 100)]
QuarterTurns = Annotated[int, Range(0, 3)]
HarmonicsDegree = Annotated[int, Range(0, 3)]
"""Degree of the spherical harmonics of a colour."""
