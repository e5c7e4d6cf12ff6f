"""JSON documents of the store and of runs; by msgspec, which takes a third of the time, those of every hit."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable
from typing import Any, TypeVar

import msgspec

T = TypeVar("T")

_write = msgspec.json.Encoder().encode


def read_json(content: str | bytes, *, once: bool = False) -> Any:
    """What a document holds.

    once: of an object that names something twice, of which only the last would count, nothing is read.
    Raises ValueError for what is none, or is nested so deeply that it is nobody's.
    """
    try:
        return json.loads(content, object_pairs_hook=_named_once if once else None)
    except RecursionError:
        raise ValueError("it is nested too deeply") from None


def _named_once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) < len(pairs):
        twice = Counter(name for name, _ in pairs).most_common(1)[0][0]
        raise ValueError(f"{twice!r} stands twice in one object")
    return found


def reader(kind: type[T]) -> Callable[[bytes], T]:
    """What reads documents that hold a `kind`, say a dataclass of plain data. It raises ValueError for others."""
    decode = msgspec.json.Decoder(kind).decode

    def read(content: bytes) -> T:
        try:
            return decode(content)
        except (msgspec.DecodeError, RecursionError):  # the standard library also reads its own NaN and Infinity
            return msgspec.convert(read_json(content), kind)

    return read


def as_json(value: Any) -> bytes:
    """A document of one line, spaced as the standard library does. Numbers must be finite."""
    try:
        return msgspec.json.format(_write(value), indent=0)
    except UnicodeEncodeError:  # the name of a file may hold bytes that are no text
        return json.dumps(value).encode()
