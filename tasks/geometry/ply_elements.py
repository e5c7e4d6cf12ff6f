"""PLY files as scanners and annotators write them: any elements, scalars and lists, text or binary."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from ss_flow.errors import InputError

Columns = dict[str, NDArray[np.generic]]
"""Of one element, by property: [N], and [N, k] for lists of k items."""

SCALARS = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"},
    **{"float": "f4", "double": "f8", "float32": "f4", "float64": "f8"},
}
"""NumPy's name of each scalar type of the format, without a byte order."""

_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": ""}


@dataclass(frozen=True)
class _Property:
    name: str
    kind: str
    count: str | None
    """Type of a list's length; None for a scalar."""


def read_elements(path: Path) -> dict[str, Columns]:
    """The elements of a PLY file by name. The lists of one property must be equally long (all faces triangles, or all
    quads).

    Raises InputError when the file is no PLY, ends too early, or holds lists of different lengths.
    """
    try:
        with path.open("rb") as stream:
            order, elements = _header(stream, path)
            read = _ascii if not order else _binary
            return {name: read(stream, count, properties, order) for name, count, properties in elements}
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}.") from None
    except ValueError as error:
        raise InputError(f"{path} is damaged, or holds lists of different lengths ({error}).") from None


def _header(stream: BinaryIO, path: Path) -> tuple[str, list[tuple[str, int, list[_Property]]]]:
    """The byte order ("" for text), and name, count and properties of each element."""
    if stream.readline().strip() != b"ply":
        raise InputError(f"{path} is not a PLY file; it should start with `ply`.")
    order: str | None = None
    elements: list[tuple[str, int, list[_Property]]] = []
    for line in stream:
        match line.decode("ascii", errors="replace").split():
            case ["end_header"]:
                break
            case ["format", kind, _] if kind in _ORDERS:
                order = _ORDERS[kind]
            case ["element", name, count] if count.isdigit():
                elements.append((name, int(count), []))
            case ["property", "list", count, kind, name] if count in SCALARS and kind in SCALARS and elements:
                elements[-1][2].append(_Property(name, SCALARS[kind], SCALARS[count]))
            case ["property", kind, name] if kind in SCALARS and elements:
                elements[-1][2].append(_Property(name, SCALARS[kind], None))
            case [] | ["comment", *_] | ["obj_info", *_]:
                pass
            case words:
                raise InputError(f"{path} has `{' '.join(words)[:60]}` in its header, which PLY does not know.")
    if order is None:
        raise InputError(f"{path} does not say in its header whether it is text or binary.")
    return order, elements


def _binary(stream: BinaryIO, count: int, properties: list[_Property], order: str) -> Columns:
    """All lists are taken to be as long as those of the first row, and checked."""
    start = stream.tell()
    fields: list[tuple[str, str, tuple[int, ...]]] = []
    for one in properties:
        length: tuple[int, ...] = ()
        if one.count is not None:
            fields.append((f"{one.name}:count", order + one.count, ()))
            length = (int(_rows(stream, start, fields, min(count, 1))[fields[-1][0]][0]) if count else 0,)
        fields.append((one.name, order + one.kind, length))
    rows = _rows(stream, start, fields, count)
    for one in properties:
        if one.count is not None and count:
            _check_equal(rows[f"{one.name}:count"])
    return {one.name: rows[one.name].astype(one.kind) for one in properties}


def _rows(stream: BinaryIO, start: int, fields: list[tuple[str, str, tuple[int, ...]]], count: int) -> NDArray[np.void]:
    dtype = np.dtype(fields)
    stream.seek(start)
    data = stream.read(dtype.itemsize * count)
    if len(data) < dtype.itemsize * count:
        raise ValueError("it ends too early")
    return np.frombuffer(data, dtype, count)


def _ascii(stream: BinaryIO, count: int, properties: list[_Property], order: str) -> Columns:
    rows = [stream.readline().split() for _ in range(count)]
    if len({len(row) for row in rows}) > 1:
        raise ValueError("rows of different lengths")
    table = np.array(rows, np.float64).reshape(count, len(rows[0]) if rows else 0)
    columns: Columns = {}
    place = 0
    for one in properties:
        length = 1
        if one.count is not None and count:
            _check_equal(table[:, place])
            length, place = int(table[0, place]), place + 1
        if count and place + length > table.shape[1]:
            raise ValueError("rows that are too short")
        part = table[:, place : place + length].astype(one.kind)
        columns[one.name] = part if one.count is not None else part.reshape(count)
        place += length
    return columns


def _check_equal(lengths: NDArray[np.generic]) -> None:
    if (lengths != lengths[0]).any():
        raise ValueError("lists of different lengths")
