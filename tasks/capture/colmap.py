"""COLMAP's library, as every step that uses it loads it."""

from __future__ import annotations

import functools
from types import ModuleType


@functools.cache
def load_pycolmap() -> ModuleType:
    """The library, quiet but for its errors."""
    import zlib  # noqa: F401 - pycolmap brings a zlib of its own, which breaks Python's when loaded before it

    import pycolmap

    pycolmap.logging.minloglevel = 2
    return pycolmap
