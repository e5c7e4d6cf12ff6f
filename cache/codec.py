"""Dataclasses of arrays as Zarr v3 groups, and back.

Arrays become Zarr arrays (blosc-lz4 with shuffle, chunks of about 4 MiB along the first axis; small ones are one plain
chunk); every other field goes, with the type's name, into the group's attributes as JSON. Nothing is ever unpickled:
reading an object can build only dataclasses of this package's own modules, and takes no more memory than what is
stored can hold.
"""

from __future__ import annotations

import contextlib
import dataclasses
import enum
import importlib
import itertools
import json
import math
import os
import stat
import sys
import types
import typing
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

from ss_flow.cache.canonical import digest, digest_of_fields

CHUNK_BYTES = 4 << 20
PLAIN_BYTES = 64 << 10
"""Smaller arrays are not compressed, and are written and read without loading Zarr."""
MOST_COMPRESSION = 256
"""More than lz4 can gain: an array that claims to hold more than so many times its files is refused."""
TRUSTED_PREFIXES = ("ss_flow.", "ss_flow_")
FORMAT = 2
READERS = 2
"""Threads that unpack one array; more wait for memory."""
MOST_HEADER_BYTES = 64 << 20
DTYPES = frozenset(
    ["bool", "complex64", "complex128", *(f"float{n}" for n in (16, 32, 64))]
    + [f"{sign}int{n}" for sign in ("", "u") for n in (8, 16, 32, 64)]
)
"""What arrays may hold."""


class OtherFields(ValueError):
    """What is stored is of a type that has other fields now, or is not to be found here; says which."""


NOT_THERE = (FileNotFoundError, NotADirectoryError, IsADirectoryError)
"""Of what goes wrong when a file is read, that which the object itself is to blame for."""
UNFIT = (*NOT_THERE, KeyError, TypeError, AttributeError, RecursionError, OverflowError)
"""What reading raises where the content is not what `write` writes."""


def write(value: Any, folder: Path) -> None:
    """Write a dataclass instance as a Zarr group at `folder`, which must not exist.

    Raises TypeError as `check` does.
    """
    header, arrays = check(value)
    folder.mkdir()
    for name, array in arrays.items():
        if array.nbytes <= PLAIN_BYTES:
            _write_plain(array, folder / name)
        else:
            _write_zarr(array, folder / name)
    (folder / "zarr.json").write_text(header)


def check(value: Any) -> tuple[str, dict[str, np.ndarray]]:
    """What is written of a value: the header of its group, and its arrays by name.

    Raises TypeError for a value that is not a frozen dataclass, for a field that neither Zarr nor JSON can hold, for
    one that could not be given back to the type or as it was, for a type that is not found again or makes something
    else of its fields, and for more plain data than `read` takes.
    """
    if not dataclasses.is_dataclass(value) or isinstance(value, type):
        returned = type(value).__name__
        raise TypeError(f"a task returned {returned}; only dataclasses of arrays are stored, or tuple[X, ...] of such")
    kind = type(value)
    if not kind.__dataclass_params__.frozen:  # type: ignore[attr-defined]
        raise TypeError(f"{kind.__name__} is not frozen; tasks share what is stored: declare @dataclass(frozen=True)")
    attributes: dict[str, Any] = {}
    arrays: dict[str, np.ndarray] = {}
    for item in dataclasses.fields(value):
        if not item.init:
            raise TypeError(f"{kind.__name__}.{item.name} has init=False, so it could not be read back; use a property")
        content = getattr(value, item.name)
        if isinstance(content, np.ndarray):
            if content.dtype.name not in DTYPES:
                raise TypeError(f"{kind.__name__}.{item.name} holds {content.dtype}, which is not stored")
            arrays[item.name] = content
        else:
            attributes[item.name] = _plain(content, f"{kind.__name__}.{item.name}")
    name = f"{kind.__module__}:{kind.__qualname__}"
    header = {"format": FORMAT, "type": name, "values": attributes}
    group = json.dumps({"zarr_format": 3, "node_type": "group", "attributes": header})
    if len(group) > MOST_HEADER_BYTES:
        raise TypeError(
            f"{kind.__name__} holds {len(group)} bytes of plain data, where {MOST_HEADER_BYTES} are the most; make the "
            "large field an array"
        )
    _check_type(value, name)
    return group, arrays


