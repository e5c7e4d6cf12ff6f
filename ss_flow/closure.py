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
import sys
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

from blake3 import blake3

from ss_flow.code_text import canonical_code, dotted
from ss_flow.sources import (
    Imports,
    Module,
    forget_sources,
    imports_of,
    is_loose,
    module_of,
    module_without_stars,
    native_sources,
    read_loaded,
    source_digest,
    source_of,
)

FOLLOWED = ("ss_flow.tasks", "ss_flow.flows")
"""Packages whose definitions are followed, besides the package of the function itself."""

ENGINE = "ss_flow"

reading = threading.RLock()
"""Held while sources are read or walked through: what was read is not exchanged in between."""
_packages: set[str] = set()
"""The packages in which tasks are declared, besides ours."""
_generation = 0


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
    """What a module-level function depends on.

    Raises TypeError when its source is not found, as that of a script or of a notebook is not.
    """
    found = _closure(function.__module__, function.__qualname__)
    if not found.definitions:
        raise TypeError(
            f"the code of {function.__module__}.{function.__qualname__} cannot be followed, so no key would stand for "
            "it; a task must be a function of a module that can be imported."
        )
    return found


def forget() -> None:
    """Read the sources anew the next time; a process reads each of them once."""
    with reading:
        forget_sources()
        _forget_trees()


def _forget_trees() -> None:
    global _generation
    _generation += 1
    for remembered in (_closure, _is_followed, _digests, _needed, _read):
        remembered.cache_clear()
    for read in (module_of, module_without_stars, source_digest):
        read.cache_clear()


def fix_sources(own: str = "") -> int:
    """Read the sources of all that is loaded and followed, so that keys stand for what runs, whatever is edited later.

    own: a package whose modules are followed, too, from now on, as are those that no distribution holds. Returns a
    number that is another one after a source was edited before it was loaded: what was said of closures before then
    does not hold for what runs now.
    """
    with reading:
        if own and own != ENGINE:
            _packages.add(own)
        if read_loaded((*FOLLOWED, *_packages), loose=bool(_packages)):
            _forget_trees()
        return _generation


@functools.cache
def _closure(module_name: str, function_name: str) -> Closure:
    own = module_name.partition(".")[0]
    found: dict[str, str] = {}
    modules: set[str] = set()
    sources: set[str] = set()
    pending = [(module_name, function_name.partition(".")[0])]
    seen: set[tuple[str, str]] = set()
    while pending:
        module_name, name = pending.pop()
        if (module_name, name) in seen:
            continue
        seen.add((module_name, name))
        sources.add(module_name)
        module = module_of(module_name)
        if module is None:
            if compiled := source_digest(module_name):
                found[module_name] = compiled
            continue
        sources.update(module.stars)
        modules.update(star.partition(".")[0] for star in module.stars)
        if origins := module.imports.get(name):  # passed on from there
            found[f"{module_name}.{name}"] = blake3(f"{origins}".encode()).hexdigest()
        for origin, attribute in origins or ():
            modules.add(origin.partition(".")[0])
            if attribute is not None and _is_followed(origin, own):
                pending.append((origin, attribute))
        if name not in module.definitions:
            if name not in module.imports and "__getattr__" in module.definitions:  # which makes it
                pending.append((module_name, "__getattr__"))
            continue
        found |= _digests(module_name, name)
        needs = _needed(module_name, name, own)
        pending.extend(needs.names)
        modules |= needs.imported
        sources |= needs.looked_for
    sources |= {name for name in found if ":" in name}
    others = {name for name in modules - sys.stdlib_module_names - {ENGINE} if not _is_followed(name, own)}
    if own != ENGINE:  # a module that is not there would be followed if it were
        sources |= set(filter(is_loose, others))
    return Closure(
        dict(sorted(found.items())), frozenset(others), {name: source_digest(name) for name in sorted(sources)}
    )


@functools.cache
def _is_followed(module_name: str, own: str) -> bool:
    """Whether definitions of a module count one by one. own: the top-level module of the function.

    They do in a module that no distribution holds: no version would tell an edit of it.
    """
    top = module_name.partition(".")[0]
    if module_name.startswith(FOLLOWED):
        return True
    if own == ENGINE or top == own:
        return top == own != ENGINE
    return is_loose(top) and source_of(top) is not None


