"""Tasks: plain functions with declared inputs, parameters and output.

A task's positional parameters are artifacts: one `X`, a list `tuple[X, ...]`, a list `Sequence[X]` that may be larger
than memory, whose items are read when they are looked at, or a `Bundle` of these. Its keyword-only parameters are
hashed into its key. It reads nothing else. Called in a flow, a task returns a `Node`; called anywhere else, it runs.
"""

from __future__ import annotations

import dataclasses
import functools
import inspect
import typing
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Generic, ParamSpec, TypeVar

from ss_flow.cache.files import stamp
from ss_flow.errors import InputError
from ss_flow.graph import current_flow

P = ParamSpec("P")
R = TypeVar("R")

TRIES = 3
"""How often a file is read that changes meanwhile."""


@dataclass(frozen=True)
class Resources:
    """What a task needs while it runs; the scheduler never hands out more than the machine has."""

    cores: int = 1
    most_cores: int = 1
    """Cores that it can make use of; it gets more than `cores` where fewer calls are ready than there are free ones."""
    memory_mb: int = 0
    gpus: float = 0
    """Share of a GPU that it takes where there is one; where there is none, it does without."""


@dataclass(frozen=True)
class FileRef:
    """An input file: its content counts in the key, its place does not."""

    path: Path = field(metadata={"key": False})
    digest: str
    """blake3 of the content, hexadecimal."""
    stamp: tuple[int, ...] = field(default=(), init=False, compare=False, metadata={"key": False})
    """What `stamp` said of it when this was made; () when there was no such file."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "stamp", self.stamp_now())

    @classmethod
    def of(cls, path: Path, digest_file: Callable[[Path], str]) -> FileRef:
        """A file as it is now. digest_file: gives the blake3 digest of its content, which may take a while.

        Raises OSError when it cannot be read, InputError when it changes again and again while it is.
        """
        for _ in range(TRIES):
            before = stamp(path)
            ref = cls(path, digest_file(path))
            if ref.stamp == before:
                return ref
        raise InputError(f"{path} changes while it is read; run again when it is complete.")

    def stamp_now(self) -> tuple[int, ...]:
        """What `stamp` says of the file now; () when there is no such file."""
        try:
            return stamp(self.path)
        except OSError:
            return ()

    def was_written(self, before: tuple[int, ...]) -> bool:
        """Whether the file was another one at any time since its stamp was this. Of the time of the inode's change,
        which the link of a backup changes, too, the content decides."""
        return self.stamp_now()[:-1] != before[:-1] or self.has_changed()

    def has_changed(self) -> bool:
        """Whether the file holds anything else than when this was made; it is read only where its stamp differs."""
        now = self.stamp_now()
        try:
            return not now or (now != self.stamp and _digest_of(self.path, now) != self.digest)
        except OSError:
            return True


@functools.lru_cache(maxsize=256)
def _digest_of(path: Path, stamp: tuple[int, ...]) -> str:
    from ss_flow.cache.canonical import digest_file

    return digest_file(path)


def files_in(value: Any) -> Iterator[FileRef]:
    """The files that a parameter refers to."""
    if isinstance(value, FileRef):
        yield value
    elif dataclasses.is_dataclass(value):
        for one in dataclasses.fields(value):
            yield from files_in(getattr(value, one.name))
    elif isinstance(value, tuple | list | Mapping):
        for item in value.values() if isinstance(value, Mapping) else value:
            yield from files_in(item)


Reference = Callable[[Path], FileRef]
"""Turns a path into a reference; digests are remembered outside the flow."""


class Bundle:
    """Base of frozen dataclasses of artifacts that go together as one argument of a task, say the views of a scene.

    Each field is an input of its own, named "views.frames": a bundle is neither stored nor hashed as a whole. In a flow
    its fields hold nodes, or sequences of nodes for lists.
    """


@dataclass(eq=False)
class Task(Generic[P, R]):
    """A declared task. `name` is its module below `ss_flow.tasks` and its function: "split.propagate"."""

    function: Callable[P, R]
    name: str
    resources: Resources
    uses: tuple[str, ...]
    isolate: bool
    environment: Callable[[], Mapping[str, str]] | None

    def __call__(self, *args: P.args, **kwargs: P.kwargs) -> R:
        flow = current_flow()
        return self.function(*args, **kwargs) if flow is None else typing.cast(R, flow.add(self, args, kwargs))

    @functools.cached_property
    def signature(self) -> inspect.Signature:
        return inspect.signature(self.function)

    def arguments(self, args: Sequence[Any], kwargs: Mapping[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
        """What a call was given: its inputs and its parameters by name, each in the order of their declaration.

        Raises TypeError when that does not fit the task.
        """
        defaults = self._defaults
        if len(args) == len(self._artifacts) and self._required <= kwargs.keys() <= defaults.keys():
            return _taken_apart(zip(self._artifacts, args, strict=True)), {**defaults, **kwargs}
        bound = self.signature.bind(*args, **kwargs)  # slower; says what is wrong
        bound.apply_defaults()
        given = [(name, bound.arguments.pop(name)) for name in self._artifacts]
        return _taken_apart(given), dict(bound.arguments)

    def run(self, inputs: Mapping[str, Any], parameters: Mapping[str, Any]) -> Any:
        """Run the function; inputs: artifacts by name, as `arguments` gives them."""
        whole = {
            name: kind(**{field.name: inputs[f"{name}.{field.name}"] for field in dataclasses.fields(kind)})
            if _is_bundle(kind)
            else inputs[name]
            for name, kind in self._artifacts.items()
        }
        return self.function(**whole, **parameters)  # type: ignore[call-arg]

    @functools.cached_property
    def hints(self) -> dict[str, Any]:
        """The declared types of all arguments, and of the result as "return".

        Raises TypeError where one of them is imported for type checkers alone.
        """
        try:
            return typing.get_type_hints(self.function)
        except NameError as error:
            raise TypeError(f"a type that the task {self.name} declares is not there at run time: {error}") from None

    @functools.cached_property
    def _defaults(self) -> dict[str, Any]:
        """The parameters by name; `Parameter.empty` for one that has no default."""
        return {p.name: p.default for p in self.signature.parameters.values() if p.kind == p.KEYWORD_ONLY}

    @functools.cached_property
    def _required(self) -> frozenset[str]:
        return frozenset(name for name, default in self._defaults.items() if default is inspect.Parameter.empty)

    @functools.cached_property
    def streamed(self) -> frozenset[str]:
        """The parameters that take a list whose items are read one by one."""
        hints = _hints_taken_apart(self._artifacts)
        return frozenset(name for name, hint in hints if typing.get_origin(hint) is Sequence)

    @functools.cached_property
    def _artifacts(self) -> dict[str, Any]:
        """The types of the positional parameters by name."""
        return {p.name: self.hints[p.name] for p in self.signature.parameters.values() if p.kind != p.KEYWORD_ONLY}

    @functools.cached_property
    def returns_list(self) -> bool:
        return typing.get_origin(self.hints["return"]) is tuple


def _is_bundle(kind: Any) -> bool:
    return isinstance(kind, type) and issubclass(kind, Bundle)


def _taken_apart(given: Iterable[tuple[str, Any]]) -> dict[str, Any]:
    """Arguments by name, those in bundles by the names of their fields."""
    apart: dict[str, Any] = {}
    for name, value in given:
        if isinstance(value, Bundle):
            apart |= {f"{name}.{f.name}": getattr(value, f.name) for f in dataclasses.fields(value)}  # type: ignore[arg-type]
        else:
            apart[name] = value
    return apart


def _hints_taken_apart(hints: Mapping[str, Any]) -> Iterable[tuple[str, Any]]:
    for name, hint in hints.items():
        if _is_bundle(hint):
            yield from ((f"{name}.{field}", kind) for field, kind in typing.get_type_hints(hint).items())
        else:
            yield name, hint


def task(
    *,
    name: str | None = None,
    resources: Resources = Resources(),
    uses: tuple[str, ...] = (),
    isolate: bool = False,
    environment: Callable[[], Mapping[str, str]] | None = None,
) -> Callable[[Callable[P, R]], Task[P, R]]:
    """Declare a function as a task.

    name: the step's name; by default the module below `ss_flow.tasks`, and the function where the two differ.
    uses: distributions whose versions count in the key, besides those that the code imports.
    isolate: run in a process of its own (the library aborts on errors, or is not deterministic beside others).
    environment: what else of this machine the result depends on (say, the instruction set); its items enter the key.
    Raises TypeError when the function does not declare the types of its artifacts and of its result, or does not name
    each of its arguments.
    """
    if isinstance(uses, str):
        raise TypeError(f'uses takes a tuple of names: uses=("{uses}",)')

    def declare(function: Callable[P, R]) -> Task[P, R]:
        from ss_flow.closure import fix_sources  # not above: the bare `ss-flow` declares no task

        fix_sources(function.__module__.partition(".")[0])
        step = name or _default_name(function)
        of = inspect.signature(function)
        untyped = [p.name for p in of.parameters.values() if p.kind != p.KEYWORD_ONLY and p.annotation is p.empty]
        untyped += ["its result"] if of.return_annotation is of.empty else []
        if untyped:
            raise TypeError(f"the task {step} must declare the type of {', '.join(untyped)}")
        if any(p.kind not in (p.POSITIONAL_OR_KEYWORD, p.KEYWORD_ONLY) for p in of.parameters.values()):
            raise TypeError(f"the task {step} must name its arguments one by one: no *args, no **kwargs, no `/`")
        declared: Any = Task(function, step, resources, uses, isolate, environment)
        functools.update_wrapper(declared, function)
        return typing.cast(Task[P, R], declared)

    return declare


def _default_name(function: Callable[..., Any]) -> str:
    module = function.__module__.removeprefix("ss_flow.tasks.")
    last = module.rpartition(".")[2]
    return module if last == function.__name__ else f"{module}.{function.__name__}"
