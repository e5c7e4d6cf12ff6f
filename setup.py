"""Builds the CPU rasterizer: one plain shared object for each instruction set, opened with ctypes at run time."""

from __future__ import annotations

import hashlib
import os
import platform
import shutil
import subprocess
from pathlib import Path

from setuptools import Extension, setup
from setuptools.command.bdist_wheel import bdist_wheel
from setuptools.command.build_ext import build_ext

if os.name == "nt":
    raise SystemExit("ss-flow runs on Linux and macOS; on Windows use it inside WSL.")

NATIVE = Path("tasks/gaussians/native")
SOURCES, HEADERS = sorted(NATIVE.glob("*.cpp")), sorted(NATIVE.glob("*.h"))
COMMON = [
    "-std=c++17",
    "-O3",
    "-fPIC",
    "-shared",
    "-pthread",
    "-Wno-psabi",
    "-fno-math-errno",
    "-fno-trapping-math",
    "-fvisibility=default",
]
X86 = {
    "baseline": [],
    "avx2": ["-mavx2", "-mfma"],
    "avx512": ["-mavx512f", "-mavx512bw", "-mavx512dq", "-mavx512vl", "-mfma", "-mprefer-vector-width=512"],
}
INSTRUCTION_SETS = X86 if platform.machine().lower() in ("x86_64", "amd64") else {"baseline": []}


def compiler() -> list[str]:
    """The C++ compiler's command; ends the installation where there is none."""
    for name in (os.environ.get("CXX"), "c++", "g++", "clang++"):
        if name and shutil.which(name.split()[0]):
            return name.split()
    raise SystemExit(
        "ss-flow needs a C++17 compiler for its CPU rasterizer and found none: install one "
        "(Debian and Ubuntu: apt install g++; Fedora: dnf install gcc-c++; macOS: xcode-select --install; "
        "conda: conda install -c conda-forge cxx-compiler), or install a released wheel of ss-flow, which needs none."
    )


def sources_digest() -> str:
    """As `sources_digest` of tasks/gaussians/library.py finds it when it opens what is built here."""
    digests = {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in (*SOURCES, *HEADERS)}
    return hashlib.sha256(" ".join(f"{name} {digests[name]}" for name in sorted(digests)).encode()).hexdigest()


class BuildSharedObjects(build_ext):
    """Compiles each extension to a shared object without a Python ABI."""

    def get_ext_filename(self, fullname: str) -> str:
        return os.path.join(*fullname.split(".")) + ".so"

    def build_extension(self, ext: Extension) -> None:
        target = Path(self.get_ext_fullpath(ext.name))
        target.parent.mkdir(parents=True, exist_ok=True)
        # Replaced by a rename: a process that has the old object open keeps it.
        fresh = target.with_suffix(f".{os.getpid()}.tmp")
        more = os.environ.get("CXXFLAGS", "").split()
        told = f'-DSS_SOURCES="{sources_digest()}"'
        command = [*compiler(), *COMMON, *ext.extra_compile_args, *more, told, *ext.sources, "-o", str(fresh)]
        try:
            subprocess.run(command, check=True)
            fresh.replace(target)
        except subprocess.CalledProcessError:
            fresh.unlink(missing_ok=True)
            raise SystemExit(
                f"ss-flow's CPU rasterizer did not compile with `{command[0]}`: "
                "GCC 9 or Clang 12, or newer, does (set CXX to choose one)."
            ) from None


class PlainWheel(bdist_wheel):
    """Tags the wheel for the platform and for every Python 3."""

    def finalize_options(self) -> None:
        super().finalize_options()
        self.root_is_pure = False

    def get_tag(self) -> tuple[str, str, str]:
        return "py3", "none", super().get_tag()[2]


setup(
    ext_modules=[
        Extension(
            f"ss_flow.tasks.gaussians._rasterizer_{name}",
            sources=[str(path) for path in SOURCES],
            depends=[str(path) for path in HEADERS],
            extra_compile_args=flags,
            language="c++",
        )
        for name, flags in INSTRUCTION_SETS.items()
    ],
    cmdclass={"build_ext": BuildSharedObjects, "bdist_wheel": PlainWheel},
)
