"""The code that a function's result depends on: its own and that of everything in our packages it names.

Read from the source, without importing anything: a definition is digested as its syntax tree, so comments, docstrings
and formatting count for nothing, while an edited helper or constant counts. Names are resolved statically, local
imports included; what a definition may call is what it names. The engine itself is left out: how a task is run does not
change what it returns.
"""

from __future__ import annotations

import ast
import functools
import importlib.util
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from blake3 import blake3

FOLLOWED = ("ss_flow.tasks", "ss_flow.flows")
"""Packages whose definitions are followed, besides the package of the function itself."""

NATIVE_SOURCES = "NATIVE_SOURCES"
"""A module-level tuple of file names, relative to the module: sources of the native code it loads."""


@dataclass
class _Module:
    name: str
    path: Path
    is_package: bool
    definitions: dict[str, list[ast.stmt]] = field(default_factory=dict)
    imports: dict[str, tuple[str, str | None]] = field(default_factory=dict)
    """Local name -> (module, name in it), or (module, None) for the module itself."""


def code_closure(function: Callable[..., Any]) -> dict[str, str]:
    """Digests of all definitions that `function` depends on, by qualified name, itself included.

    function: a module-level function. A definition appears as "package.module.name"; a native source as its file name.
    """
    return dict(_closure(function.__module__, function.__qualname__))


def forget() -> None:
    """Read the sources anew the next time; a process reads each of them once."""
    for remembered in (_closure, _digests, _needed, _module):
        remembered.cache_clear()


@functools.cache
def _closure(module_name: str, function_name: str) -> tuple[tuple[str, str], ...]:
    followed = (*FOLLOWED, module_name.partition(".")[0]) if not module_name.startswith("ss_flow.") else FOLLOWED
    found: dict[str, str] = {}
    pending = [(module_name, function_name.partition(".")[0])]
    while pending:
        module_name, name = pending.pop()
        module = _module(module_name)
        if module is None or f"{module_name}.{name}" in found:
            continue
        if name not in module.definitions:
            pending.extend(_follow(module, name, followed))
            continue
        found |= _digests(module_name, name)
        pending.extend(_needed(module_name, name, followed))
    return tuple(sorted(found.items()))


@functools.cache
def _digests(module_name: str, name: str) -> dict[str, str]:
    """The digest of one definition, and of the native sources of its module."""
    module = _module(module_name)
    assert module is not None
    text = "\n".join(map(_canonical, module.definitions[name]))
    native = {
        f"{module_name}:{source}": blake3((module.path.parent / source).read_bytes()).hexdigest()
        for source in _native_sources(module)
    }
    return {f"{module_name}.{name}": blake3(text.encode()).hexdigest()} | native


@functools.cache
def _needed(module_name: str, name: str, followed: tuple[str, ...]) -> tuple[tuple[str, str], ...]:
    """What one definition names in the packages that are followed."""
    module = _module(module_name)
    assert module is not None
    statements = module.definitions[name]
    return tuple(dict.fromkeys(d for statement in statements for d in _dependencies(module, statement, followed)))


def _follow(module: _Module, name: str, followed: tuple[str, ...]) -> Iterator[tuple[str, str]]:
    """Where a name that a module imports is defined."""
    origin, attribute = module.imports.get(name, ("", None))
    if attribute is not None and origin.startswith(followed):
        yield origin, attribute


def _dependencies(module: _Module, statement: ast.stmt, followed: tuple[str, ...]) -> Iterator[tuple[str, str]]:
    nodes = list(ast.walk(statement))
    local = module.imports | _imports(module, nodes)
    for node in nodes:
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
            origin, attribute = local.get(node.value.id, ("", ""))
            if attribute is not None and origin.startswith(followed) and _module(f"{origin}.{attribute}"):
                yield f"{origin}.{attribute}", node.attr
            elif attribute is None and origin.startswith(followed):
                yield origin, node.attr
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Load):
            if node.id in module.definitions:
                yield module.name, node.id
            elif node.id in local:
                origin, attribute = local[node.id]
                if attribute is not None and origin.startswith(followed):
                    yield origin, attribute


@functools.cache
def _module(name: str) -> _Module | None:
    try:
        spec = importlib.util.find_spec(name)
    except (ImportError, ValueError):
        return None
    if spec is None or spec.origin is None or not spec.origin.endswith(".py"):
        return None
    module = _Module(name, Path(spec.origin), spec.submodule_search_locations is not None)
    tree = ast.parse(module.path.read_text(encoding="utf-8"))
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
        case ast.FunctionDef() | ast.AsyncFunctionDef() | ast.ClassDef():
            return [statement.name]
        case ast.Assign():
            return [n.id for target in statement.targets for n in ast.walk(target) if isinstance(n, ast.Name)]
        case ast.AnnAssign(target=ast.Name(id=name)) | ast.AugAssign(target=ast.Name(id=name)):
            return [name]
    return []


def _imports(module: _Module, nodes: Any) -> dict[str, tuple[str, str | None]]:
    found: dict[str, tuple[str, str | None]] = {}
    for node in nodes:
        if isinstance(node, ast.Import):
            for alias in node.names:
                found[alias.asname or alias.name.partition(".")[0]] = (alias.name, None)
        elif isinstance(node, ast.ImportFrom):
            package = module.name if module.is_package else module.name.rpartition(".")[0]
            for _ in range(node.level - 1):
                package = package.rpartition(".")[0]
            origin = f"{package}.{node.module}" if node.level and node.module else node.module or package
            for alias in node.names:
                found[alias.asname or alias.name] = (origin, alias.name)
    return found


def _native_sources(module: _Module) -> tuple[str, ...]:
    for statement in module.definitions.get(NATIVE_SOURCES, ()):
        if isinstance(statement, ast.Assign):
            return tuple(ast.literal_eval(statement.value))
    return ()


def _canonical(node: Any) -> str:
    """A definition as text in which only what is executed counts.

    Left out are docstrings (under fields too), and the `@task(...)` decorator: how a task runs (cores, memory) is not
    what it returns.
    """
    if isinstance(node, list):
        return f"[{','.join(map(_canonical, node))}]"
    if not isinstance(node, ast.AST):
        return repr(node)
    parts = {name: getattr(node, name, None) for name in node._fields}
    if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
        parts["body"] = [statement for statement in node.body if not _is_docstring(statement)]
        if not isinstance(node, ast.ClassDef):
            parts["decorator_list"] = [d for d in node.decorator_list if "task" not in _called_names(d)]
    fields = ",".join(f"{name}={_canonical(part)}" for name, part in parts.items() if part is not None)
    return f"{type(node).__name__}({fields})"


def _is_docstring(statement: ast.stmt) -> bool:
    return (
        isinstance(statement, ast.Expr)
        and isinstance(statement.value, ast.Constant)
        and isinstance(statement.value.value, str)
    )


def _called_names(decorator: ast.expr) -> set[str]:
    called = decorator.func if isinstance(decorator, ast.Call) else decorator
    return {called.id} if isinstance(called, ast.Name) else set()