@functools.cache
def _digests(module_name: str, name: str) -> dict[str, str]:
    """The digest of one definition, and of the native sources of its module."""
    module = module_of(module_name)
    assert module is not None
    native = {(file := f"{module_name}:{source}"): source_digest(file) for source in native_sources(module)}
    text, nodes = _read(module_name, name)
    used = {node.id for node in nodes if isinstance(node, ast.Name)} & module.imports.keys()
    if used:  # what it says with the names that its module imports
        text += f"\n{sorted((local, module.imports[local]) for local in used)}"
    return {f"{module_name}.{name}": blake3(text.encode()).hexdigest()} | native


@functools.cache
def _needed(module_name: str, name: str, own: str) -> _Needs:
    """What one definition leads to in the packages that are followed."""
    module = module_of(module_name)
    assert module is not None
    nodes = _read(module_name, name)[1]
    inner = imports_of(module, nodes)
    named = {node.id for node in nodes if isinstance(node, ast.Name)} & module.imports.keys()
    origins = [*inner.values(), *(module.imports[name] for name in named)]
    imported = {origin.partition(".")[0] for several in origins for origin, _ in several}
    looked_for: set[str] = set()
    # Of a name that one method of a class imports for itself, and that another takes from its module, both count.
    local = {name: [*module.imports.get(name, ()), *inner.get(name, ())] for name in module.imports | inner}
    needed = dict.fromkeys(_dependencies(module, nodes, local, own, looked_for))
    return _Needs(tuple(needed), frozenset(imported.union(_loaded_by_name(nodes))), frozenset(looked_for))


@functools.cache
def _read(module_name: str, name: str) -> tuple[str, list[ast.AST]]:
    """One definition as canonical text, and the nodes that count in it."""
    module = module_of(module_name)
    assert module is not None
    nodes: list[ast.AST] = []
    return "\n".join(canonical_code(statement, nodes, module.imports) for statement in module.definitions[name]), nodes


def _dependencies(
    module: Module, nodes: list[ast.AST], local: Imports, own: str, looked_for: set[str]
) -> Iterator[tuple[str, str]]:
    held = {id(node.value) for node in nodes if isinstance(node, ast.Attribute)}
    for node in nodes:
        if isinstance(node, ast.Attribute):
            first, *between = dotted(node.value)
            for origin, attribute in local.get(first, ()):
                path = between if attribute is None else [attribute, *between]
                holders, through = _modules_at(origin, path, own, looked_for)
                yield from through
                yield from ((holder, node.attr) for holder in holders)
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Load):
            if node.id in module.definitions:
                yield module.name, node.id
            for origin, attribute in local.get(node.id, ()):
                if attribute is not None and _is_followed(origin, own):
                    yield origin, attribute
                if id(node) not in held:  # as a value: any of what a module holds may be meant
                    holders, through = _modules_at(origin, [attribute] if attribute else [], own, looked_for)
                    yield from through
                    for holder in holders:
                        yield from _all_of(holder)


def _all_of(module_name: str) -> Iterator[tuple[str, str]]:
    module = module_of(module_name)
    yield from ((module_name, name) for name in ({**module.definitions, **module.imports} if module else ("",)))


def _modules_at(
    module: str, path: list[str], own: str, looked_for: set[str]
) -> tuple[list[str], list[tuple[str, str]]]:
    """The modules to follow that `module.a.b` may stand for, and the imports of packages that lead there."""
    found: list[str] = []
    through: list[tuple[str, str]] = []
    pending, seen = [(module, *path)], set[tuple[str, ...]]()
    while pending:
        place = pending.pop()
        module, *names = place
        if place in seen or not _is_followed(module, own):
            continue
        seen.add(place)
        if not names:
            found.append(module)
            continue
        looked_for |= {module, inner := f"{module}.{names[0]}"}
        if source_of(inner):
            pending.append((inner, *names[1:]))
        elif (holder := module_of(module)) is not None and (origins := holder.imports.get(names[0])):
            through.append((module, names[0]))
            for origin, attribute in origins:
                pending.append((origin, *names[1:]) if attribute is None else (origin, attribute, *names[1:]))
    return found, through


def _loaded_by_name(nodes: list[ast.AST]) -> Iterator[str]:
    """The top-level modules of `import_module("...")`."""
    for node in nodes:
        match node:
            case ast.Call(
                func=ast.Name(id="import_module") | ast.Attribute(attr="import_module"),
                args=[ast.Constant(value=str(name)), *_],
            ):
                yield name.partition(".")[0]
