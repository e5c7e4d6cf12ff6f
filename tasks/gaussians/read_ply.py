"""PLY files, read: any columns of vertices, or 3D Gaussians as 3DGS and its followers write them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ss_flow.errors import InputError
from ss_flow.running import warn
from ss_flow.tasks.artifacts import Float32, Gaussians
from ss_flow.tasks.geometry.ply_elements import SCALARS

_NEEDED = (
    *("x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity"),
    *("scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"),
)
_LONGEST_HEADER = 1 << 16


def read_columns(path: Path) -> NDArray[np.void]:
    """The vertices of a binary PLY file as a structured array, mapped from the file and not loaded: [N].

    Raises InputError when the file is no PLY, is not binary little endian, has elements or lists besides scalar vertex
    properties, or does not have the size that its header promises.
    """
    header, start = _header(path)
    words = [line for line in header[1:] if line and line[0] not in ("comment", "obj_info")]
    if words[:1] != [["format", "binary_little_endian", "1.0"]]:
        raise InputError(f"{path.name} should be PLY of the format `binary_little_endian 1.0`.")
    if ["element", "chunk"] in [line[:2] for line in words]:
        raise InputError(
            f"{path.name} is a compressed PLY; unpack it first: `splat-transform {path.name} unpacked.ply`, or export "
            "it from SuperSplat as an uncompressed PLY."
        )
    if len(words) < 2 or words[1][:2] != ["element", "vertex"] or len(words[1]) != 3 or not words[1][2].isdigit():
        raise InputError(f"{path.name} should have `element vertex` and a count as its first element.")
    odd = [line for line in words[2:] if len(line) != 3 or line[0] != "property" or line[1] not in SCALARS]
    if odd:
        raise InputError(f"{path.name} has `{' '.join(odd[0])}` in its header; only scalars of vertices can be read.")
    names = [name for *_, name in words[2:]]
    if len(set(names)) < len(names):
        raise InputError(f"{path.name} has two columns of one name in its header; it is damaged.")
    count, dtype = int(words[1][2]), np.dtype([(name, "<" + SCALARS[kind]) for _, kind, name in words[2:]])
    expected, size = start + count * dtype.itemsize, path.stat().st_size
    if size != expected:
        raise InputError(f"{path.name} has {size} bytes and its header promises {expected}; it is damaged.")
    if not count:
        return np.zeros(0, dtype)
    return np.memmap(path, dtype, "r", start, (count,))


def _header(path: Path) -> tuple[list[list[str]], int]:
    """The words of each line of a PLY file's header, and where the data begin."""
    try:
        with path.open("rb") as stream:
            head = stream.read(_LONGEST_HEADER)
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}.") from None
    end = head.find(b"end_header\n")
    if not head.startswith(b"ply\n") or end < 0:
        raise InputError(f"{path.name} is not a PLY file: it should start with `ply` and have a header of text lines.")
    lines = head[:end].decode("ascii", errors="replace").splitlines()
    return [line.split() for line in lines], end + len(b"end_header\n")


def read_gaussians(path: Path) -> Gaussians:
    """Gaussians of a standard or labelled 3DGS file; ids are 0 and confidences 0 where the file has no labels.

    Every value is that of the file, quaternions of any length too; normals and columns that are not known are left
    out. The degree is that of the file: one with 45 f_rest columns gives degree 3, also where they are 0.
    Warns of a scene that its header says was trained with anti-aliasing (`comment SplatRenderMode: mip`).
    Raises InputError when columns are missing, or the header says that the Gaussians are flat.
    """
    rows = read_columns(path)
    modes = [line[2] for line in _header(path)[0] if line[:2] == ["comment", "SplatRenderMode:"] and len(line) == 3]
    names = set(rows.dtype.names or ())
    rest = sum(name.startswith("f_rest_") for name in names)
    missing = [name for name in (*_NEEDED, *(f"f_rest_{i}" for i in range(rest))) if name not in names]
    if missing == ["scale_2"] or "2dgs" in modes:
        sign = "no scale_2" if missing else "SplatRenderMode"
        raise InputError(f"{path.name} holds flat Gaussians (2DGS: {sign}); a file of 3D Gaussians is needed.")
    if rest not in (0, 9, 24, 45):
        raise InputError(f"{path.name} has {rest} f_rest columns; 3D Gaussians have 0, 9, 24 or 45.")
    if missing:
        raise InputError(f"{path.name} lacks {', '.join(missing)}; a file of 3D Gaussians is needed.")
    if "mip" in modes:
        warn(
            f"{path.name} was trained with anti-aliasing (SplatRenderMode: mip); it is drawn and written as plain "
            "3DGS, in which what is small in a picture looks bolder."
        )

    def gather(columns: Sequence[str]) -> Float32:
        return np.stack([rows[name].astype(np.float32) for name in columns], axis=1)

    def label(name: str) -> Float32:
        return rows[name].astype(np.float32) if name in names else np.zeros(len(rows), np.float32)

    sh = gather(("f_dc_0", "f_dc_1", "f_dc_2"))[:, None]
    if rest:
        higher = gather([f"f_rest_{i}" for i in range(rest)]).reshape(len(rows), 3, rest // 3)
        sh = np.concatenate([sh, higher.transpose(0, 2, 1)], axis=1)
    return Gaussians(
        means=gather("xyz"),
        quaternions=gather(("rot_0", "rot_1", "rot_2", "rot_3")),
        log_scales=gather(("scale_0", "scale_1", "scale_2")),
        opacity_logits=rows["opacity"].astype(np.float32),
        sh=sh,
        instance_id=np.rint(label("instance_id")).astype(np.int32),
        instance_conf=label("instance_conf"),
        part_id=np.rint(label("part_id")).astype(np.int32),
    )
