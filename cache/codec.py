"""Dataclasses of arrays as Zarr v3 groups, and back.

Arrays become Zarr arrays (blosc-lz4 with shuffle, chunks of about 4 MiB along the first axis; small ones are one plain
chunk); every other field goes, with the type's name, into the group's attributes as JSON. Nothing is ever unpickled:
reading an object can build only dataclasses of this package's own modules.
"""

from __future__ import annotations

import dataclasses
import importlib
import json
import math
import typing
from pathlib import Path
from typing import Any

import numpy as np

CHUNK_BYTES = 4 << 20
PLAIN_BYTES = 64 << 10
"""Smaller arrays are not compressed, so that plans and figures can be read back without loading Zarr."""
TRUSTED_PREFIXES = ("ss_flow.", "ss_flow_")
FORMAT = 1


def write(value: Any, folder: Path) -> None:
    """Write a dataclass instance as a Zarr group at `folder`, which must not exist.

    Raises TypeError for a value that is not a dataclass, or a field that neither Zarr nor JSON can hold.
    """
    import zarr
    from zarr.codecs import BloscCodec

    if not dataclasses.is_dataclass(value) or isinstance(value, type):
        raise TypeError(f"a task returned {type(value).__name__}; only dataclasses of arrays are stored")
    kind = type(value)
    attributes: dict[str, Any] = {}
    arrays: dict[str, np.ndarray] = {}
    for item in dataclasses.fields(value):
        content = getattr(value, item.name)
        if isinstance(content, np.ndarray):
            arrays[item.name] = content
        else:
            attributes[item.name] = _plain(content, f"{kind.__name__}.{item.name}")
    header = {"format": FORMAT, "type": f"{kind.__module__}:{kind.__qualname__}", "values": attributes}
    group = zarr.create_group(store=folder, zarr_format=3, attributes=header)
    compressor = BloscCodec(cname="lz4", clevel=5, shuffle="shuffle")
    for name, array in arrays.items():
        stored = group.create_array(
            name,
            shape=array.shape,
            dtype=array.dtype,
            chunks=_chunks(array),
            compressors=None if array.nbytes <= PLAIN_BYTES and array.dtype.kind in "biuf" else compressor,
            fill_value=0,
        )
        if array.size:
            stored[...] = array


def read(folder: Path) -> Any:
    """Read what `write` wrote. Arrays come back read-only, since the store shares them between tasks.

    Raises ValueError when the type is not one of this package's dataclasses, or was written by another format.
    """
    try:
        header: dict[str, Any] = json.loads((folder / "zarr.json").read_bytes())["attributes"]
    except (OSError, ValueError, KeyError) as error:
        raise ValueError(f"{folder}: not a stored object ({error})") from None
    if header.get("format") != FORMAT:
        raise ValueError(f"{folder}: object format {header.get('format')}, this version reads format {FORMAT}")
    kind = type_named(header["type"])
    hints = typing.get_type_hints(kind)
    values = {name: _restored(content, hints[name]) for name, content in header["values"].items()}
    for array in sorted(path.parent for path in folder.glob("*/zarr.json")):
        content = _read_plain(array)
        content = _read_zarr(array) if content is None else content
        content.flags.writeable = False
        values[array.name] = content
    return kind(**values)


def _read_zarr(folder: Path) -> np.ndarray:
    import zarr

    stored = zarr.open_array(store=folder, mode="r", zarr_format=3)
    return np.asarray(stored[...])


def _read_plain(folder: Path) -> np.ndarray | None:
    """An array whose one chunk is not compressed; None for any other. Zarr leaves out a chunk that is all zeros."""
    header = json.loads((folder / "zarr.json").read_bytes())
    shape = tuple(header["shape"])
    chunk = tuple(header["chunk_grid"]["configuration"]["chunk_shape"])
    codecs = [(codec["name"], codec.get("configuration", {}).get("endian", "little")) for codec in header["codecs"]]
    if codecs != [("bytes", "little")] or (chunk != shape and 0 not in shape):
        return None
    dtype = np.dtype(header["data_type"]).newbyteorder("<")
    path = folder.joinpath("c", *("0" for _ in shape))
    if 0 in shape or not path.exists():
        return np.zeros(shape, dtype)
    content = np.frombuffer(path.read_bytes(), dtype)
    if content.size != math.prod(shape):
        raise ValueError(f"{folder}: damaged; {content.size} values where there should be {math.prod(shape)}")
    return content.reshape(shape)


def type_named(name: str) -> type:
    """The dataclass that a stored object names as "module:class"."""
    module, _, qualified = name.partition(":")
    if not module.startswith(TRUSTED_PREFIXES):
        raise ValueError(f"refused to build an object of the foreign type {name}")
    found: Any = importlib.import_module(module)
    for part in qualified.split("."):
        found = getattr(found, part)
    if not dataclasses.is_dataclass(found):
        raise ValueError(f"{name} is not a dataclass")
    return typing.cast(type, found)


def _chunks(array: np.ndarray) -> tuple[int, ...]:
    row_bytes = max(1, array.nbytes // max(1, len(array))) if array.ndim else 1
    rows = max(1, CHUNK_BYTES // row_bytes)
    return (min(max(1, len(array)), rows), *(max(1, n) for n in array.shape[1:])) if array.ndim else ()


def _plain(content: Any, where: str) -> Any:
    """A field as JSON; a NumPy scalar or a nested tuple becomes its plain twin."""
    if isinstance(content, np.generic):
        content = content.item()
    if content is None or isinstance(content, bool | int | float | str):
        return content
    if isinstance(content, tuple | list):
        return [_plain(item, where) for item in content]
    if isinstance(content, dict) and all(isinstance(name, str) for name in content):
        return {name: _plain(item, where) for name, item in content.items()}
    raise TypeError(f"{where} holds a {type(content).__name__}, which is neither an array nor plain data")


def _restored(content: Any, hint: Any) -> Any:
    if typing.get_origin(hint) is tuple and isinstance(content, list):
        inner = typing.get_args(hint)[:1] or (Any,)
        return tuple(_restored(item, inner[0]) for item in content)
    return float(content) if hint is float else content
