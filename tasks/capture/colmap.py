"""COLMAP's library, as every step that uses it loads it."""

from __future__ import annotations

import contextlib
import functools
import importlib.util
import signal
from collections.abc import Iterator
from types import ModuleType

from ss_flow.errors import InputError

SEED = 0
"""Of whatever the library draws by lot: two runs agree to the bit."""


def has_pycolmap() -> bool:
    """Whether the library is installed; it is not loaded."""
    return importlib.util.find_spec("pycolmap") is not None


@functools.cache
def load_pycolmap() -> ModuleType:
    """The library, quiet but for its errors. Raises InputError when it cannot be loaded."""
    import zlib  # noqa: F401 - pycolmap brings a zlib of its own, which breaks Python's when loaded before it

    # Its logging takes SIGTERM for itself, and would end a run that a cluster's queue stops with a native stack trace.
    try:
        with _action_kept(signal.SIGTERM):
            import pycolmap
    except ImportError as error:
        raise InputError(
            f"pycolmap cannot be loaded ({error}): `pip install pycolmap`, or, on a machine that it is not built for "
            "(Linux on ARM), take a capture with poses and leave --refine-poses out."
        ) from error

    pycolmap.logging.minloglevel = 2
    return pycolmap


@contextlib.contextmanager
def _action_kept(number: int) -> Iterator[None]:
    """What a signal does is in the end what it did before. Unlike Python's `signal`, for any thread."""
    import ctypes

    libc = ctypes.CDLL(None)
    action = ctypes.create_string_buffer(1024)  # a struct sigaction, whose size no header tells here; it is below 200
    libc.sigaction(number, None, action)
    try:
        yield
    finally:
        libc.sigaction(number, action, None)
