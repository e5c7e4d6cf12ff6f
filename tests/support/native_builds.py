"""Which builds of the native library can be opened here."""

from __future__ import annotations

import pytest

from ss_flow.tasks.gaussians import library
from ss_flow.tasks.processor import INSTRUCTION_SETS, features


def skip_without(name: str) -> None:
    """Skip a test of an instruction set that the processor lacks, or that the library is not built for: an emulated ARM
    shows the features of the x86 below it."""
    if not INSTRUCTION_SETS[name] <= features() or not library._place(name).exists():
        pytest.skip(f"this processor has no {name}")
