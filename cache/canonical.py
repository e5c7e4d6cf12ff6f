"""Digests of values by content: one canonical encoding, hashed with blake3.

Every value is encoded as a type tag, a length and its content, so that no two values share an encoding. Arrays count by
dtype, shape and C-order bytes; byte order and NaN are made canonical. A type that is not known here is refused rather
than encoded by accident.
"""

from __future__ import annotations

import dataclasses
import re
import struct
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from blake3 import blake3

CHUNK_BYTES = 1 << 20
DIGEST = re.compile(r"[0-9a-f]{64}")
"""What a digest looks like."""
_LENGTH = struct.Struct("<Q").pack
_FLOAT = struct.Struct("<d").pack


def digests_of(value: str | Iterable[str]) -> list[str]:
    """The digests of a list, or of one artifact, which stands for itself."""
    return [value] if isinstance(value, str) else list(value)


def digest(value: Any) -> str:
    """The hexadecimal blake3 digest of a value.

    value: None, bool, int, float, str, bytes, a NumPy array (neither masked nor of records) or scalar, a list or tuple,
    a mapping with string keys, or a dataclass of these. Fields declared with `field(metadata={"key": False})` do not
    count.

    Raises TypeError for any other type, naming it.
    """
    encoder = _Encoder()
    encoder.add(value)
    return encoder.hexdigest()


def digest_of_fields(kind: str, fields: Mapping[str, Any]) -> str:
    """The digest of a dataclass instance by its type's name ("module.Class") and its fields, as `digest` gives it."""
    encoder = _Encoder()
    encoder.add_fields(kind, fields)
    return encoder.hexdigest()


def digest_file(path: Path | str) -> str:
    """The hexadecimal blake3 digest of a file's content."""
    hasher = blake3()
    with open(path, "rb") as stream:
        while block := stream.read(CHUNK_BYTES):
            hasher.update(block)
    return hasher.hexdigest()


class _Encoder:
    """Encodes values one after the other; small ones are gathered before they are hashed."""

    def __init__(self) -> None:
        self._hasher: blake3 | None = None
        self._pending = bytearray()

    def hexdigest(self) -> str:
        if self._hasher is None:
            return str(blake3(self._pending).hexdigest())
        self._hasher.update(self._pending)
        return str(self._hasher.hexdigest())

    def add(self, value: Any) -> None:
        known = _ENCODERS.get(type(value))
        if known is not None:
            known(self, value)
        elif isinstance(value, np.generic):
            self.add(value.item())
        elif isinstance(value, Mapping):
            self._add_mapping(value)
        elif dataclasses.is_dataclass(value) and not isinstance(value, type):
            counted = {f.name: getattr(value, f.name) for f in dataclasses.fields(value) if f.metadata.get("key", True)}
            self.add_fields(f"{type(value).__module__}.{type(value).__qualname__}", counted)
        else:
            for kind, encode in _ENCODERS.items():  # a subclass, such as a named tuple, counts as what it is
                if isinstance(value, kind):
                    encode(self, value)
                    return
            raise TypeError(f"cannot digest a value of type {type(value).__module__}.{type(value).__qualname__}")

    def add_fields(self, kind: str, fields: Mapping[str, Any]) -> None:
        self._tagged(b"d", kind.encode())
        self._add_mapping(fields)

    def _tagged(self, tag: bytes, content: bytes) -> None:
        self._pending += tag
        self._pending += _LENGTH(len(content))
        self._pending += content

    def _add_items(self, value: list[Any] | tuple[Any, ...]) -> None:
        pending = self._pending  # the same one after `self.add`, which clears it at most
        pending += b"l" + _LENGTH(len(value))
        for item in value:  # most are digests and names, or pairs with them
            kind = type(item)
            if kind is str:
                content = item.encode() if item.isascii() else _bytes(item)
                pending += b"s" + _LENGTH(len(content)) + content
            elif kind is tuple or kind is list:
                self._add_items(item)
            else:
                self.add(item)

    def _add_mapping(self, value: Mapping[str, Any]) -> None:
        self._pending += b"m" + _LENGTH(len(value))
        for name in value:
            if not isinstance(name, str):
                raise TypeError(f"cannot digest a mapping with a key of type {type(name).__name__}")
        for name in sorted(value):
            self._tagged(b"k", _bytes(name))
            self.add(value[name])

    def _add_array(self, array: np.ndarray) -> None:
        if isinstance(array, np.ma.MaskedArray):  # its mask would not count
            raise TypeError("cannot digest a masked array")
        if array.dtype.hasobject or array.dtype.kind == "V":  # the names of a record's fields would not count
            raise TypeError(f"cannot digest an array of {'Python objects' if array.dtype.hasobject else 'records'}")
        array = np.asarray(array, dtype=array.dtype.newbyteorder("<"), order="C")
        self._tagged(b"a", array.dtype.str.encode())
        self._add_items(array.shape)
        self._hasher = self._hasher or blake3()
        self._hasher.update(self._pending)
        self._pending.clear()
        flat = array.reshape(-1)
        if array.dtype.kind == "c":  # a part that is NaN hides nothing of the other
            flat = flat.view(array.real.dtype)
        rows = max(1, CHUNK_BYTES // flat.dtype.itemsize) if flat.dtype.itemsize else 1
        for start in range(0, flat.size, rows):  # in blocks that stay in the processor's cache
            block = flat[start : start + rows]
            if flat.dtype.kind == "f" and np.isnan(block).any():
                block = np.where(np.isnan(block), np.array(np.nan, flat.dtype), block)
            self._hasher.update(block.view(np.uint8).data)


def _bytes(text: str) -> bytes:
    return text.encode(errors="surrogatepass")  # the name of a file may hold bytes that are no text


_ENCODERS: dict[type, Callable[[_Encoder, Any], None]] = {
    str: lambda encoder, value: encoder._tagged(b"s", _bytes(value)),
    bool: lambda encoder, value: encoder._tagged(b"b", b"\x01" if value else b"\x00"),
    int: lambda encoder, value: encoder._tagged(b"i", int.__repr__(value).encode()),
    float: lambda encoder, value: encoder._tagged(b"f", _FLOAT(float("nan") if value != value else value)),
    type(None): lambda encoder, value: encoder._tagged(b"0", b""),
    bytes: lambda encoder, value: encoder._tagged(b"y", value),
    list: _Encoder._add_items,
    tuple: _Encoder._add_items,
    dict: _Encoder._add_mapping,
    np.ndarray: _Encoder._add_array,
}
