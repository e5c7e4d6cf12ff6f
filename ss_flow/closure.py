"""The code that a function's result depends on: its own, that of everything in our packages it names, and which
modules of others that imports.

Read from the source, without importing anything: a definition is digested as its syntax tree, so comments, docstrings
and formatting count for nothing, while an edited helper or constant counts. Names are resolved statically, local
imports included; what a definition may call is what it names. The engine itself is left out: how a task is run does not
change what it returns.
"""

from __future__ import annotations

import ast
import functools
import importlib.util
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from blake3 import blake3

FOLLOWED = ("ss_flow.tasks", "ss_flow.flows")
"""Packages whose definitions are followed, besides the package of the function itself."""

ENGINE = "ss_flow"

NATIVE_SOURCES = "NATIVE_SOURCES"
"""A module-level tuple of file names, relative to the module: sources of the native code it loads."""

Origin = tuple[str, str | None]
"""(module, name in it), or (module, None) for the module itself."""
Imports = dict[str, list[Origin]]
"""What each local name may be: more than one thing, where it is imported in one branch and in another."""


@dataclass(frozen=True)
class _Source:
    path: Path
    is_package: bool
    text: str


@dataclass
class _Module:
    name: str
    path: Path
    is_package: bool
    definitions: dict[str, list[ast.stmt]] = field(default_factory=dict)
    imports: Imports = field(default_factory=dict)


@dataclass(frozen=True)
class Closure:
    """All that the code of a function consists of."""

    definitions: dict[str, str]
    """Digests by qualified name, "package.module.name", the function included; of a native source by its file name."""
    modules: frozenset[str]
    """Top-level names of the imported modules that are neither ours nor Python's own."""
    sources: dict[str, str]
    """Digests of all files that this was read from, by the names that `source_digest` takes; "" for a module that was
    looked for in vain. While they are the same, so is the closure."""


@dataclass(frozen=True)
class _Needs:
    """What one definition leads to."""

    names: tuple[tuple[str, str], ...]
    """Modules that are followed, and names in them."""
    imported: frozenset[str]
    """Top-level modules that it imports or names."""
    looked_for: frozenset[str]
    """Modules that may or may not exist: `b` of `from a import b`, where it says `b.c`."""


def closure_of(function: Callable[..., Any]) -> Closure:
    """What a module-level function depends on."""
    return _closure(function.__module__, function.__qualname__)


def code_closure(function: Callable[..., Any]) -> dict[str, str]:
    """Digests of all definitions that `function` depends on, by qualified name, itself included."""
    return dict(closure_of(function).definitions)


def forget() -> None:
    """Read the sources anew the next time; a process reads each of them once."""
    for remembered in (_closure, _digests, _needed, _read, _module, _source, source_digest):
        remembered.cache_clear()


@functools.cache
def source_digest(name: str) -> str:
    """The digest of a module's source, or of the native source "module:file"; "" when there is none."""
    module, _, native = name.partition(":")
    source = _source(module)
    if source is None:
        return ""
    if not native:  # in a package, relative imports mean others
        return blake3(f"{source.is_package} {source.text}".encode()).hexdigest()
    try:
        return blake3((source.path.parent / native).read_bytes()).hexdigest()
    except FileNotFoundError:
        return ""


@functools.cache
def _closure(module_name: str, function_name: str) -> Closure:
    own = module_name.partition(".")[0]
    followed = (*FOLLOWED, own) if own != ENGINE else FOLLOWED
    known = sys.stdlib_module_names | {ENGINE, own}
    found: dict[str, str] = {}
    modules: set[str] = set()
    sources: set[str] = set()
    pending = [(module_name, function_name.partition(".")[0])]
    while pending:
        module_name, name = pending.pop()
        sources.add(module_name)
        module = _module(module_name)
        if module is None or f"{module_name}.{name}" in found:
            continue
        if name not in module.definitions:
            for origin, attribute in module.imports.get(name, ()):
                modules.add(origin.partition(".")[0])
                if attribute is not None and origin.startswith(followed):
                    pending.append((origin, attribute))
            continue
        found |= _digests(module_name, name)
        needs = _needed(module_name, name, followed)
        pending.extend(needs.names)
        modules |= needs.imported
        sources |= needs.looked_for
    sources |= {name for name in found if ":" in name}
    return Closure(
        dict(sorted(found.items())), frozenset(modules - known), {name: source_digest(name) for name in sorted(sources)}
    )


@functools.cache
def _digests(module_name: str, name: str) -> dict[str, str]:
    """The digest of one definition, and of the native sources of its module."""
    module = _module(module_name)
    assert module is not None
    native = {(file := f"{module_name}:{source}"): source_digest(file) for source in _native_sources(module)}
    return {f"{module_name}.{name}": blake3(_read(module_name, name)[0].encode()).hexdigest()} | native


