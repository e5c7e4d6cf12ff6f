"""What a module changes when it is loaded, besides the names that it binds.

A table is filled by a loop, a function is registered by a decorator, a library is told its precision: whoever uses that
table or library depends on the statement. What code of another module does is not looked at.
"""

from __future__ import annotations

import ast
import itertools
from collections.abc import Iterable, Iterator, Mapping, Sequence
from types import MappingProxyType

FUNCTIONS = (ast.FunctionDef, ast.AsyncFunctionDef)
DEFINITIONS = (*FUNCTIONS, ast.ClassDef)
Function = ast.FunctionDef | ast.AsyncFunctionDef
_HOOK = "__init_subclass__"
"""What a class calls when another one is derived from it."""
_HARMLESS = frozenset().union(*map(dir, (str, bytes, float, tuple, frozenset, MappingProxyType)))
"""Methods of what cannot be changed."""


class Loading:
    """The statements at the top of a module, as they run when it is loaded.

    imported: the top-level module that each of its imports comes from, by local name. own: that of the module itself.
    """

    def __init__(self, statements: Sequence[ast.stmt], imported: Mapping[str, str], own: str) -> None:
        self._imported = imported
        self._libraries = {name: top for name, top in imported.items() if top != own}
        self._callables: dict[str, list[ast.stmt]] = {}
        """Its functions and classes by name."""
        for statement in statements:
            if isinstance(statement, DEFINITIONS):
                self._callables.setdefault(statement.name, []).append(statement)
        self._inner: dict[str, list[tuple[Function, set[str]]]] = {}
        """The functions in those that are called, methods among them, with the names of their parameters."""
        self._aliases: dict[str, set[str]] = {}
        """Names that each may stand for (a part of) the same object as; what different functions call alike is one."""
        self._elements: dict[str, set[str]] = {}
        """What loops go through, by the names that they bind."""
        self._parts = {id(one): [*self._parts_of(one)] for one in statements}
        """The pieces of code that each statement is, as it runs."""
        self._called: dict[ast.AST, set[ast.AST]] = {}
        """The functions that are called in a piece of code."""
        parts = [*itertools.chain(*self._parts.values())]
        known = -1
        # A call may give a name that makes another call one of a function here: until there is none left, so that what
        # is found does not depend on the order in which sets are gone through.
        while known < (known := sum(map(len, self._aliases.values()))):
            self._called = self._calls_from(parts)
        self._changed = {part: self._changed_by(part) for part in self._called}

    def _calls_from(self, parts: Iterable[ast.AST]) -> dict[ast.AST, set[ast.AST]]:
        """The functions that are called in pieces of code, and in these functions, by what names stand for so far."""
        pending, called = [*parts], dict[ast.AST, set[ast.AST]]()
        while pending:
            if (part := pending.pop()) not in called:
                if part not in self._called:
                    self._note_aliases(part)
                called[part] = set(self._calls_in(part))
                pending += called[part]
        return called

    def changed(self, statement: ast.stmt) -> set[str]:
        """The names whose objects a statement changes, and those that functions which it calls declare global."""
        pending, seen, changed = [*self._parts[id(statement)]], set[ast.AST](), set[str]()
        while pending:
            part = pending.pop()
            seen.add(part)
            changed |= self._changed[part]
            pending += self._called[part] - seen
            seen |= self._called[part]
        # The state of a library is that of all its parts.
        told = {self._libraries[name] for name in changed & self._libraries.keys()}
        return changed.union(name for name, library in self._libraries.items() if library in told)

    def _changed_by(self, part: ast.AST) -> set[str]:
        """The names whose objects a piece of code changes, without what it calls."""
        names = {*self._changed_in(part)}
        changed = self._reached(names) - self._callables.keys()
        changed = changed.union(*(self._elements.get(name, ()) for name in names))
        if isinstance(part, FUNCTIONS):  # what it makes of a library is its own
            changed -= self._imported.keys()
            names -= _parameters(part)
            names.update(declared_global(part))
        return changed | names

    def _reached(self, names: Iterable[str]) -> set[str]:
        """What names may stand for."""
        pending, reached = [*names], set[str]()
        while pending:
            further = self._aliases.get(pending.pop(), set()) - reached
            reached |= further
            pending += further
        return reached

    def _calls_in(self, part: ast.AST) -> Iterator[ast.AST]:
        """The functions that a piece of code calls, of a class all methods; parameters are what they are given."""
        for node in walk(part):
            if isinstance(node, ast.Call) and (name := _root(node.func)):
                hook = node.func.attr if isinstance(node.func, ast.Attribute) and node.func.attr == _HOOK else ""
                given = set[str]().union(*map(_names, (*node.args, *(keyword.value for keyword in node.keywords))))
                for called in {name, *self._reached([name])} & self._callables.keys():
                    for function, parameters in self._functions_in(called):
                        if hook in ("", function.name):
                            for parameter in parameters - {"self", "cls"} if given else ():
                                self._alias(parameter, given)
                            yield function

    def _functions_in(self, name: str) -> list[tuple[Function, set[str]]]:
        """Those in a function or class, itself included: looked for when it is called, which few are at load."""
        if name not in self._inner:
            nodes = itertools.chain(*map(walk, self._callables[name]))
            self._inner[name] = [(node, _parameters(node)) for node in nodes if isinstance(node, FUNCTIONS)]
        return self._inner[name]

    def _parts_of(self, statement: ast.stmt) -> Iterator[ast.AST]:
        """What of a statement runs when its module is loaded: of a definition, its decorators, which are calls, unless
        another module's; its defaults; the body of a class, and the hooks of its bases."""
        if not isinstance(statement, DEFINITIONS):
            yield statement
            return
        for decorator in statement.decorator_list:
            if _root(decorator) not in self._imported:
                yield ast.Expr(ast.Call(decorator, [], []))
        if isinstance(statement, ast.ClassDef):
            yield from (ast.Call(ast.Attribute(base, _HOOK, ast.Load()), [], []) for base in statement.bases)
            yield from (ast.Call(keyword.value, [], []) for keyword in statement.keywords)  # a metaclass
            for inner in statement.body:
                yield from self._parts_of(inner)
        else:
            yield from statement.args.defaults
            yield from filter(None, statement.args.kw_defaults)

    def _changed_in(self, part: ast.AST) -> Iterator[str]:
        """The names whose objects a piece of code changes: `x[...] = y`, `x.y = z`, `x.append(y)`, `fill(x)`.

        Where its value is used, a method of an object counts, but no function of a library: that tells its result.
        """
        for node in walk(part):
            if isinstance(node, ast.Subscript | ast.Attribute) and is_written(node):
                yield _root(node)
            elif isinstance(node, ast.Expr) and isinstance(node.value, ast.Call):
                call = node.value
                yield from map(_root, (*call.args, *(keyword.value for keyword in call.keywords)))
                yield from _names(call) - self._callables.keys() - self._imported.keys()
                if not isinstance(call.func, ast.Name):
                    yield _root(call.func)
            elif (
                isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr not in _HARMLESS
            ):
                yield from {_root(node.func)} - self._callables.keys() - self._imported.keys()

    def _note_aliases(self, part: ast.AST) -> None:
        for node in walk(part):
            match node:
                case ast.Assign(targets=targets, value=value):
                    pairs = [(target, value) for target in targets]
                case (
                    ast.AnnAssign(target=target, value=ast.expr() as value) | ast.NamedExpr(target=target, value=value)
                ):
                    pairs = [(target, value)]
                case ast.For() | ast.AsyncFor() | ast.comprehension():
                    pairs = [(node.target, node.iter)]
                    for name in _names(node.target):
                        self._elements.setdefault(name, set()).update(_names(node.iter))
                case ast.withitem(context_expr=value, optional_vars=ast.expr() as target):
                    pairs = [(target, value)]
                case _:
                    continue
            for target, value in pairs:
                for name in _names(target):
                    self._alias(name, _names(value))

    def _alias(self, name: str, others: set[str]) -> None:
        self._aliases.setdefault(name, set()).update(others)


