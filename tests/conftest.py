"""What tests share."""

from __future__ import annotations

import signal
import sys
from pathlib import Path

import hypothesis
import pytest

from ss_flow.cache.store import Store

# A busy machine is no fault of ours: no test is one of time.
hypothesis.settings.register_profile("untimed", deadline=None)
hypothesis.settings.load_profile("untimed")

# A shell that starts tests in the background has them ignore Ctrl-C, and so would every run that they start.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

sys.path.insert(0, str(Path(__file__).parent / "support"))


@pytest.fixture
def store(tmp_path: Path) -> Store:
    return Store(tmp_path / "store")
