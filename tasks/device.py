"""Whether tasks compute on CUDA: what was asked for, and whether there is a device.

`SS_FLOW_DEVICE` says "cpu", "cuda" or nothing: then CUDA is taken where all that it needs is there.
"""

from __future__ import annotations

import ctypes
import functools
import os

from ss_flow.errors import InputError

VARIABLE = "SS_FLOW_DEVICE"
PROCESS_BYTES = 1_500_000_000
"""Memory of a device for each process that computes there: they held about .9 GB each (docs/device.md)."""


@functools.cache
def wanted() -> str:
    """ "cpu", "cuda" or "" for whatever is there. Raises InputError when something else was asked for."""
    asked = os.environ.get(VARIABLE, "")
    if asked not in ("", "cpu", "cuda"):
        raise InputError(f"{VARIABLE} must be cpu, cuda or empty, not {asked!r}.")
    return asked


@functools.cache
def has_device() -> bool:
    """Whether there is a CUDA device with a driver, found without a library that takes long to import."""
    try:
        driver = ctypes.CDLL("libcuda.so.1")
    except OSError:
        return False
    return bool(driver.cuInit(0) == 0)


def processes_with_room() -> int:
    """How many processes may compute on the device side by side: one at least, as many as its memory is enough for."""
    driver, number, size = ctypes.CDLL("libcuda.so.1"), ctypes.c_int(), ctypes.c_size_t()
    driver.cuInit(0)
    driver.cuDeviceGet(ctypes.byref(number), 0)
    driver.cuDeviceTotalMem_v2(ctypes.byref(size), number)
    return max(1, size.value // PROCESS_BYTES)
