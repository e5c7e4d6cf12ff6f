"""Modules as they are written: what each defines and imports, read without importing anything."""

from __future__ import annotations

import ast
import functools
import importlib.util
import operator
import sys
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from blake3 import blake3

from ss_flow.at_load import DEFINITIONS, FUNCTIONS, Loading, declared_global, is_written, walk
from ss_flow.cache.files import stamp
from ss_flow.distributions import is_distributed
from ss_flow.errors import ExecutorLost
from ss_flow.loaded_code import EDITED, bound_in, not_as_written

STAR = "*"
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
    """Of compiled code, the digest of its file; "" of a folder that is a package without an `__init__.py`."""


@dataclass
class Module:
    """A module as syntax trees."""

    name: str
    is_package: bool
    definitions: dict[str, list[ast.stmt]] = field(default_factory=dict)
    """The statements that bind each name, or change what it stands for."""
    imports: Imports = field(default_factory=dict)
    stars: tuple[str, ...] = ()
    """The modules that all names are imported from, directly or not."""

    def add(self, name: str, *statements: ast.stmt) -> None:
        """Statements that tell what a name stands for, each once."""
        known = self.definitions.setdefault(name, [])
        known += [statement for statement in statements if statement not in known]


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
_bound: dict[str, tuple[tuple[int, ...], dict[str, list[Any]]]] = {}
"""What their names stood for then, after the stamp of the file; () where the module was still being loaded."""
_outdated: dict[str, str] = {}
"""Modules that are not loaded as they were read, and why, as the end of a sentence. Ours are read as soon as they are
loaded."""


def source_of(name: str) -> Source | None:
    """A module as it is written; None when there is none. It is read once.

    Raises ExecutorLost when it was edited between being loaded and being read, or is not what was loaded.
    """
    if name in _outdated:
        raise ExecutorLost(f"{name} {_outdated[name]}.")
    if name not in _known:
        _bound[name] = _stamp(name), bound_in(name)
        _known[name] = _specification(name), _read(name)
    return _known[name][1]


def read_loaded(packages: tuple[str, ...], loose: bool) -> bool:
    """Read the modules of these packages that are loaded, each as soon as possible after that, whoever asks later.

    loose: also those that no distribution holds. Returns whether any of them is not as it was when it was read last,
    before it was loaded, or loaded again.
    """
    changed = False
    for name in _loaded(packages, loose, len(sys.modules)):
        specification = _specification(name)
        known = _known.get(name)
        if known is not None and known[0] is specification:
            if name not in _outdated and _is_exchanged(name):
                _outdated[name] = EDITED
                changed = True
            continue
        _bound[name] = _stamp(name), bound_in(name)
        try:
            source = _read(name)
            reason = "" if source is None or name.startswith("ss_flow.") else not_as_written(name)
        # Its file has gone, or is no text; who needs it will say so.
        except (OSError, ValueError, SyntaxError, ImportError):
            continue
        changed = changed or (name in _known and _known[name][1] != source)
        _known[name] = specification, source
        _outdated.pop(name, None)
        if reason:
            _outdated[name] = reason
    return changed


def _is_exchanged(name: str) -> bool:
    """Whether what was edited in a module's file was put into the module, which stayed loaded, as IPython's autoreload
    does: which state of the file that was, nobody knows."""
    if name.startswith("ss_flow.") and "IPython" not in sys.modules:
        return False  # it takes time, of so many modules
    source, (read, before), stamp_now = _known[name][1], _bound[name], _stamp(name)
    if source is None or source.path.suffix != ".py" or (read and read == stamp_now):
        return False
    now = bound_in(name)
    exchanged = {one for one in before.keys() | now.keys() if not _are_same(before.get(one), now.get(one))}
    try:
        edited = _read(name)
        if edited is None:
            return False
        if edited.text == source.text:
            _bound[name] = stamp_now, now
        return not exchanged.isdisjoint(_bound_otherwise(source.text, edited.text))
    except (OSError, ValueError, SyntaxError, ImportError):
        return False


