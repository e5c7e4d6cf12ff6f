"""The native library's Python side."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from ss_flow.closure import closure_of
from ss_flow.errors import InputError
from ss_flow.keys import Recipe
from ss_flow.tasks.gaussians import library
from ss_flow.tasks.splat.reconstruct import reconstruct

FOLDER = Path(library.__file__).parent


def test_every_native_source_counts_in_the_keys_of_training():
    listed = {path.relative_to(FOLDER).as_posix() for path in (FOLDER / "native").iterdir()}
    assert set(library.NATIVE_SOURCES) == listed
    closure = closure_of(reconstruct.function).definitions
    assert all(f"{library.__name__}:{source}" in closure for source in listed)


def test_without_a_compiler_the_installation_ends_with_one_sentence(tmp_path):
    root = Path(__file__).parents[3]
    command = [sys.executable, str(root / "setup.py"), "-q", "build_ext", "--build-lib", str(tmp_path)]
    done = subprocess.run(command, cwd=root, env={"PATH": str(tmp_path)}, capture_output=True, text=True)
    assert done.returncode != 0
    assert done.stderr.strip().splitlines()[-1].startswith("ss-flow needs a C++17 compiler")
    assert not list(tmp_path.rglob("*.so"))


def test_on_windows_the_installation_ends_before_a_compiler_is_asked_for():
    root = Path(__file__).parents[3]
    loaded = "import os, runpy; from setuptools.command import bdist_wheel, build_ext\n"
    program = loaded + "os.name = 'nt'; runpy.run_path('setup.py')"
    done = subprocess.run([sys.executable, "-P", "-c", program], cwd=root, capture_output=True, text=True)
    assert done.returncode != 0
    assert done.stderr == "ss-flow runs on Linux and macOS; on Windows use it inside WSL.\n"


@pytest.fixture
def copied(tmp_path, monkeypatch):
    """The library and its sources in another folder, where they may be changed."""
    remembered = (library.library, library.instruction_set)
    for path in (*FOLDER.glob("_rasterizer_*.so"), *(FOLDER / name for name in library.NATIVE_SOURCES)):
        place = tmp_path / path.relative_to(FOLDER)
        place.parent.mkdir(exist_ok=True)
        shutil.copy(path, place)
    monkeypatch.setattr(library, "_FOLDER", tmp_path)
    for function in remembered:
        function.cache_clear()
    yield tmp_path
    for function in remembered:
        function.cache_clear()


def test_what_was_built_from_the_sources_is_opened(copied):
    assert library.library().ss_sources() == library.sources_digest().encode()


@pytest.mark.parametrize("name", ["blending.h", "losses.cpp"])
def test_a_source_that_changed_since_the_build_is_refused_before_there_is_a_key(copied, name):
    source = copied / "native" / name
    source.write_text(source.read_text() + "\n")
    for refused in (library.library, lambda: library.library("baseline"), lambda: Recipe.of(reconstruct)):
        with pytest.raises(
            InputError, match=r"was built from other C\+\+ sources than those in .*; install the package"
        ):
            refused()


def test_a_library_that_does_not_tell_its_sources_is_refused(copied):
    for path in copied.glob("_rasterizer_*.so"):
        path.write_bytes(path.read_bytes().replace(b"ss_sources", b"ss_unknown"))
    with pytest.raises(InputError, match="install the package again"):
        library.library()


def test_a_library_that_is_not_there_is_refused_in_one_sentence(copied):
    for path in copied.glob("_rasterizer_*.so"):
        path.unlink()
    with pytest.raises(InputError, match=r"not built in .*; install the package again with a C"):
        library.instruction_set()
