"""What the fields of an edit script's operations may hold, each with the sentence that says what would be right."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

from ss_flow.tasks.edit.operations import Vector

T = TypeVar("T")
_LARGEST = 1e9
"""More than any scene needs; Gaussians are 32-bit floats, which end at 3e38."""


class Unfit(ValueError):
    """A value is not right; the message says why, or what would be."""


@dataclass(frozen=True)
class Field(Generic[T]):
    """What a field may hold."""

    wanted: str
    """What would be right."""
    read: Callable[[Any], T]
    """The value that a script gives; raises Unfit."""


def _field(wanted: str, read: Callable[[Any], T]) -> Field[T]:
    """read: may raise TypeError, KeyError, ValueError or OverflowError where a value is not right."""

    def checked(value: Any) -> T:
        try:
            return read(value)
        except (TypeError, KeyError, ValueError, OverflowError):
            raise Unfit(wanted) from None

    return Field(wanted, checked)


def _only_if(fits: bool) -> None:
    if not fits:
        raise ValueError


def _text(value: Any) -> str:
    _only_if(isinstance(value, str) and bool(value.strip()))
    return str(value)


def _flag(value: Any) -> bool:
    _only_if(isinstance(value, bool))
    return bool(value)


def _number(value: Any) -> float:
    _only_if(isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= _LARGEST)
    return float(value)


def _positive(value: Any) -> float:
    _only_if(_number(value) > 0)
    return float(value)


def _vector(value: Any) -> Vector:
    x, y, z = (_number(item) for item in value)
    return x, y, z


def _turn(value: Any) -> tuple[Vector, float]:
    axis, degrees = _vector(value["axis"]), _number(value["degrees"])
    _only_if(len(value) == 2 and any(axis))
    return axis, degrees


def _color(value: Any) -> tuple[int, int, int]:
    if isinstance(value, str) and len(value) == 7 and value[0] == "#":
        value = list(bytes.fromhex(value[1:]))
    r, g, b = value
    _only_if(all(isinstance(c, int) and not isinstance(c, bool) and 0 <= c <= 255 for c in (r, g, b)))
    return r, g, b


def _kind(value: Any) -> str:
    _only_if(value in ("thing", "stuff"))
    return str(value)


def _id_or_name(value: Any) -> int | str:
    if isinstance(value, int | str) and not isinstance(value, bool):
        return value
    raise ValueError


TEXT = _field("it must be a text that is not empty", _text)
FLAG = _field("it must be true or false", _flag)
POSITIVE = _field("it must be a number above 0", _positive)
VECTOR = _field("it must be three numbers in world units, as in [0, 0, 0.5]", _vector)
PIVOT = _field(
    'it must be "centre", or three numbers in world units', lambda value: None if value == "centre" else _vector(value)
)
TURN = _field('it must be such as {"axis": [0, 0, 1], "degrees": 90}, with an axis that is not 0', _turn)
COLOR = _field('it must be "#rrggbb", or red, green and blue as whole numbers of 0 to 255', _color)
SCALE_OR_FIT = _field(
    'it must be "fit" (the size of what is replaced), or a number above 0',
    lambda value: None if value == "fit" else _positive(value),
)
KIND = _field('it must be "thing" or "stuff"', _kind)
ID_OR_NAME = _field("it must be the id or the name of an object of that run", _id_or_name)
