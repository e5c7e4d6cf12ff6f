"""The key of every task knows the distributions that it imports, and what of the machine its results depend on."""

from __future__ import annotations

import dis
import importlib.metadata
import inspect
import platform
import sys
from collections.abc import Iterator
from types import CodeType, ModuleType
from typing import Any

import pytest
from registered_tasks import registered_tasks

from ss_flow import keys
from ss_flow.closure import Closure, closure_of
from ss_flow.keys import Recipe
from ss_flow.task import Task
from ss_flow.tasks import processor

TASKS = registered_tasks()
OWNERS = importlib.metadata.packages_distributions()
OURS = {"ss_flow", *sys.stdlib_module_names}


def code_objects(value: Any) -> Iterator[tuple[CodeType, dict[str, Any]]]:
    """The compiled code of a function or a class, what is nested in it included, and the globals that it sees."""
    value = value.function if isinstance(value, Task) else inspect.unwrap(value) if callable(value) else value
    if inspect.isfunction(value):
        pending = [value.__code__]
        while pending:
            code = pending.pop()
            yield code, value.__globals__
            pending += [constant for constant in code.co_consts if isinstance(constant, CodeType)]
    elif inspect.isclass(value):
        for member in vars(value).values():
            for part in (member, *(getattr(member, name, None) for name in ("__func__", "fget", "func"))):
                if inspect.isfunction(part) and part.__module__ == value.__module__:
                    yield from code_objects(part)


def top_level(value: Any) -> str:
    """The top-level module of a module, or where something was defined."""
    name = value.__name__ if isinstance(value, ModuleType) else getattr(value, "__module__", None) or ""
    return name.partition(".")[0]


def imported(task: Task[..., Any]) -> dict[str, str]:
    """The modules of others that the compiled code of a task's closure imports or names, and who does."""
    found: dict[str, str] = {}
    for qualified in closure_of(task.function).definitions:
        module, _, name = qualified.rpartition(".")
        for code, known in code_objects(getattr(sys.modules.get(module), name, None)):
            for step in dis.get_instructions(code):
                if step.opname == "IMPORT_NAME":
                    found[step.argval.partition(".")[0]] = qualified
                elif step.opname == "LOAD_GLOBAL" and step.argval in known:
                    found[top_level(known[step.argval])] = qualified
    return {module: by for module, by in found.items() if module and module not in OURS}


def unknown(task: Task[..., Any]) -> dict[str, str]:
    """The modules that a task imports, but whose distributions its key does not know, and who imports them."""
    known = Recipe.of(task).components["packages"]
    return {
        module: by for module, by in imported(task).items() if not known.keys() >= set(OWNERS.get(module, [module]))
    }


@pytest.mark.parametrize("name", TASKS)
def test_the_key_of_a_task_knows_every_distribution_that_its_code_imports(name):
    assert unknown(TASKS[name]) == {}


def test_a_key_that_lacks_a_distribution_is_found_by_that_test(monkeypatch):
    task = TASKS["splat.plan"]
    monkeypatch.setattr(
        keys, "closure_of", lambda function: Closure(closure_of(function).definitions, frozenset({"numpy"}), {})
    )
    assert set(unknown(task)) == {"scipy"}


def test_keys_know_versions_that_change_results():
    packages = {name: Recipe.of(task).components["packages"] for name, task in TASKS.items()}
    assert all(known["numpy"] == importlib.metadata.version("numpy") for known in packages.values())
    assert packages["splat.plan"].keys() == {"python", "numpy", "scipy"}
    assert packages["splat.refine"].keys() >= {"onnx", "onnxruntime", "scipy"}
    assert packages["splat.reconstruct"].keys() >= {"torch", "gsplat"}


@pytest.mark.parametrize("name", TASKS)
def test_a_task_declares_the_instruction_set_where_native_code_picks_its_loops_by_it(name):
    recipe = Recipe.of(TASKS[name])
    expected = set()
    if "onnxruntime" in recipe.components["packages"]:
        expected.add("instruction set")
    if "ss_flow.tasks.gaussians.library.library" in recipe.closure:
        expected.add("rasterizer")
    assert recipe.components["environment"].keys() - {"device", "networks"} == expected


@pytest.fixture
def cpuinfo(monkeypatch, tmp_path):
    """Have the processor be another one."""

    def write(text: str) -> None:
        (tmp_path / "cpuinfo").write_text(text)
        processor.features.cache_clear()

    monkeypatch.setattr(processor, "CPUINFO", tmp_path / "cpuinfo")
    yield write
    processor.features.cache_clear()


AVX512 = "fma avx avx2 avx512f avx512bw avx512dq avx512vl"


@pytest.mark.parametrize(
    ("text", "widest"),
    [
        ("processor\t: 0\nflags\t\t: fpu sse2\n", "baseline"),
        ("flags\t\t: fpu avx avx2 fma\n", "avx2"),
        ("flags\t\t: fpu avx avx2 avx512f\n", "avx"),
        (f"flags\t\t: fpu {AVX512}\n", "avx512"),
        (f"flags\t\t: fpu {AVX512} avx512_vnni\n", "avx512_vnni"),
        ("Features\t: fp asimd asimddp\n", "dotprod"),
        ("nothing\n", "baseline"),
    ],
)
def test_the_widest_instruction_set_is_the_first_whose_features_are_all_there(cpuinfo, text, widest):
    cpuinfo(text)
    assert processor.widest_instruction_set() == widest
    assert processor.widest_instruction_set(["avx2", "baseline"]) == (
        "avx2" if "avx2" in text and "fma" in text else "baseline"
    )


def test_networks_have_other_keys_on_a_processor_of_another_instruction_set(cpuinfo):
    def recipe() -> Recipe:
        return Recipe.of(TASKS["split.embed"])

    cpuinfo("flags : avx avx2 fma\n")
    narrow = recipe()
    cpuinfo(f"flags : {AVX512}\n")
    wide = recipe()
    assert narrow.components["environment"] == {"instruction set": f"{platform.machine()} avx2"}
    assert wide.components["environment"] == {"instruction set": f"{platform.machine()} avx512"}
    assert narrow.digest != wide.digest
