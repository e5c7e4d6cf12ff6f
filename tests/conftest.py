"""What tests share."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from ss_flow.cache.store import Store

sys.path.insert(0, str(Path(__file__).parent / "support"))


@pytest.fixture
def store(tmp_path: Path) -> Store:
    return Store(tmp_path / "store")