def walk(node: ast.AST) -> list[ast.AST]:
    """A node and all in it, as `ast.walk` goes through them, but for what says how a name is used.

    That one makes generators of every node, and is most of what an analysis takes.
    """
    nodes = [node]
    for node in nodes:
        for name in node._fields:
            part = getattr(node, name, None)
            if isinstance(part, ast.AST):
                if name != "ctx":
                    nodes.append(part)
            elif isinstance(part, list):
                nodes += [item for item in part if isinstance(item, ast.AST)]
    return nodes


def _parameters(function: ast.AST) -> set[str]:
    """Those of the functions in it, too."""
    return {node.arg for node in walk(function) if isinstance(node, ast.arg)}


def declared_global(function: ast.AST) -> list[str]:
    """The names that a function declares global."""
    return [name for node in walk(function) if isinstance(node, ast.Global) for name in node.names]


def is_written(node: ast.Name | ast.Subscript | ast.Attribute) -> bool:
    """Whether something is bound, or deleted, here."""
    return not isinstance(node.ctx, ast.Load)


def _root(node: ast.expr) -> str:
    """The name that `x.y[0].z(...)` begins with; "" of another expression."""
    while isinstance(node, ast.Subscript | ast.Attribute | ast.Starred | ast.Call):
        node = node.func if isinstance(node, ast.Call) else node.value
    return node.id if isinstance(node, ast.Name) else ""


def _names(part: ast.AST) -> set[str]:
    return {node.id for node in walk(part) if isinstance(node, ast.Name)}
