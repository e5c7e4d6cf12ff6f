"""What was read lately, kept in memory."""

from __future__ import annotations

import dataclasses
import threading
from collections import OrderedDict
from typing import Any

import numpy as np


class Recent:
    """Values by their digests, up to so many bytes of arrays; what was asked for longest ago goes first.

    A value of more than a quarter of `most_bytes` is not kept, as it would drive out all others. For several threads.
    """

    def __init__(self, most_bytes: int) -> None:
        self.bytes = 0
        """What the values take."""
        self._most_bytes = most_bytes
        self._values: OrderedDict[str, Any] = OrderedDict()
        self._lock = threading.Lock()

    def get(self, digest: str) -> Any | None:
        """The value, or None."""
        with self._lock:
            if digest not in self._values:
                return None
            self._values.move_to_end(digest)
            return self._values[digest]

    def keep(self, digest: str, value: Any) -> None:
        """Keep a value: a dataclass of arrays."""
        size = _array_bytes(value)
        with self._lock:
            if size > self._most_bytes // 4 or digest in self._values:
                return
            self._values[digest] = value
            self.bytes += size
            while self.bytes > self._most_bytes:
                self.bytes -= _array_bytes(self._values.popitem(last=False)[1])

    def drop(self, digest: str) -> None:
        """Keep it no longer."""
        with self._lock:
            if digest in self._values:
                self.bytes -= _array_bytes(self._values.pop(digest))


def _array_bytes(value: Any) -> int:
    fields = (getattr(value, field.name) for field in dataclasses.fields(value))
    return 256 + sum(field.nbytes for field in fields if isinstance(field, np.ndarray))
