"""Digests of values by content: one canonical encoding, hashed with blake3.

Every value is encoded as a type tag, a length and its content, so that no two values share an encoding. Arrays count by
dtype, shape and C-order bytes; byte order and NaN are made canonical. A type that is not known here is refused rather
than encoded by accident.
"""

from __future__ import annotations

import dataclasses
import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from blake3 import blake3

CHUNK_BYTES = 1 << 20


def digest(value: Any) -> str:
    """The hexadecimal blake3 digest of a value.

    value: None, bool, int, float, str, bytes, a NumPy array or scalar, a list or tuple, a mapping with string keys, or
    a dataclass of these. Fields declared with `field(metadata={"key": False})` do not count.

    Raises TypeError for any other type, naming it.
    """
    hasher = blake3()
    _feed(hasher, value)
    return hasher.hexdigest()


def digest_file(path: Path) -> str:
    """The hexadecimal blake3 digest of a file's content."""
    hasher = blake3()
    with path.open("rb") as stream:
        while block := stream.read(CHUNK_BYTES):
            hasher.update(block)
    return hasher.hexdigest()


def _tagged(hasher: Any, tag: bytes, content: bytes) -> None:
    hasher.update(tag + struct.pack("<Q", len(content)))
    hasher.update(content)


def _feed(hasher: Any, value: Any) -> None:
    if isinstance(value, np.generic):
        value = value.item()
    match value:
        case None:
            _tagged(hasher, b"0", b"")
        case bool():
            _tagged(hasher, b"b", b"\x01" if value else b"\x00")
        case int():
            _tagged(hasher, b"i", str(value).encode())
        case float():
            _tagged(hasher, b"f", struct.pack("<d", float("nan") if value != value else value))
        case str():
            _tagged(hasher, b"s", value.encode())
        case bytes():
            _tagged(hasher, b"y", value)
        case np.ndarray():
            _feed_array(hasher, value)
        case list() | tuple():
            hasher.update(b"l" + struct.pack("<Q", len(value)))
            for item in value:
                _feed(hasher, item)
        case Mapping():
            hasher.update(b"m" + struct.pack("<Q", len(value)))
            for name in sorted(value):
                if not isinstance(name, str):
                    raise TypeError(f"cannot digest a mapping with a key of type {type(name).__name__}")
                _tagged(hasher, b"k", name.encode())
                _feed(hasher, value[name])
        case _ if dataclasses.is_dataclass(value) and not isinstance(value, type):
            counted = [f.name for f in dataclasses.fields(value) if f.metadata.get("key", True)]
            _tagged(hasher, b"d", f"{type(value).__module__}.{type(value).__qualname__}".encode())
            _feed(hasher, {name: getattr(value, name) for name in counted})
        case _:
            raise TypeError(f"cannot digest a value of type {type(value).__module__}.{type(value).__qualname__}")


def _feed_array(hasher: Any, array: np.ndarray) -> None:
    if array.dtype.hasobject:
        raise TypeError("cannot digest an array of Python objects")
    array = np.ascontiguousarray(array, dtype=array.dtype.newbyteorder("<"))
    if array.dtype.kind in "fc" and np.isnan(array).any():
        array = np.where(np.isnan(array), np.array(np.nan, array.dtype), array)
    _tagged(hasher, b"a", array.dtype.str.encode())
    _feed(hasher, list(array.shape))
    hasher.update(array.reshape(-1).view(np.uint8).data if array.size else b"")
