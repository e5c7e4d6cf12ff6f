"""A store that nobody has used for hours."""

from __future__ import annotations

import os
import time
from pathlib import Path


def age_all(store: Path, hours: float = 2.0) -> None:
    """Make everything in a store's folder look last written so long ago."""
    used = time.time() - hours * 3600
    for path in store.rglob("*"):
        os.utime(path, (used, used))
