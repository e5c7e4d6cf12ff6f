"""Closures kept in a folder: what `closure_of` says, found again while nothing that it was read from has changed."""

from __future__ import annotations

import importlib
import sys

import pytest

from ss_flow import closure, kept_closures, sources
from ss_flow.closure import closure_of
from ss_flow.kept_closures import kept_closure

STEP = """
from probe import helpers
from probe import late
import numpy

NATIVE_SOURCES = ("loop.cpp",)


def run(x):
    return helpers.double(x) + late.value
"""


@pytest.fixture
def probe(tmp_path, monkeypatch):
    """A package with a task, and a function that gives its kept closure as a new process would."""
    package = tmp_path / "code" / "probe"
    package.mkdir(parents=True)
    (package / "__init__.py").write_text("class late:\n    value = 1\n")
    (package / "helpers.py").write_text("def double(x):\n    return 2 * x\n")
    (package / "loop.cpp").write_text("int loop;")
    (package / "step.py").write_text(STEP)
    monkeypatch.syspath_prepend(str(tmp_path / "code"))

    def run():
        for name in [n for n in sys.modules if n.partition(".")[0] == "probe"]:
            del sys.modules[name]
        importlib.invalidate_caches()
        closure.forget()
        return importlib.import_module("probe.step").run

    run.package, run.folder = package, tmp_path / "closures"
    yield run
    closure.forget()


@pytest.fixture
def walks(monkeypatch):
    """The functions whose closures were worked out."""
    found = []

    def counted(function):
        found.append(function.__qualname__)
        return closure_of(function)

    monkeypatch.setattr(kept_closures, "closure_of", counted)
    return found


def test_a_closure_is_found_again_as_it_was(probe, walks):
    first = kept_closure(probe(), probe.folder)
    again = kept_closure(probe(), probe.folder)
    assert again == first == closure_of(probe())
    assert walks == ["run"] and "probe.step:loop.cpp" in again.definitions


@pytest.mark.parametrize(
    ("file", "text"),
    [
        ("helpers.py", "def double(x):\n    return 3 * x\n"),
        ("step.py", STEP.replace("numpy", "scipy")),
        ("step.py", STEP.replace("+ late", "- late")),
        ("loop.cpp", "int pool;"),
        ("late.py", "value = 2\n"),
    ],
    ids=["a helper", "an import", "itself, at equal size", "a native source", "a module that was not there"],
)
def test_it_is_worked_out_anew_when_what_it_was_read_from_changes(probe, walks, file, text):
    before = kept_closure(probe(), probe.folder)
    (probe.package / file).write_text(text)
    after = kept_closure(probe(), probe.folder)
    assert walks == ["run", "run"]
    assert after == closure_of(probe()) and after != before


def test_a_helper_that_is_gone_is_noticed(probe, walks):
    kept_closure(probe(), probe.folder)
    (probe.package / "step.py").write_text(
        STEP.replace("helpers.double(x)", "x").replace("from probe import helpers", "")
    )
    (probe.package / "helpers.py").unlink()
    assert kept_closure(probe(), probe.folder) == closure_of(probe())


def test_a_helper_of_no_distribution_that_is_there_at_last_is_noticed(probe, walks):
    (probe.package / "step.py").write_text("def run(x):\n    import late_probe\n\n    return late_probe.f(x)\n")
    assert "late_probe" in kept_closure(probe(), probe.folder).modules
    (probe.package.parent / "late_probe.py").write_text("def f(x):\n    return x\n")
    assert "late_probe.f" in kept_closure(probe(), probe.folder).definitions


def test_a_helper_whose_distribution_tells_its_code_no_more_is_noticed(probe, walks, monkeypatch):
    (probe.package / "step.py").write_text("def run(x):\n    import late_probe\n\n    return late_probe.f(x)\n")
    (probe.package.parent / "late_probe.py").write_text("def f(x):\n    return x\n")
    monkeypatch.setattr(sources, "is_distributed", lambda name: True)
    assert "late_probe" in kept_closure(probe(), probe.folder).modules
    monkeypatch.setattr(sources, "is_distributed", lambda name: name != "late_probe")  # an editable one, say
    assert "late_probe.f" in kept_closure(probe(), probe.folder).definitions


def test_a_module_that_became_a_package_is_read_anew(probe, walks):
    (probe.package / "helpers.py").write_text("from .late import factor\n\n\ndef double(x):\n    return factor * x\n")
    (probe.package / "late.py").write_text("factor = 2\n")
    before = kept_closure(probe(), probe.folder)
    (probe.package / "helpers").mkdir()
    (probe.package / "helpers.py").rename(probe.package / "helpers" / "__init__.py")
    (probe.package / "helpers" / "late.py").write_text("factor = 3\n")
    after = kept_closure(probe(), probe.folder)
    assert after == closure_of(probe()) and "probe.helpers.late.factor" in after.definitions
    assert "probe.late.factor" in before.definitions and "probe.late.factor" not in after.definitions


def test_another_python_or_another_analysis_counts(probe, walks, monkeypatch):
    kept_closure(probe(), probe.folder)
    for name in ("python", "analysis"):
        monkeypatch.setitem(kept_closures._SIGNS, name, "another")
        kept_closure(probe(), probe.folder)
    assert walks == ["run"] * 3


@pytest.mark.parametrize(
    "damage", [lambda b: b[:-9], lambda b: b.replace(b"probe", b"prone"), lambda b: b"", lambda b: b"\xff"]
)
def test_a_damaged_file_is_not_believed(probe, walks, damage):
    first = kept_closure(probe(), probe.folder)
    (file,) = probe.folder.iterdir()
    file.write_bytes(damage(file.read_bytes()))
    assert kept_closure(probe(), probe.folder) == first
    assert walks == ["run", "run"]
    assert kept_closure(probe(), probe.folder) == first and walks == ["run", "run"]


def test_a_folder_that_cannot_be_written_does_not_matter(probe, walks):
    probe.folder.write_text("a file")
    assert kept_closure(probe(), probe.folder) == closure_of(probe())


def test_a_store_that_was_moved_away_is_not_there_again_for_what_could_be_kept(probe, tmp_path):
    assert kept_closure(probe(), tmp_path / "moved" / "closures") == closure_of(probe())
    assert not (tmp_path / "moved").exists()
