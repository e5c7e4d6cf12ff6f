"""JSON documents of the store and of runs, by msgspec: a third of the standard library's time, at every hit."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any, TypeVar

import msgspec

T = TypeVar("T")

_write = msgspec.json.Encoder().encode


def reader(kind: type[T]) -> Callable[[bytes], T]:
    """What reads documents that hold a `kind`, say a dataclass of plain data. It raises ValueError for others."""
    decode = msgspec.json.Decoder(kind).decode

    def read(content: bytes) -> T:
        try:
            return decode(content)
        except msgspec.DecodeError:  # the standard library also reads what it writes itself: NaN and Infinity
            return msgspec.convert(json.loads(content), kind)

    return read


def as_json(value: Any) -> bytes:
    """A document of one line, spaced as the standard library does. Numbers must be finite."""
    try:
        return msgspec.json.format(_write(value), indent=0)
    except UnicodeEncodeError:  # the name of a file may hold bytes that are no text
        return json.dumps(value).encode()
