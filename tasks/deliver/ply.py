"""PLY files of Gaussians and of labelled points, written.

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

from ss_flow.tasks.artifacts import EditedScene, Float32, Gaussians, PointCloud, PointLabels, PointParts

_HEAD = ("x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2")
_TAIL = ("opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3")
_LABELS = ("instance_id", "instance_conf", "part_id")
_COLORS = ("red", "green", "blue")
_RENDER_MODE = "SplatRenderMode: default"
_ROWS_A_BLOCK = 65_536
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
