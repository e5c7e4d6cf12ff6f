"""The native library's Python side."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from ss_flow.closure import code_closure
from ss_flow.tasks.gaussians import library
from ss_flow.tasks.splat.reconstruct import reconstruct

FOLDER = Path(library.__file__).parent


def test_every_native_source_counts_in_the_keys_of_training():
    listed = {path.relative_to(FOLDER).as_posix() for path in (FOLDER / "native").iterdir()}
    assert set(library.NATIVE_SOURCES) == listed
    closure = code_closure(reconstruct.function)
    assert all(f"{library.__name__}:{source}" in closure for source in listed)


def test_without_a_compiler_the_installation_ends_with_one_sentence(tmp_path):
    root = Path(__file__).parents[3]
    command = [sys.executable, str(root / "setup.py"), "-q", "build_ext", "--build-lib", str(tmp_path)]
    done = subprocess.run(command, cwd=root, env={"PATH": str(tmp_path)}, capture_output=True, text=True)
    assert done.returncode != 0
    assert done.stderr.strip().splitlines()[-1].startswith("ss-flow needs a C++17 compiler")
    assert not list(tmp_path.rglob("*.so"))
