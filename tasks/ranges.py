"""Ranges of parameters, declared in their types: `tau_label: Fraction = 0.7`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated


@dataclass(frozen=True)
class Range:
    """A closed interval; `open_below` leaves out its lower end."""

    low: float
    high: float
    open_below: bool = False

    def __contains__(self, value: float) -> bool:
        return self.low <= value <= self.high and not (self.open_below and value == self.low)

    def __str__(self) -> str:
        if self.high == float("inf"):
            return f"{'greater than' if self.open_below else 'at least'} {self.low:g}"
        return f"between {self.low:g} and {self.high:g}"


Fraction = Annotated[float, Range(0.0, 1.0)]
Positive = Annotated[float, Range(0.0, float("inf"), open_below=True)]
NonNegative = Annotated[float, Range(0.0, float("inf"))]
Count = Annotated[int, Range(1, float("inf"))]
"""A whole number of at least one."""
Natural = Annotated[int, Range(0, float("inf"))]
"""A whole number, or none."""
