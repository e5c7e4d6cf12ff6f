"""PLY files of Gaussians and of labelled points, written and read.

Gaussians are kept as 3DGS viewers expect them: binary little endian, float32; colour coefficients channel by channel,
and none above the degree of the Gaussians: f_rest has 0, 9, 24 or 45 columns. The labelled form adds three float32
columns at the end of each row, which viewers ignore or show as extra columns. Rows are written in blocks, so that a
scene is never in memory twice.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ss_flow.errors import InputError
from ss_flow.tasks.artifacts import EditedScene, Float32, Gaussians, PointCloud, PointLabels, PointParts

_HEAD = ("x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2")
_TAIL = ("opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3")
_LABELS = ("instance_id", "instance_conf", "part_id")
_COLORS = ("red", "green", "blue")
_RENDER_MODE = "SplatRenderMode: default"
_ROWS_A_BLOCK = 65_536
_LONGEST_HEADER = 1 << 16
_TYPES = {
    **{"char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "<i2", "int16": "<i2"},
    **{"ushort": "<u2", "uint16": "<u2", "int": "<i4", "int32": "<i4", "uint": "<u4", "uint32": "<u4"},
    **{"float": "<f4", "float32": "<f4", "double": "<f8", "float64": "<f8"},
}
_NAMES = {"f4": "float", "u1": "uchar"}


def write_gaussians(path: Path, gaussians: Gaussians, *, labelled: bool = False) -> None:
    """Write Gaussians as a standard 3DGS file; `labelled` adds instance_id, instance_conf and part_id, and where an
    edit has filled holes, `filled` (0 or 1)."""
    filled = isinstance(gaussians, EditedScene) and gaussians.filled.any()
    labels = (*_LABELS, *(("filled",) if filled else ())) if labelled else ()
    rest = (f"f_rest_{i}" for i in range(3 * (gaussians.sh.shape[1] - 1)))
    dtype = np.dtype([(name, "<f4") for name in (*_HEAD, *rest, *_TAIL, *labels)])

    def block(start: int, stop: int) -> NDArray[np.void]:
        rows = _gaussian_rows(gaussians, slice(start, stop), labels)
        return rows.view(dtype)[:, 0]

    _write(path, dtype, len(gaussians), block, (_RENDER_MODE,))


def _gaussian_rows(gaussians: Gaussians, part: slice, labels: tuple[str, ...]) -> Float32:
    means, sh = gaussians.means[part], gaussians.sh[part]
    columns = [
        means,
        np.zeros_like(means),
        sh[:, 0],
        sh[:, 1:].transpose(0, 2, 1).reshape(len(sh), -1),
        gaussians.opacity_logits[part, None],
        gaussians.log_scales[part],
        gaussians.quaternions[part],
    ]
    columns += [getattr(gaussians, name)[part, None].astype(np.float32) for name in labels]
    return np.concatenate(columns, axis=1, dtype="<f4")


def write_cloud(path: Path, cloud: PointCloud, labels: PointLabels, parts: PointParts) -> None:
    """Write the labelled points: x y z, red green blue, instance_id, instance_conf, part_id.

    Raises ValueError when cloud and labels differ in length.
    """
    if len(cloud.points) != len(labels.label):
        raise ValueError(f"{len(cloud.points)} points but {len(labels.label)} labels")
    positions = [(name, "<f4") for name in "xyz"]
    dtype = np.dtype([*positions, *((name, "u1") for name in _COLORS), *((name, "<f4") for name in _LABELS)])

    def block(start: int, stop: int) -> NDArray[np.void]:
        rows = np.zeros(stop - start, dtype)
        for axis, name in enumerate("xyz"):
            rows[name] = cloud.points[start:stop, axis]
        for channel, name in enumerate(_COLORS):
            rows[name] = cloud.colors[start:stop, channel]
        rows["instance_id"] = labels.label[start:stop]
        rows["instance_conf"] = labels.confidence[start:stop]
        rows["part_id"] = parts.part[start:stop]
        return rows

    _write(path, dtype, len(cloud.points), block, ())


def _write(
    path: Path,
    dtype: np.dtype[np.void],
    count: int,
    block: Callable[[int, int], NDArray[np.void]],
    comments: Sequence[str],
) -> None:
    names = dtype.names or ()
    lines = [
        "ply",
        "format binary_little_endian 1.0",
        *(f"comment {comment}" for comment in comments),
        f"element vertex {count}",
        *(f"property {_NAMES[dtype[name].str[1:]]} {name}" for name in names),
        "end_header",
    ]
    with path.open("wb") as stream:
        stream.write(("\n".join(lines) + "\n").encode("ascii"))
        for start in range(0, count, _ROWS_A_BLOCK):
            stream.write(block(start, min(start + _ROWS_A_BLOCK, count)).tobytes())


def read_columns(path: Path) -> NDArray[np.void]:
    """The vertices of a binary PLY file as a structured array, mapped from the file and not loaded: [N].

    Raises InputError when the file is no PLY, is not binary little endian, has elements or lists besides scalar vertex
    properties, or does not have the size that its header promises.
    """
    with path.open("rb") as stream:
        head = stream.read(_LONGEST_HEADER)
    end = head.find(b"end_header\n")
    if not head.startswith(b"ply\n") or end < 0:
        raise InputError(f"{path.name} is not a PLY file: it should start with `ply` and have a header of text lines.")
    header = head[:end].decode("ascii", errors="replace").splitlines()
    words = [line.split() for line in header[1:] if line.split() and line.split()[0] not in ("comment", "obj_info")]
    if words[:1] != [["format", "binary_little_endian", "1.0"]]:
        raise InputError(f"{path.name} should be PLY of the format `binary_little_endian 1.0`.")
    if len(words) < 2 or words[1][:2] != ["element", "vertex"] or len(words[1]) != 3 or not words[1][2].isdigit():
        raise InputError(f"{path.name} should have `element vertex` and a count as its first element.")
    odd = [line for line in words[2:] if len(line) != 3 or line[0] != "property" or line[1] not in _TYPES]
    if odd:
        raise InputError(f"{path.name} has `{' '.join(odd[0])}` in its header; only scalars of vertices can be read.")
    count, dtype = int(words[1][2]), np.dtype([(name, _TYPES[kind]) for _, kind, name in words[2:]])
    start = end + len(b"end_header\n")
    expected, size = start + count * dtype.itemsize, path.stat().st_size
    if size != expected:
        raise InputError(f"{path.name} has {size} bytes and its header promises {expected}; it is damaged.")
    if not count:
        return np.zeros(0, dtype)
    return np.memmap(path, dtype, "r", start, (count,))


def read_gaussians(path: Path) -> Gaussians:
    """Gaussians of a standard or labelled 3DGS file; ids are 0 and confidences 0 where the file has no labels.

    The degree is that of the file: one with 45 f_rest columns gives degree 3, also where they are 0.
    Raises InputError when columns are missing.
    """
    rows = read_columns(path)
    names = set(rows.dtype.names or ())
    rest = sum(name.startswith("f_rest_") for name in names)
    missing = [name for name in (*_HEAD, *_TAIL) if name not in names and name[0] != "n"]
    if missing or rest not in (0, 9, 24, 45):
        what = f"lacks {', '.join(missing)}" if missing else f"has {rest} f_rest columns instead of 0, 9, 24 or 45"
        raise InputError(f"{path.name} {what}; a file of 3D Gaussians is needed.")

    def gather(*columns: str) -> Float32:
        return np.stack([rows[name].astype(np.float32) for name in columns], axis=1)

    def label(name: str) -> Float32:
        return rows[name].astype(np.float32) if name in names else np.zeros(len(rows), np.float32)

    sh = gather("f_dc_0", "f_dc_1", "f_dc_2")[:, None]
    if rest:
        higher = gather(*(f"f_rest_{i}" for i in range(rest))).reshape(len(rows), 3, rest // 3)
        sh = np.concatenate([sh, higher.transpose(0, 2, 1)], axis=1)
    rotation = gather("rot_0", "rot_1", "rot_2", "rot_3")
    length = np.linalg.norm(rotation, axis=1, keepdims=True)
    return Gaussians(
        means=gather("x", "y", "z"),
        # Files may hold quaternions of any length; one of unit length is kept to the bit.
        quaternions=np.where(np.abs(length - 1) < 1e-6, rotation, rotation / np.maximum(length, 1e-12)),
        log_scales=gather("scale_0", "scale_1", "scale_2"),
        opacity_logits=rows["opacity"].astype(np.float32),
        sh=sh,
        instance_id=np.rint(label("instance_id")).astype(np.int32),
        instance_conf=label("instance_conf"),
        part_id=np.rint(label("part_id")).astype(np.int32),
    )