def _are_same(before: list[Any] | None, now: list[Any] | None) -> bool:
    if before is None or now is None or len(before) != len(now):
        return False
    return all(map(operator.is_, before, now))


@functools.lru_cache(maxsize=16)
def _bound_otherwise(before: str, after: str) -> frozenset[str]:
    """The names that two texts of a module bind by different statements."""
    bound: list[set[tuple[str, str]]] = []
    for text in (before, after):
        statements = [statement for statement, _ in _top_level(ast.parse(text).body, ())]
        named = ((s, [*_bound_at_top(s), *imports_of(Module("", False), [s])]) for s in statements)
        bound.append({(name, ast.dump(statement)) for statement, names in named for name in names})
    return frozenset(name for name, _ in bound[0] ^ bound[1])


@functools.lru_cache(maxsize=1)
def _loaded(packages: tuple[str, ...], loose: bool, count: int) -> list[str]:
    """The loaded modules to read; they are looked for again only where others are loaded, thousands in all.

    count: of all that are loaded.
    """
    # A copy in one piece: another thread may load a module in the meantime.
    return [name for name in list(sys.modules) if name.startswith(packages) or (loose and is_loose(name))]


def is_loose(name: str) -> bool:
    """Whether a module is neither ours nor Python's own, and no distribution holds it: no version tells of an edit."""
    top = name.partition(".")[0]
    return top != "ss_flow" and not is_distributed(top)


def forget_sources() -> None:
    """Read every module anew the next time."""
    _known.clear()
    _bound.clear()
    _outdated.clear()


def _specification(name: str) -> object:
    return getattr(sys.modules.get(name), "__spec__", None)


def _stamp(name: str) -> tuple[int, ...]:
    """The stamp of a loaded module's file; () where it has none, or is being loaded still."""
    specification: Any = _specification(name)
    if not getattr(specification, "has_location", False) or getattr(specification, "_initializing", False):
        return ()
    try:
        return tuple(stamp(specification.origin))
    except OSError:
        return ()


def _read(name: str) -> Source | None:
    if name == "__main__":  # not the name that it is imported by
        return None
    parent = source_of(package) if (package := name.rpartition(".")[0]) else None
    if parent is not None and not parent.is_package:
        return None  # a name in a module; to look further would import that
    try:
        spec = importlib.util.find_spec(name)
    except (ImportError, ValueError):
        return None
    if spec is None:
        return None
    folders = spec.submodule_search_locations
    if folders and spec.origin is None:  # a folder without an __init__.py
        return Source(Path(next(iter(folders))) / "__init__.py", True, "")
    if spec.origin is None or not spec.has_location:
        return None
    path = Path(spec.origin)
    try:
        content = path.read_bytes()
    except NotADirectoryError:  # it is in a ZIP archive
        loader: Any = spec.loader
        content = loader.get_data(spec.origin)
    text = importlib.util.decode_source(content) if path.suffix == ".py" else blake3(content).hexdigest()
    return Source(path, folders is not None, text)


@functools.cache
def module_of(name: str) -> Module | None:
    """What a module defines and imports at its top level; None when there is none in Python."""
    module = module_without_stars(name)
    if module is None or STAR not in module.imports:
        return module
    imports = {local: list(origins) for local, origins in module.imports.items()}
    stars: dict[str, None] = {}
    pending = [origin for origin, _ in imports.pop(STAR)]
    while pending:
        origin = pending.pop()
        if origin in stars:
            continue
        stars[origin] = None
        if (other := module_without_stars(origin)) is not None:
            pending += [further for further, _ in other.imports.get(STAR, ())]
            for local in {*other.definitions, *other.imports} - {STAR}:
                imports.setdefault(local, []).append((origin, local))
    return replace(module, imports=imports, stars=tuple(stars))


