"""What was read lately, kept in memory."""

from __future__ import annotations

import dataclasses
import threading
from collections import OrderedDict
from typing import Any

import numpy as np


class Recent:
    """Values by their digests, up to about so many bytes; what was asked for longest ago goes first.

    A value of more than a quarter of `most_bytes` is not kept, as it would drive out all others. For several threads.
    """

    def __init__(self, most_bytes: int) -> None:
        self.bytes = 0
        """What the values take."""
        self._most_bytes = most_bytes
        self._values: OrderedDict[str, tuple[Any, int]] = OrderedDict()
        """Each with what it takes."""
        self._lock = threading.Lock()

    def get(self, digest: str) -> Any | None:
        """The value, or None."""
        with self._lock:
            if digest not in self._values:
                return None
            self._values.move_to_end(digest)
            return self._values[digest][0]

    def keep(self, digest: str, value: Any) -> None:
        """Keep a value: a dataclass of arrays."""
        size = _bytes(value)
        with self._lock:
            if size > self._most_bytes // 4 or digest in self._values:
                return
            self._values[digest] = value, size
            self.bytes += size
            while self.bytes > self._most_bytes:
                self.bytes -= self._values.popitem(last=False)[1][1]

    def drop(self, digest: str) -> None:
        """Keep it no longer."""
        with self._lock:
            if digest in self._values:
                self.bytes -= self._values.pop(digest)[1]


def _bytes(value: Any) -> int:
    """About what a value takes: its arrays, and its plain data as text, of which a list takes a small multiple."""
    fields = (getattr(value, field.name) for field in dataclasses.fields(value))
    return 256 + sum(field.nbytes if isinstance(field, np.ndarray) else len(repr(field)) for field in fields)
