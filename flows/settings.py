"""Parameters as text: `step.param=value` on the command line, tables in a preset, checked against their types."""

from __future__ import annotations

import dataclasses
import difflib
import functools
import math
import numbers
import tomllib
import types
import typing
from collections.abc import Iterable, Iterator, Mapping
from importlib import resources
from typing import Any, TypeVar

from ss_flow.errors import InputError
from ss_flow.tasks.ranges import Range

T = TypeVar("T")
Path = tuple[str, ...]


def leaves(params: Any, prefix: Path = ()) -> Iterator[tuple[Path, Any]]:
    """Every single parameter of nested dataclasses, as its path and its value."""
    for item in dataclasses.fields(params):
        value = getattr(params, item.name)
        if dataclasses.is_dataclass(value):
            yield from leaves(value, (*prefix, item.name))
        else:
            yield (*prefix, item.name), value


def flat(params: Any) -> dict[str, Any]:
    """All parameters by dotted name."""
    return {".".join(path): value for path, value in leaves(params)}


def apply(params: T, assignments: Iterable[str]) -> T:
    """Set parameters from texts such as "split.tau_label=0.8".

    A name may leave out what is not needed to tell it apart: "propagate.tau_label" and "split.tau_label" are the same.
    Lists that belong together may come in any order, and the last of several texts for one parameter counts.
    Raises InputError for a text without "=", an unknown or ambiguous name, and a value of the wrong type or range.
    """
    values: dict[Path, Any] = {}
    for assignment in assignments:
        name, equals, text = assignment.partition("=")
        if not equals or not name:
            raise InputError(f"--set {assignment!r} is not of the form step.param=value.")
        path = find(params, name.strip())
        values[path] = _parsed(text.strip(), type_of(params, path), ".".join(path))
    return _replaced(params, values)


def find(params: Any, name: str) -> Path:
    """The path of the one parameter that a name, possibly shortened, stands for. Raises InputError."""
    paths = [path for path, _ in leaves(params)]
    wanted = name.split(".")
    matches = [path for path in paths if list(path) == wanted] or [path for path in paths if _shortens(wanted, path)]
    if len(matches) == 1:
        return matches[0]
    if matches:
        raise InputError(f"parameter {name!r} is ambiguous; it may be {_either('.'.join(m) for m in matches)}.")
    known = [".".join(path) for path in paths] + [f"{path[0]}.{path[-1]}" for path in paths]
    close = difflib.get_close_matches(name, known, n=1, cutoff=0.5)
    last = difflib.get_close_matches(wanted[-1], [path[-1] for path in paths], n=1, cutoff=0.6)
    hint = close or [".".join(path) for path in paths if last and path[-1] == last[0]][:1]
    raise InputError(
        f"parameter {name!r} is unknown; "
        + (f"did you mean {hint[0]!r}?" if hint else f"they begin with {_either(sorted({p[0] for p in paths}))}.")
    )


def preset(params: T, name: str) -> T:
    """Set the parameters that a preset names, after those of its `base`. Raises InputError for an unknown preset."""
    if name == "default":
        return params
    folder = resources.files("ss_flow.flows") / "presets"
    known = sorted(entry.name.removesuffix(".toml") for entry in folder.iterdir() if entry.name.endswith(".toml"))
    if name not in known:
        raise InputError(f"preset {name!r} is unknown; choose one of: {', '.join(['default', *known])}.")
    table = tomllib.loads((folder / f"{name}.toml").read_text(encoding="utf-8"))
    return overlaid(preset(params, table.pop("base", "default")), table)


def overlaid(params: T, table: Mapping[str, Any]) -> T:
    """Set parameters from nested tables.

    Raises InputError for an unknown name, and a value of the wrong type or range.
    """
    values: dict[Path, Any] = {}
    for name, value in table.items():
        if isinstance(value, Mapping):
            groups = [key for key, inner in vars(params).items() if dataclasses.is_dataclass(inner)]
            if name not in groups:
                raise InputError(
                    f"the group of parameters {name!r} is unknown; there are {', '.join(groups) or 'none'}."
                )
            params = dataclasses.replace(params, **{name: overlaid(getattr(params, name), value)})  # type: ignore[type-var]
        else:
            path = find(params, name)
            _check(value, type_of(params, path), ".".join(path))
            values[path] = tuple(value) if isinstance(value, list) else value
    return _replaced(params, values)


def recorded(params: T, values: Mapping[str, Any], step: str) -> T:
    """A step's parameters as a run had them; one that the run did not know yet keeps its value.

    values: all of the run's, by dotted name, as `flat` gives them. step: what these names begin with.
    """
    return overlaid(params, {name: values[f"{step}.{name}"] for name in flat(params) if f"{step}.{name}" in values})