@functools.cache
def module_without_stars(name: str) -> Module | None:
    """The same, with `from ... import *` as the import of a name "*"."""
    source = source_of(name)
    if source is None or source.path.suffix != ".py":  # compiled
        return None
    module = Module(name, source.is_package)
    statements = list(_top_level(ast.parse(source.text, str(source.path)).body, ()))
    for statement, tests in statements:
        nodes = walk(statement) if isinstance(statement, _BLOCKS) else (statement,)
        for name, origins in imports_of(module, nodes).items():
            module.imports.setdefault(name, []).extend(origins)
            if tests:  # which of several it is
                module.add(name, *tests)
    imported = {local: origins[0][0].partition(".")[0] for local, origins in module.imports.items()}
    bound = {*imported, *(name for statement, _ in statements for name in _bound_at_top(statement))}
    if "global" in source.text:  # a look at every function takes as long as all else here
        functions = (statement for statement, _ in statements if isinstance(statement, FUNCTIONS))
        bound.update(*map(declared_global, functions))
    loading = Loading([statement for statement, _ in statements], imported, name.partition(".")[0])
    for statement, tests in statements:
        changed = bound.intersection(loading.changed(statement))
        for local in dict.fromkeys([*_bound_at_top(statement), *sorted(changed)]):
            module.add(local, *tests, statement)
    return module


def _top_level(body: list[ast.stmt], tests: tuple[ast.stmt, ...]) -> Iterator[tuple[ast.stmt, tuple[ast.stmt, ...]]]:
    """The statements of a module, those under `if` and `try` included, each with the tests that it stands under.

    What only type checkers see is not among them.
    """
    for statement in body:
        if isinstance(statement, ast.If):
            if ast.unparse(statement.test).rpartition(".")[2] == "TYPE_CHECKING":
                yield from _top_level(statement.orelse, tests)
            else:
                test = ast.copy_location(ast.Expr(statement.test), statement)
                yield test, tests
                yield from _top_level([*statement.body, *statement.orelse], (*tests, test))
        elif isinstance(statement, ast.Try | ast.TryStar):
            yield from _top_level(statement.body, tests)
            for handler in statement.handlers:
                caught = [ast.copy_location(ast.Expr(handler.type), handler)] if handler.type else []
                yield from _top_level(handler.body, (*tests, *caught))
            yield from _top_level([*statement.orelse, *statement.finalbody], tests)
        else:
            yield statement, tests


def _bound_at_top(statement: ast.stmt) -> list[str]:
    """The names that a statement binds in its module, `:=` included."""
    if isinstance(statement, DEFINITIONS):
        return _bound_names(statement)
    return [*_bound_names(statement), *(n.target.id for n in walk(statement) if isinstance(n, ast.NamedExpr))]


def _bound_names(statement: ast.AST) -> list[str]:
    match statement:
        case ast.FunctionDef() | ast.AsyncFunctionDef() | ast.ClassDef():
            return [statement.name]
        case ast.Assign():
            return [n.id for target in statement.targets for n in walk(target) if isinstance(n, ast.Name)]
        case ast.AnnAssign(target=ast.Name(id=name)) | ast.AugAssign(target=ast.Name(id=name)):
            return [name]
        case ast.MatchAs(name=str(name)) | ast.MatchStar(name=str(name)) | ast.MatchMapping(rest=str(name)):
            return [name]
        case _ if isinstance(statement, _BLOCKS):
            inner = [name for child in walk(statement) if child is not statement for name in _bound_names(child)]
            return [*inner, *(n.id for n in walk(statement) if isinstance(n, ast.Name) and is_written(n))]
    return []


_BLOCKS = (ast.For, ast.AsyncFor, ast.While, ast.With, ast.AsyncWith, ast.Match)


def imports_of(module: Module, nodes: Iterable[ast.AST]) -> Imports:
    """What these nodes of a module import, relative imports resolved, by local name."""
    found: Imports = {}
    for node in nodes:
        if isinstance(node, ast.Import):
            for alias in node.names:
                top = alias.name.partition(".")[0]  # `import a.b` binds a
                found.setdefault(alias.asname or top, []).append((alias.name if alias.asname else top, None))
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