def _check_type(value: Any, name: str) -> None:
    """Raise TypeError for a value that could not be built again, or would be another one."""
    kind = type(value)
    try:
        type_named(name)
        given = {item.name: _read_only(getattr(value, item.name)) for item in dataclasses.fields(value)}
        again = kind(**given)
    except MemoryError:
        raise
    except Exception as error:  # whatever a type raises
        raise TypeError(f"{kind.__name__} could not be built again from its fields: {error}") from None
    if any(getattr(again, one) is not content for one, content in given.items()) and digest(again) != digest(value):
        raise TypeError(f"{kind.__name__} makes something else of its own fields when it is built from them again")


def _read_only(content: Any) -> Any:
    if isinstance(content, np.ndarray):
        content = content.view()
        content.flags.writeable = False
    return content


def _write_plain(array: np.ndarray, folder: Path) -> None:
    """One chunk, not compressed, as Zarr would write it."""
    dtype = array.dtype.newbyteorder("<")
    _write_header(folder, array, [max(1, n) for n in array.shape], ".", [])
    if array.size:
        (folder / _only_chunk(array.shape)).write_bytes(np.ascontiguousarray(array, dtype).tobytes())


def _only_chunk(shape: tuple[int, ...]) -> str:
    return ".".join(["c", *("0" for _ in shape)])