def _shortens(wanted: list[str], path: Path) -> bool:
    """Whether `wanted` ends like the path and otherwise leaves out parts of it, in order."""
    rest = iter(path[:-1])
    return wanted[-1] == path[-1] and all(any(part == p for p in rest) for part in wanted[:-1])


def _replaced(params: Any, values: Mapping[Path, Any]) -> Any:
    """The same with other values, by path; each dataclass is made once, since it may check one value by another."""
    own = {path[0]: value for path, value in values.items() if len(path) == 1}
    for name in {path[0] for path in values} - own.keys():
        inner = {path[1:]: value for path, value in values.items() if path[0] == name}
        own[name] = _replaced(getattr(params, name), inner)
    return dataclasses.replace(params, **own)


def type_of(params: Any, path: Path) -> Any:
    """The declared type of a parameter, with its range."""
    owner = functools.reduce(getattr, path[:-1], params)
    return typing.get_type_hints(type(owner), include_extras=True)[path[-1]]


def _parsed(text: str, kind: Any, name: str) -> Any:
    try:
        value = _converted(text, kind)
    except ValueError:
        raise _refused(text, kind, name) from None
    _check(value, kind, name)
    return value


def _converted(text: str, kind: Any) -> Any:
    if typing.get_origin(kind) is typing.Annotated:
        return _converted(text, typing.get_args(kind)[0])
    if typing.get_origin(kind) is typing.Literal:
        if text not in typing.get_args(kind):
            raise ValueError(text)
        return text
    if typing.get_origin(kind) in (types.UnionType, typing.Union):
        if text.lower() in ("none", "null"):
            return None
        return _converted(text, next(k for k in typing.get_args(kind) if k is not type(None)))
    if typing.get_origin(kind) is tuple:
        inner = typing.get_args(kind)[0]
        return tuple(_converted(part.strip(), inner) for part in text.strip("()[]").split(",") if part.strip())
    if kind is bool:
        if text.lower() not in ("true", "false", "1", "0", "yes", "no"):
            raise ValueError(text)
        return text.lower() in ("true", "1", "yes")
    if kind is float and not -float("inf") < float(text) < float("inf"):
        raise ValueError(text)
    return kind(text)


def _check(value: Any, kind: Any, name: str) -> None:
    """Raises InputError for an empty list, and for a value, or an item of it, that is not of the declared type, or out
    of the declared range or choice."""
    if typing.get_origin(kind) in (types.UnionType, typing.Union):
        if value is not None:
            _check(value, next(k for k in typing.get_args(kind) if k is not type(None)), name)
    elif typing.get_origin(kind) is tuple:
        if not isinstance(value, list | tuple):
            raise _refused(value, kind, name)
        if not value:
            raise InputError(f"parameter {name} is empty; it takes {_described(kind)}.")
        for item in value:
            _check(item, typing.get_args(kind)[0], name)
    elif typing.get_origin(kind) is typing.Annotated:
        _check(value, typing.get_args(kind)[0], name)
        for limit in typing.get_args(kind)[1:]:
            if isinstance(limit, Range) and value not in limit:
                raise InputError(f"parameter {name} is out of range: {value}; it must be {limit}.")
    elif typing.get_origin(kind) is typing.Literal:
        if value not in typing.get_args(kind):
            raise _refused(value, kind, name)
    elif not _is_of(value, kind):
        raise _refused(value, kind, name)


def _is_of(value: Any, kind: type) -> bool:
    """Whether a value is of a plain type: a whole number is a number, true and false are none."""
    if isinstance(value, bool):
        return kind is bool
    if kind is float:
        return isinstance(value, numbers.Real) and math.isfinite(value)
    return isinstance(value, numbers.Integral if kind is int else kind)


def _refused(value: Any, kind: Any, name: str) -> InputError:
    return InputError(f"parameter {name} cannot be {value!r}; it takes {_described(kind)}.")


def _described(kind: Any) -> str:
    match typing.get_origin(kind):
        case typing.Annotated:
            return _described(typing.get_args(kind)[0])
        case typing.Literal:
            return _either(repr(choice) for choice in typing.get_args(kind))
        case types.UnionType | typing.Union:
            return " or none, otherwise ".join(_described(k) for k in typing.get_args(kind) if k is not type(None))
        case None:
            words = {int: "a whole number", float: "a number", bool: "true or false", str: "a text"}
            return words.get(kind, str(kind))
        case _:
            return f"{_described(typing.get_args(kind)[0])}, or several with commas between them"


def _either(choices: Iterable[str]) -> str:
    return " or ".join(choices)
