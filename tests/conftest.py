"""What tests share."""

from __future__ import annotations

import sys
from pathlib import Path

import hypothesis
import pytest

from ss_flow.cache.store import Store

# A busy machine is no fault of ours: no test is one of time.
hypothesis.settings.register_profile("untimed", deadline=None)
hypothesis.settings.load_profile("untimed")

sys.path.insert(0, str(Path(__file__).parent / "support"))


@pytest.fixture
def store(tmp_path: Path) -> Store:
    return Store(tmp_path / "store")
