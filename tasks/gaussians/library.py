"""The native library: finds the build that suits this machine's processor and declares its C interface."""

from __future__ import annotations

import ctypes
import functools
import hashlib
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ss_flow.errors import InputError
from ss_flow.tasks.processor import widest_instruction_set

_FOLDER = Path(__file__).parent

_INT, _INT32, _INT64, _DOUBLE, _FLOAT, _POINTER = (
    ctypes.c_int,
    ctypes.c_int32,
    ctypes.c_int64,
    ctypes.c_double,
    ctypes.c_float,
    ctypes.c_void_p,
)

NATIVE_SOURCES = (
    "native/binning.h", "native/blending.h", "native/harmonics.h", "native/lanes.h", "native/losses.cpp",
    "native/parallel.h", "native/patchmatch.cpp", "native/projection.h", "native/rasterizer.cpp", "native/rows.h",
    "native/scene.h", "native/votes.cpp", "native/workspace.h",
)  # fmt: skip
"""What the results depend on besides this module: its digests count in the keys of the tasks that use it.

A library that was built from others is refused, or what an old build computes would be kept under new keys."""


class Scene(ctypes.Structure):
    """`Scene` of native/scene.h."""

    _fields_ = (
        ("count", _INT64),
        *((name, _POINTER) for name in ("means", "quaternions", "log_scales", "opacity_logits", "sh", "labels", "ids")),
        *((name, _INT32) for name in ("sh_coefficients", "sh_degree", "num_labels", "width", "height")),
        *((name, _DOUBLE) for name in ("fx", "fy", "cx", "cy")),
        ("borders", _DOUBLE * 4),
        ("world_to_camera", _DOUBLE * 12),
        ("near_plane", _DOUBLE),
        ("background", _FLOAT * 3),
    )


class Images(ctypes.Structure):
    """`Images` of native/scene.h."""

    _fields_ = tuple(
        (name, _POINTER) for name in ("rgb", "alpha", "depth", "masks", "mismatch", "top", "radii", "strongest")
    )


class Gradients(ctypes.Structure):
    """`Gradients` of native/scene.h."""

    _fields_ = tuple(
        (name, _POINTER)
        for name in ("means", "quaternions", "log_scales", "opacity_logits", "sh", "centers", "background")
    )


class Learnt(ctypes.Structure):
    """`Learnt` of native/scene.h."""

    _fields_ = (
        *((name, _POINTER) for name in ("value", "gradient", "first", "second", "paces")),
        *((name, _INT64) for name in ("width", "active", "head")),
        *((name, _DOUBLE) for name in ("head_rate", "rate")),
    )


class StereoPhoto(ctypes.Structure):
    """`StereoPhoto` of native/patchmatch.cpp."""

    _fields_ = (
        *((name, _POINTER) for name in ("quads", "usable", "inverse_depth")),
        *((name, _INT32) for name in ("width", "height")),
        *((name, _FLOAT * count) for name, count in (("a", 9), ("b", 3), ("back_a", 9), ("back_b", 3))),
    )


class StereoProblem(ctypes.Structure):
    """`StereoProblem` of native/patchmatch.cpp."""

    _fields_ = (
        *((name, _POINTER) for name in ("quads", "others", "planes", "cost")),
        *((name, _INT32) for name in ("width", "height", "count", "best", "radius", "step", "turns")),
        ("seed", ctypes.c_uint32),
        *((name, _FLOAT) for name in ("min_inverse", "max_inverse", "max_slope")),
        *((name, _FLOAT) for name in ("gray_scale", "smoothness", "smooth_scale", "consistency")),
    )


class VotingView(ctypes.Structure):
    """`VotingView` of native/votes.cpp."""

    _fields_ = (
        *((name, _POINTER) for name in ("depth", "mask", "rows", "columns")),
        *((name, _INT32) for name in ("width", "height", "depth_width", "number")),
        *((name, _DOUBLE) for name in ("fx", "fy", "cx", "cy")),
        ("world_to_camera", _DOUBLE * 12),
        *((name, _DOUBLE) for name in ("tolerance", "share")),
    )


