"""Where a store is, as text."""

from __future__ import annotations

from pathlib import Path

from ss_flow.cache.store import Store


def open_store(location: str | Path) -> Store:
    """The store in a folder, created when absent.

    Raises OSError when the folder cannot be created.
    """
    return Store(Path(location))