def _write_zarr(array: np.ndarray, folder: Path) -> None:
    """Compressed chunks along the first axis, the same as Zarr writes, without its threads and event loop."""
    from numcodecs import blosc

    dtype, chunk = array.dtype.newbyteorder("<"), _chunks(array)
    packing = {"typesize": dtype.itemsize, "cname": "lz4", "clevel": 5, "shuffle": "shuffle", "blocksize": 0}
    _write_header(folder, array, chunk, "/", [{"name": "blosc", "configuration": packing}])
    for number in range(-(-len(array) // chunk[0])):
        rows = np.ascontiguousarray(array[number * chunk[0] : (number + 1) * chunk[0]], dtype)
        if len(rows) < chunk[0]:  # the last chunk is as large as the others
            rows = np.concatenate([rows, np.zeros((chunk[0] - len(rows), *chunk[1:]), dtype)])
        file = folder.joinpath("c", str(number), *("0" for _ in chunk[1:]))
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(blosc.compress(rows.reshape(-1), b"lz4", 5, blosc.SHUFFLE))


def _write_header(
    folder: Path, array: np.ndarray, chunk: Sequence[int], separator: str, packing: list[dict[str, Any]]
) -> None:
    dtype = array.dtype
    zero: Any = [0.0, 0.0] if dtype.kind == "c" else False if dtype.kind == "b" else 0.0 if dtype.kind == "f" else 0
    endian = {} if dtype.itemsize == 1 else {"configuration": {"endian": "little"}}
    header = {
        "zarr_format": 3,
        "node_type": "array",
        "shape": array.shape,
        "data_type": dtype.name,
        "chunk_grid": {"name": "regular", "configuration": {"chunk_shape": chunk}},
        "chunk_key_encoding": {"name": "default", "configuration": {"separator": separator}},
        "fill_value": zero,
        "codecs": [{"name": "bytes", **endian}, *packing],
        "attributes": {},
        "storage_transformers": [],
    }
    folder.mkdir()
    (folder / "zarr.json").write_text(json.dumps(header))


def read(folder: Path) -> Any:
    """Read what `write` wrote. Arrays come back read-only, since the store shares them between tasks.

    Raises ValueError when it is damaged, of a foreign type, or was written by another format; OtherFields when the type
    is not to be found here or has other fields by now, or a folder of an array is missing; OSError and MemoryError when
    it cannot be read now, and may be whole.
    """
    form, name, content = _header(folder)
    if form != FORMAT:
        raise ValueError(f"{folder}: object format {form}, this version reads format {FORMAT}")
    kind = type_named(name)
    stored, due = _names(folder, content), {item.name for item in dataclasses.fields(kind)}
    if stored != due:
        changes = [f"has no field {one} any more" for one in sorted(stored - due)]
        changes += [f"has the new field {one}" for one in sorted(due - stored)]
        raise OtherFields(f"{kind.__name__} {', '.join(changes)}")
    hints = _hints(kind)
    try:
        values = {item.name: _field(folder, item.name, content, hints) for item in dataclasses.fields(kind)}
        return kind(**values)
    except UNFIT as error:
        raise ValueError(f"{folder}: damaged; {type(error).__name__}: {error}") from None


def digest_as_stored(folder: Path) -> str:
    """The digest of an object by the fields that are stored, whatever fields its type has now.

    Raises ValueError when it is damaged, OSError and MemoryError when it cannot be read now.
    """
    _, name, content = _header(folder)
    try:
        fields = {one: _field(folder, one, content, {}) for one in _names(folder, content)}
        return digest_of_fields(str(name).replace(":", "."), fields)
    except UNFIT as error:
        raise ValueError(f"{folder}: damaged; {type(error).__name__}: {error}") from None


def is_current(folder: Path) -> bool:
    """Whether an object was written in the format that `read` reads."""
    try:
        return bool(_header(folder)[0] == FORMAT)
    except ValueError:
        return False


def _header(folder: Path) -> tuple[Any, Any, Any]:
    """Format, type and plain values. Raises ValueError when they cannot be read."""
    try:
        header: dict[str, Any] = json.loads(_read_file(folder / "zarr.json", MOST_HEADER_BYTES))["attributes"]
        return header.get("format"), header["type"], header["values"]
    except (*UNFIT, ValueError) as error:
        raise ValueError(f"{folder}: not a stored object ({error})") from None


def _names(folder: Path, content: Any) -> set[str]:
    """The fields that are stored."""
    try:
        return {*content, *(entry.name for entry in os.scandir(folder) if entry.is_dir(follow_symlinks=False))}
    except (*NOT_THERE, TypeError) as error:
        raise ValueError(f"{folder}: not a stored object ({error})") from None


def _field(folder: Path, name: str, content: dict[str, Any], hints: dict[str, Any]) -> Any:
    if name in content:
        return _restored(content[name], hints.get(name))
    array = _read_array(folder / name)
    array.flags.writeable = False
    return array


def _read_array(folder: Path) -> np.ndarray:
    header = json.loads(_read_file(folder / "zarr.json", MOST_HEADER_BYTES))
    shape = tuple(int(n) for n in header["shape"])
    chunk = tuple(int(n) for n in header["chunk_grid"]["configuration"]["chunk_shape"])
    codecs = [codec["name"] for codec in header["codecs"]]
    if (
        header["data_type"] not in DTYPES
        or codecs not in (["bytes"], ["bytes", "blosc"])
        or any(not 1 <= c <= max(n, 1) for n, c in zip(shape, chunk, strict=True))
    ):
        raise ValueError(f"{folder}: damaged; no array of ours is {header['data_type']} {shape} in {chunk} {codecs}")
    dtype = np.dtype(header["data_type"])
    declared = math.prod(shape) * dtype.itemsize
    if codecs != ["bytes"]:
        stored = sum(f.stat().st_size for f in (folder / "c").rglob("*") if f.is_file())
        if declared > MOST_COMPRESSION * stored:
            raise ValueError(f"{folder}: damaged; {declared} bytes are declared, but {stored} stored")
        return _read_chunks(folder, shape, chunk, dtype)
    if not declared:
        return np.zeros(shape, dtype)
    content = _read_file(folder / _only_chunk(shape), declared)
    if len(content) != declared:
        raise ValueError(f"{folder}: damaged; {len(content)} bytes where there should be {declared}")
    return np.frombuffer(content, dtype.newbyteorder("<")).reshape(shape)


def _read_chunks(folder: Path, shape: tuple[int, ...], chunk: tuple[int, ...], dtype: np.dtype) -> np.ndarray:
    """Chunks that lie one after the other along the first axis, in a third of the time that Zarr takes."""
    from numcodecs import blosc

    if chunk[1:] != shape[1:]:
        raise ValueError(f"{folder}: damaged; chunks of {chunk} do not lie along the first axis of {shape}")
    content = np.empty(shape, dtype.newbyteorder("<"))
    chunk_bytes = math.prod(chunk) * dtype.itemsize

    def read(number: int) -> None:
        rows = content[number * chunk[0] : (number + 1) * chunk[0]]
        packed = _read_file(folder.joinpath("c", str(number), *("0" for _ in shape[1:])), 2 * chunk_bytes)
        size = int.from_bytes(packed[4:8], "little")  # Blosc's header: how much memory unpacking takes
        if size != chunk_bytes:
            raise ValueError(f"{folder}: damaged; chunk {number} holds {size} bytes, not {chunk_bytes}")
        try:
            if len(rows) == chunk[0]:
                blosc.decompress(packed, rows)
            else:  # the last chunk is as large as the others
                rows[...] = np.frombuffer(blosc.decompress(packed), content.dtype, rows.size).reshape(rows.shape)
        except RuntimeError as error:
            raise ValueError(f"{folder}: damaged; chunk {number}: {error}") from None

    with ThreadPoolExecutor(READERS) as pool:
        list(pool.map(read, range(-(-shape[0] // chunk[0]))))
    return content


def _read_file(path: Path, most: int) -> bytes:
    """A regular file of limited size: no pipe that never ends, no link to a device."""
    status = os.lstat(path)
    if not stat.S_ISREG(status.st_mode) or status.st_size > most:
        raise ValueError(f"{path}: damaged; {status.st_size} bytes, where {most} are the most")
    with open(path, "rb") as stream:
        return stream.read(status.st_size)


def type_named(name: str) -> type:
    """The dataclass that a stored object names as "module:class".

    Raises ValueError when its module is neither of this package nor named ss_flow_...; OtherFields when there is no
    such dataclass here.
    """
    module, _, qualified = str(name).partition(":")
    if not module.startswith(TRUSTED_PREFIXES):
        raise ValueError(f"refused the foreign type {name}: its module's name does not begin with ss_flow_")
    try:
        found: Any = importlib.import_module(module)
        for part in qualified.split("."):
            found = getattr(found, part)
    except MemoryError:
        raise
    except Exception as error:  # whatever a module raises that another flow brought, or that is being edited
        raise OtherFields(f"there is no type {name} here ({error})") from None
    if not dataclasses.is_dataclass(found) or not isinstance(found, type) or found.__module__ != module:
        raise OtherFields(f"there is no dataclass {name} here")
    return found


def _chunks(array: np.ndarray) -> tuple[int, ...]:
    row_bytes = max(1, array.nbytes // max(1, len(array)))
    return (min(len(array), max(1, CHUNK_BYTES // row_bytes)), *array.shape[1:])


def _plain(content: Any, where: str) -> Any:
    """A field as JSON; a NumPy scalar or a nested tuple becomes its plain twin."""
    if isinstance(content, np.generic):
        content = content.item()
    if isinstance(content, enum.Enum) or hasattr(content, "_fields"):  # would come back as a number, a text or a list
        raise TypeError(f"{where} holds a {type(content).__name__}, which would not come back; store plain values")
    if content is None or isinstance(content, bool | int | float | str):
        return content
    if isinstance(content, tuple | list):
        return [_plain(item, where) for item in content]
    if isinstance(content, dict) and all(isinstance(name, str) for name in content):
        return {name: _plain(item, where) for name, item in content.items()}
    if isinstance(content, np.ndarray):
        raise TypeError(f"{where} holds arrays in a list or a dict; give each a field of its own")
    raise TypeError(f"{where} holds a {type(content).__name__}, which is neither an array nor plain data")


def _hints(kind: type) -> dict[str, Any]:
    """The declared types of a dataclass's fields, but for those with a name that only type checkers import."""
    try:
        return typing.get_type_hints(kind)
    except NameError:
        known: dict[str, Any] = {}
        for item in dataclasses.fields(kind):
            with contextlib.suppress(NameError):
                alone = types.SimpleNamespace(__annotations__={item.name: item.type})
                known |= typing.get_type_hints(alone, vars(sys.modules[kind.__module__]))
        return known


def _restored(content: Any, hint: Any) -> Any:
    """A field as it was written: lists as the tuples that they are declared to be; nothing else is converted.

    Of a union, the first member that is a tuple or a list counts.
    """
    if typing.get_origin(hint) in (typing.Union, types.UnionType):
        among = typing.get_args(hint)
        hint = next((one for one in among if (typing.get_origin(one) or one) in (tuple, list)), None)
    if hint is tuple:
        hint = tuple[Any, ...]
    if typing.get_origin(hint) is not tuple or not isinstance(content, list):
        return content
    inner = typing.get_args(hint)
    if inner[1:] == (...,):
        inner = inner[:1] * len(content)
    return tuple(_restored(item, kind) for item, kind in itertools.zip_longest(content, inner[: len(content)]))
