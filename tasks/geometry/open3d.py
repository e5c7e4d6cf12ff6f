"""Open3D, imported late: it takes seconds, and needs system libraries that a minimal machine may lack."""

from __future__ import annotations

import ctypes
import functools
import importlib
import sys
from types import ModuleType
from typing import Any

from ss_flow.errors import InputError

_DRAWN_BY_PLOTLY = ("get_plotly_fig", "draw_plotly", "draw_plotly_server")


@functools.cache
def load_open3d() -> ModuleType:
    """The `open3d` module.

    Its Linux build links libusb (for depth cameras we never open), which small systems lack; the one that the package
    `libusb_package` carries is loaded first, so that the linker finds it by name. Its pictures in notebooks bring Dash,
    Plotly and IPython, half of what loading it takes: they are loaded when one is drawn.

    Raises InputError when it, or a system library, is missing all the same.
    """
    late = ModuleType("open3d.visualization.draw_plotly")
    vars(late).update({name: functools.partial(_draw_late, late, name) for name in _DRAWN_BY_PLOTLY})
    sys.modules.setdefault(late.__name__, late)
    try:
        if sys.platform == "linux":
            _load_libusb()
        return importlib.import_module("open3d")
    except ModuleNotFoundError as error:
        raise InputError(f"open3d cannot be loaded ({error}): install ss-flow again.") from error
    except (ImportError, OSError) as error:
        raise InputError(
            f"open3d cannot be loaded ({error}); on Debian or Ubuntu install its libraries with "
            "`apt-get install libgl1 libegl1 libusb-1.0-0 libgomp1`."
        ) from error


def _load_libusb() -> None:
    try:
        ctypes.CDLL("libusb-1.0.so.0", mode=ctypes.RTLD_GLOBAL)
    except OSError:
        import libusb_package

        ctypes.CDLL(str(libusb_package.get_library_path()), mode=ctypes.RTLD_GLOBAL)


def _draw_late(late: ModuleType, name: str, *args: Any, **options: Any) -> Any:
    if sys.modules.get(late.__name__) is late:
        del sys.modules[late.__name__]
    return getattr(importlib.import_module(late.__name__), name)(*args, **options)