_SCENE, _IMAGES, _GRADIENTS, _LEARNT, _PROBLEM, _VIEW = (
    ctypes.POINTER(structure) for structure in (Scene, Images, Gradients, Learnt, StereoProblem, VotingView)
)
_INTERFACE: dict[str, tuple[Any, list[Any]]] = {
    "ss_workspace": (_POINTER, []),
    "ss_workspace_free": (None, [_POINTER]),
    "ss_entries": (_INT64, [_POINTER]),
    "ss_rasterize": (_INT, [_POINTER, _SCENE, _IMAGES, _INT]),
    "ss_rasterize_backward": (_INT, [_POINTER, _SCENE, _IMAGES, _IMAGES, _GRADIENTS, _INT]),
    "ss_shares": (_INT, [_POINTER, _SCENE, _POINTER, ctypes.POINTER(_INT64), _INT]),
    "ss_take_shares": (None, [*[_POINTER] * 4]),
    "ss_photometric": (_INT, [_POINTER, *[_INT] * 3, *[_POINTER] * 3, _FLOAT, _POINTER, _POINTER, _INT]),
    "ss_surface_loss": (_INT, [_INT64, *[_POINTER] * 9, _FLOAT, _FLOAT, _INT, *[_POINTER] * 3, _INT]),
    "ss_adam": (_INT, [_INT64, _INT, _LEARNT, _INT64, _DOUBLE, _INT]),
    "ss_patchmatch": (_INT, [_PROBLEM]),
    "ss_vote": (None, [_VIEW, _INT64, *[_POINTER] * 4]),
}
"""What each function returns and takes."""

BUILDS = ("avx512", "avx2", "baseline")
"""The instruction sets that the library is built for (on other processors than x86, the last one alone)."""


@functools.cache
def instruction_set() -> str:
    """The widest instruction set that this processor has and the library was built for.

    Raises InputError when the library is not built, or was built from other sources.
    """
    built = [name for name in BUILDS if _place(name).exists()]
    if "baseline" not in built:
        raise InputError(
            f"The CPU rasterizer is not built in {_FOLDER}; install the package again with a C++17 compiler at hand."
        )
    chosen = widest_instruction_set(built)
    library(chosen)
    return chosen


@functools.cache
def library(name: str | None = None) -> Any:
    """The native library, opened; name: an instruction set, by default the processor's widest.

    Raises InputError when it was built from other sources than those that count in keys.
    """
    if name is None:
        return library(instruction_set())
    lib = ctypes.CDLL(str(_place(name)))
    if _built_from(lib) != sources_digest():
        raise InputError(
            f"The CPU rasterizer {_place(name)} was built from other C++ sources than those in {_FOLDER / 'native'}; "
            "install the package again."
        )
    for function, (gives, takes) in _INTERFACE.items():
        declared = getattr(lib, function)
        declared.restype, declared.argtypes = gives, takes
    return lib


def sources_digest() -> str:
    """The digest of the C++ sources beside this module; setup.py writes the same one into what it builds."""
    digests = {Path(name).name: hashlib.sha256((_FOLDER / name).read_bytes()).hexdigest() for name in NATIVE_SOURCES}
    return hashlib.sha256(" ".join(f"{name} {digests[name]}" for name in sorted(digests)).encode()).hexdigest()


def _built_from(lib: ctypes.CDLL) -> str:
    """The digest of the sources that an opened library was built from; "" where it does not tell."""
    try:
        tell = lib.ss_sources
    except AttributeError:  # built before it told
        return ""
    tell.restype = ctypes.c_char_p
    return str(tell().decode())


def _place(name: str) -> Path:
    return _FOLDER / f"_rasterizer_{name}.so"


class Workspace:
    """The native memory of a rendering and of the losses, reused by the next ones; for one thread at a time.

    A pass can run backward only until another pass renders in its workspace.
    """

    def __init__(self) -> None:
        self._free = library().ss_workspace_free  # at the interpreter's end there is no `library` any more
        self.handle = library().ss_workspace()
        if self.handle is None:
            raise MemoryError("not enough memory for a rendering")
        self.turn = 0
        """How many passes have rendered in it."""

    def __del__(self) -> None:
        if getattr(self, "handle", None) is not None:
            self._free(self.handle)


_START = ctypes.c_char * 0


def address(array: NDArray[np.float32] | NDArray[np.int32] | None) -> int | None:
    """Where a C-contiguous array lies, None for None."""
    if array is None:
        return None
    if not array.flags.writeable:
        return array.ctypes.data
    # A step of training asks fifty times, and NumPy's own answer takes three times as long.
    return ctypes.addressof(_START.from_buffer(array))  # type: ignore[arg-type]