@functools.cache
def _needed(module_name: str, name: str, followed: tuple[str, ...]) -> _Needs:
    """What one definition leads to in the packages that are followed."""
    module = _module(module_name)
    assert module is not None
    nodes = _read(module_name, name)[1]
    own = _imports(module, nodes)
    named = {node.id for node in nodes if isinstance(node, ast.Name)} & module.imports.keys()
    origins = [*own.values(), *(module.imports[name] for name in named)]
    imported = {origin.partition(".")[0] for several in origins for origin, _ in several}
    looked_for: set[str] = set()
    needed = dict.fromkeys(_dependencies(module, nodes, module.imports | own, followed, looked_for))
    return _Needs(tuple(needed), frozenset(imported.union(_loaded_by_name(nodes))), frozenset(looked_for))


@functools.cache
def _read(module_name: str, name: str) -> tuple[str, list[ast.AST]]:
    """One definition as canonical text, and the nodes that count in it."""
    module = _module(module_name)
    assert module is not None
    nodes: list[ast.AST] = []
    return "\n".join(_canonical(statement, nodes) for statement in module.definitions[name]), nodes


def _dependencies(
    module: _Module, nodes: list[ast.AST], local: Imports, followed: tuple[str, ...], looked_for: set[str]
) -> Iterator[tuple[str, str]]:
    for node in nodes:
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
            for origin, attribute in local.get(node.value.id, ()):
                if not origin.startswith(followed):
                    continue
                if attribute is None:
                    yield origin, node.attr
                    continue
                looked_for.add(f"{origin}.{attribute}")
                if _source(f"{origin}.{attribute}"):
                    yield f"{origin}.{attribute}", node.attr
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Load):
            if node.id in module.definitions:
                yield module.name, node.id
            for origin, attribute in local.get(node.id, ()):
                if attribute is not None and origin.startswith(followed):
                    yield origin, attribute


def _loaded_by_name(nodes: list[ast.AST]) -> Iterator[str]:
    """The top-level modules of `import_module("...")`."""
    for node in nodes:
        match node:
            case ast.Call(
                func=ast.Name(id="import_module") | ast.Attribute(attr="import_module"),
                args=[ast.Constant(value=str(name)), *_],
            ):
                yield name.partition(".")[0]


@functools.cache
def _source(name: str) -> _Source | None:
    """A module as it is written; None when there is none, or none in Python."""
    parent = _source(package) if (package := name.rpartition(".")[0]) else None
    if parent is not None and not parent.is_package:
        return None  # a name in a module; to look further would import that
    try:
        spec = importlib.util.find_spec(name)
    except (ImportError, ValueError):
        return None
    if spec is None or spec.origin is None or not spec.origin.endswith(".py"):
        return None
    path = Path(spec.origin)
    return _Source(path, spec.submodule_search_locations is not None, path.read_text(encoding="utf-8"))


@functools.cache
def _module(name: str) -> _Module | None:
    source = _source(name)
    if source is None:
        return None
    module = _Module(name, source.path, source.is_package)
    tree = ast.parse(source.text)
    for statement in _top_level(tree.body):
        for bound in _bound_names(statement):
            module.definitions.setdefault(bound, []).append(statement)
    module.imports = _imports(module, _top_level(tree.body))
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


def _imports(module: _Module, nodes: Any) -> Imports:
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


def _native_sources(module: _Module) -> tuple[str, ...]:
    for statement in module.definitions.get(NATIVE_SOURCES, ()):
        if isinstance(statement, ast.Assign):
            return tuple(ast.literal_eval(statement.value))
    return ()


def _canonical(node: Any, counted: list[ast.AST]) -> str:
    """A definition as text in which only what is executed counts; the nodes of that are added to `counted`.

    Left out are docstrings (under fields too), and the `@task(...)` decorator: how a task runs (cores, memory) is not
    what it returns.
    """
    if isinstance(node, list):
        return f"[{','.join([_canonical(item, counted) for item in node])}]"
    if not isinstance(node, ast.AST):
        return repr(node)
    counted.append(node)
    fields = []
    for name in node._fields:
        part = getattr(node, name, None)
        if part is None or name == "ctx":  # whether a name is read or written follows from where it stands
            continue
        if isinstance(node, _DEFINITIONS):
            if name == "body":
                part = [statement for statement in part if not _is_docstring(statement)]
            elif name == "decorator_list" and not isinstance(node, ast.ClassDef):
                part = [decorator for decorator in part if "task" not in _called_names(decorator)]
        fields.append(f"{name}={_canonical(part, counted)}")
    return f"{type(node).__name__}({','.join(fields)})"


_DEFINITIONS = (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)


def _is_docstring(statement: ast.stmt) -> bool:
    return (
        isinstance(statement, ast.Expr)
        and isinstance(statement.value, ast.Constant)
        and isinstance(statement.value.value, str)
    )


def _called_names(decorator: ast.expr) -> set[str]:
    called = decorator.func if isinstance(decorator, ast.Call) else decorator
    return {called.id} if isinstance(called, ast.Name) else set()
