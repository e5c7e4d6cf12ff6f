"""Open3D, imported late: it takes seconds, and needs system libraries that a minimal machine may lack."""

from __future__ import annotations

import ctypes
import functools
import importlib
import sys
from types import ModuleType

from ss_flow.errors import InputError


@functools.cache
def load_open3d() -> ModuleType:
    """The `open3d` module.

    Its Linux build links libusb (for depth cameras we never open), which small systems lack; the one that the package
    `libusb_package` carries is loaded first, so that the linker finds it by name.

    Raises InputError when a system library is missing all the same.
    """
    if sys.platform == "linux":
        try:
            ctypes.CDLL("libusb-1.0.so.0", mode=ctypes.RTLD_GLOBAL)
        except OSError:
            import libusb_package

            ctypes.CDLL(str(libusb_package.get_library_path()), mode=ctypes.RTLD_GLOBAL)
    try:
        return importlib.import_module("open3d")
    except (ImportError, OSError) as error:
        raise InputError(
            f"open3d cannot be loaded ({error}); on Debian or Ubuntu install its libraries with "
            "`apt-get install libgl1 libegl1 libusb-1.0-0 libgomp1`."
        ) from error
