"""What this machine's processor can do. Native code picks its loops by that, and they round differently."""

from __future__ import annotations

import functools
import platform
from collections.abc import Iterable
from pathlib import Path

_AVX512 = frozenset({"avx512f", "avx512bw", "avx512dq", "avx512vl", "avx2", "fma"})
INSTRUCTION_SETS = {
    "amx": _AVX512 | {"avx512_vnni", "amx_tile", "amx_int8"},
    "avx512_vnni": _AVX512 | {"avx512_vnni"},
    "avx512": _AVX512,
    "avx_vnni": frozenset({"avx2", "fma", "avx_vnni"}),
    "avx2": frozenset({"avx2", "fma"}),
    "avx": frozenset({"avx"}),
    "i8mm": frozenset({"asimddp", "i8mm"}),
    "dotprod": frozenset({"asimddp"}),
    "baseline": frozenset[str](),
}
"""The features that each instruction set takes, as Linux names them; of x86 and of ARM, the widest first."""

CPUINFO = Path("/proc/cpuinfo")


@functools.cache
def features() -> frozenset[str]:
    """The features of the processor, so far as the system tells."""
    if CPUINFO.exists():
        for line in CPUINFO.read_text().splitlines():
            name, _, listed = line.partition(":")
            if name.strip() in ("flags", "Features"):
                return frozenset(listed.split())
    if platform.system() == "Darwin" and platform.machine() == "x86_64":
        return frozenset({"avx", "avx2", "fma"})
    return frozenset()


def widest_instruction_set(among: Iterable[str] = INSTRUCTION_SETS) -> str:
    """The widest instruction set that this processor has, of those named; "baseline" is one of them."""
    named = set(among)
    return next(name for name, needs in INSTRUCTION_SETS.items() if name in named and needs <= features())


def on_this_processor(chosen: str) -> str:
    """An instruction set with its architecture, as it counts in keys: "x86_64 avx512"."""
    return f"{platform.machine()} {chosen}"
