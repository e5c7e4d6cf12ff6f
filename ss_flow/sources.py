"""Modules as they are written: what each defines and imports, read without importing anything."""

from __future__ import annotations

import ast
import functools
import importlib.util
import sys
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

from blake3 import blake3

NATIVE_SOURCES = "NATIVE_SOURCES"
"""A module-level tuple of file names, relative to the module: sources of the native code it loads."""

Origin = tuple[str, str | None]
"""(module, name in it), or (module, None) for the module itself."""
Imports = dict[str, list[Origin]]
"""What each local name may be: more than one thing, where it is imported in one branch and in another."""


@dataclass(frozen=True)
class Source:
    """A module as text."""

    path: Path
    is_package: bool
    text: str


@dataclass
class Module:
    """A module as syntax trees."""

    name: str
    is_package: bool
    definitions: dict[str, list[ast.stmt]] = field(default_factory=dict)
    imports: Imports = field(default_factory=dict)


@functools.cache
def source_digest(name: str) -> str:
    """The digest of a module's source, or of the native source "module:file"; "" when there is none."""
    module, _, native = name.partition(":")
    source = source_of(module)
    if source is None:
        return ""
    if not native:  # in a package, relative imports mean others
        return blake3(f"{source.is_package} {source.text}".encode()).hexdigest()
    try:
        return blake3((source.path.parent / native).read_bytes()).hexdigest()
    except FileNotFoundError:
        return ""


_known: dict[str, tuple[object, Source | None]] = {}
"""Modules that were read, each after its specification: another one whenever it is loaded; None = not loaded then."""


def source_of(name: str) -> Source | None:
    """A module as it is written; None when there is none, or none in Python. It is read once."""
    if name not in _known:
        _known[name] = _specification(name), _read(name)
    return _known[name][1]


def read_loaded(packages: tuple[str, ...]) -> bool:
    """Read the modules of these packages that are loaded, each as soon as possible after that, whoever asks later.

    Returns whether any of them is not as it was when it was read last, before it was loaded, or loaded again.
    """
    changed = False
    for name in [name for name in sys.modules if name.startswith(packages)]:
        specification = _specification(name)
        if name in _known and _known[name][0] is specification:
            continue
        try:
            source = _read(name)
        except (OSError, ValueError):  # its file has gone; who needs it will say so
            continue
        changed = changed or (name in _known and _known[name][1] != source)
        _known[name] = specification, source
    return changed


def forget_sources() -> None:
    """Read every module anew the next time."""
    _known.clear()


def _specification(name: str) -> object:
    return getattr(sys.modules.get(name), "__spec__", None)


def _read(name: str) -> Source | None:
    parent = source_of(package) if (package := name.rpartition(".")[0]) else None
    if parent is not None and not parent.is_package:
        return None  # a name in a module; to look further would import that
    try:
        spec = importlib.util.find_spec(name)
    except (ImportError, ValueError):
        return None
    if spec is None or spec.origin is None or not spec.origin.endswith(".py"):
        return None
    path = Path(spec.origin)
    return Source(path, spec.submodule_search_locations is not None, path.read_text(encoding="utf-8"))


@functools.cache
def module_of(name: str) -> Module | None:
    """What a module defines and imports at its top level; None when there is none in Python."""
    source = source_of(name)
    if source is None:
        return None
    module = Module(name, source.is_package)
    tree = ast.parse(source.text)
    for statement in _top_level(tree.body):
        for bound in _bound_names(statement):
            module.definitions.setdefault(bound, []).append(statement)
    module.imports = imports_of(module, _top_level(tree.body))
    return module


def _top_level(body: list[ast.stmt]) -> Iterator[ast.stmt]:
    """The statements of a module, those under `if` and `try` included; what only type checkers see is not."""
    for statement in body:
        if isinstance(statement, ast.If):
            if "TYPE_CHECKING" not in ast.dump(statement.test):
                yield from _top_level(statement.body)
            yield from _top_level(statement.orelse)
        elif isinstance(statement, ast.Try):
            for part in (statement.body, *(h.body for h in statement.handlers), statement.orelse, statement.finalbody):
                yield from _top_level(part)
        else:
            yield statement


def _bound_names(statement: ast.stmt) -> list[str]:
    match statement:
        case ast.FunctionDef(decorator_list=decorators):
            return [statement.name, *dict.fromkeys(_dispatching(decorators))]
        case ast.AsyncFunctionDef() | ast.ClassDef():
            return [statement.name]
        case ast.Assign():
            return [n.id for target in statement.targets for n in ast.walk(target) if isinstance(n, ast.Name)]
        case ast.AnnAssign(target=ast.Name(id=name)) | ast.AugAssign(target=ast.Name(id=name)):
            return [name]
    return []


def _dispatching(decorators: list[ast.expr]) -> Iterator[str]:
    """The functions of `functools.singledispatch` that `@f.register` and `@f.register(type)` add a branch to."""
    for decorator in decorators:
        match decorator.func if isinstance(decorator, ast.Call) else decorator:
            case ast.Attribute(value=ast.Name(id=function), attr="register"):
                yield function


def imports_of(module: Module, nodes: Iterable[ast.AST]) -> Imports:
    """What these nodes of a module import, relative imports resolved, by local name."""
    found: Imports = {}
    for node in nodes:
        if isinstance(node, ast.Import):
            for alias in node.names:
                found.setdefault(alias.asname or alias.name.partition(".")[0], []).append((alias.name, None))
        elif isinstance(node, ast.ImportFrom):
            package = module.name if module.is_package else module.name.rpartition(".")[0]
            for _ in range(node.level - 1):
                package = package.rpartition(".")[0]
            origin = f"{package}.{node.module}" if node.level and node.module else node.module or package
            for alias in node.names:
                found.setdefault(alias.asname or alias.name, []).append((origin, alias.name))
    return found


def native_sources(module: Module) -> tuple[str, ...]:
    """The file names in its `NATIVE_SOURCES`, relative to it."""
    for statement in module.definitions.get(NATIVE_SOURCES, ()):
        if isinstance(statement, ast.Assign):
            return tuple(ast.literal_eval(statement.value))
    return ()
