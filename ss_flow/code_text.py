"""Code as text in which only what is executed counts."""

from __future__ import annotations

import ast
import contextlib
import functools
from collections.abc import Iterator
from typing import Any

from ss_flow.at_load import DEFINITIONS
from ss_flow.sources import Imports


def canonical_code(node: Any, counted: list[ast.AST], imports: Imports) -> str:
    """A definition as text in which only what is executed counts; the nodes of that are added to `counted`.

    Left out are docstrings (under fields too), and the `@task(...)` decorator: how a task runs (cores, memory) is not
    what it returns.
    """
    if type(node) is list:
        return f"[{','.join([canonical_code(item, counted, imports) for item in node])}]"
    kind: Any = type(node)
    names = _fields_of(kind)
    if names is None:
        return repr(node)
    counted.append(node)
    fields = []
    for name in names:
        part = getattr(node, name, None)
        if part is None:
            continue
        if name in ("annotation", "returns"):
            counted += _quoted(part)
        elif name in ("body", "decorator_list") and isinstance(node, DEFINITIONS):
            if name == "body":
                part = [statement for statement in part if not _is_docstring(statement)]
            elif not isinstance(node, ast.ClassDef):
                part = [decorator for decorator in part if not _declares_task(decorator, imports)]
        fields.append(f"{name}={canonical_code(part, counted, imports)}")
    return f"{type(node).__name__}({','.join(fields)})"


@functools.cache
def _fields_of(kind: Any) -> tuple[str, ...] | None:
    """What counts of a kind of node; None of anything else.

    Not "ctx", read or written: it says where it stands; nor "kind": u"" is "".
    """
    return tuple(name for name in kind._fields if name not in ("ctx", "kind")) if issubclass(kind, ast.AST) else None


def _quoted(annotation: ast.AST) -> Iterator[ast.AST]:
    """What an annotation says in quotes, as the nodes that it would be without."""
    pending = [annotation]
    while pending:
        node = pending.pop()
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            with contextlib.suppress(SyntaxError):
                yield from ast.walk(ast.parse(node.value, mode="eval").body)
        elif not (isinstance(node, ast.Subscript) and ast.unparse(node.value).endswith("Literal")):
            pending += ast.iter_child_nodes(node)


def _is_docstring(statement: ast.stmt) -> bool:
    return (
        isinstance(statement, ast.Expr)
        and isinstance(statement.value, ast.Constant)
        and isinstance(statement.value.value, str)
    )


def _declares_task(decorator: ast.expr, imports: Imports) -> bool:
    """Whether a decorator is the engine's `task`, whatever it is imported as."""
    first, *others = dotted(decorator.func if isinstance(decorator, ast.Call) else decorator)
    return any(
        [*origin.split("."), *([attribute] if attribute else []), *others] == ["ss_flow", "task", "task"]
        for origin, attribute in imports.get(first, ())
    )


def dotted(node: ast.expr) -> list[str]:
    """The names of `a.b.c`; [""] for another expression."""
    names: list[str] = []
    while isinstance(node, ast.Attribute):
        names.append(node.attr)
        node = node.value
    return [node.id, *reversed(names)] if isinstance(node, ast.Name) else [""]
