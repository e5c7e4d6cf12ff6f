"""The four floors, and the order of the rooms on the third: imports go only downwards."""

from __future__ import annotations

import ast
import re
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
FLOORS = {"cache": "ss_flow.cache", "ss_flow": "ss_flow", "tasks": "ss_flow.tasks", "flows": "ss_flow.flows"}
ORDER = list(FLOORS)
ROOMS = (
    {"packed"},
    {"artifacts", "ranges", "unread", "words", "processor", "device"},
    {"geometry"},
    {"models", "gaussians", "masks"},
    {"capture"},
    {"split"},
    {"splat"},
    {"semantics"},
    {"evaluate", "deliver"},
    {"edit"},
)
"""The folders of `tasks`, in the order in which they may know of each other; those of one line know nothing of it."""
LATE = {f"ss_flow.tasks.gaussians.{name}" for name in ("autograd", "cuda", "torch_backend", "torch_render")}
"""Modules that cannot be defined without torch, and so are imported inside functions only."""
HEAVY = {"torch", "cv2", "scipy", "open3d", "onnxruntime", "onnx", "pycolmap", "zarr", "matplotlib", "jinja2"}
HEAVY |= {"pi_heif", "dask", "distributed", "obstore", "viser", "rerun", "IPython"}


def floor_of(module: str) -> str | None:
    """The floor that a module stands on; the longest prefix wins."""
    for folder, package in sorted(FLOORS.items(), key=lambda item: -len(item[1])):
        if module == package or module.startswith(package + "."):
            return folder
    return None


def test_every_package_is_installed():
    listed = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["packages"]
    found = [
        ".".join((FLOORS[floor], *place.parent.relative_to(ROOT / floor).parts))
        for floor in FLOORS
        for place in (ROOT / floor).rglob("__init__.py")
    ]
    assert sorted(listed) == sorted(found)


@pytest.mark.parametrize(
    "package",
    [place.parent for floor in ("tasks", "flows") for place in sorted((ROOT / floor).rglob("__init__.py"))],
    ids=lambda package: str(package.relative_to(ROOT)),
)
def test_a_package_that_says_what_its_modules_are_names_them_all(package):
    said = ast.get_docstring(ast.parse((package / "__init__.py").read_text()))
    if said is None or "`" not in said:
        assert package.name in ("cli", "generated", "view")
        return
    modules = {place.stem for place in package.glob("*.py")} - {"__init__"}
    inner = {place.parent.name for place in package.glob("*/__init__.py")}
    named = set(re.findall(r"`(\w+)`", said))
    assert modules | inner <= named


def imported(tree: ast.AST):
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            yield node.module


SOURCES = [(folder, path) for folder in FLOORS for path in sorted((ROOT / folder).rglob("*.py"))]


@pytest.mark.parametrize(("folder", "path"), SOURCES, ids=[str(p.relative_to(ROOT)) for _, p in SOURCES])
def test_a_module_imports_only_from_its_own_floor_and_those_below(folder, path):
    above = ORDER[ORDER.index(folder) + 1 :]
    found = [m for m in imported(ast.parse(path.read_text())) if floor_of(m) in above]
    assert not found, f"{path.name} on floor {folder} imports {found}"


def room_of(module: str) -> int | None:
    """The place of a module of `tasks` in the order of the rooms; None for other modules."""
    if not module.startswith("ss_flow.tasks."):
        return None
    return next(i for i, rooms in enumerate(ROOMS) if module.split(".")[2] in rooms)


def test_a_room_of_tasks_knows_only_those_before_it():
    wrong = []
    for path in sorted((ROOT / "tasks").rglob("*.py")):
        own = ".".join(("ss_flow", *path.relative_to(ROOT).with_suffix("").parts))
        if own == "ss_flow.tasks.__init__":
            continue
        others = {m for m in imported(ast.parse(path.read_text())) if own.split(".")[2] != (m.split(".") + [""] * 2)[2]}
        wrong += [f"{own} imports {m}" for m in others if (room := room_of(m)) is not None and room >= room_of(own)]
    assert not wrong


@pytest.mark.parametrize(("folder", "path"), SOURCES, ids=[str(p.relative_to(ROOT)) for _, p in SOURCES])
def test_no_module_imports_a_heavy_library_when_it_is_imported(folder, path):
    tree = ast.parse(path.read_text())
    top = ast.Module([n for n in tree.body if isinstance(n, ast.Import | ast.ImportFrom)], [])
    heavy = [m for m in imported(top) if m.partition(".")[0] in HEAVY or m in LATE]
    if f"{FLOORS[folder]}.{'.'.join(path.relative_to(ROOT / folder).with_suffix('').parts)}" not in LATE:
        assert not heavy, f"{path.name} imports {heavy} at its top"
