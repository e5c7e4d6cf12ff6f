"""Compressed PLY, as SuperSplat reads and writes it: 16 bytes a Gaussian, and one for each higher coefficient."""

from __future__ import annotations

import numpy as np

from ss_flow.task import task
from ss_flow.tasks.artifacts import Float64, Gaussians
from ss_flow.tasks.deliver.export.content import FileContent, base_colors, levels, morton_order, smallest_three
from ss_flow.tasks.gaussians.initialise import select

_CHUNK = 256
"""Gaussians that share the ends of their ranges."""
_CHUNK_COLUMNS = [
    f"{end}_{name}"
    for group in ("xyz", ("scale_x", "scale_y", "scale_z"), "rgb")
    for end in ("min", "max")
    for name in group
]
_VERTEX_COLUMNS = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
_LONGEST_LOG_SCALE = 20.0
_THIRDS = ((21, 11), (11, 10), (0, 11))
"""Where the three numbers of a packed vector begin, and how many bits they have."""
_FLATTEST = 1e-5
"""A range of less counts as a single value."""


@task(name="deliver.export.compressed_ply")
def compressed_ply(gaussians: Gaussians) -> FileContent:
    """Positions, scales and colours of 8 to 11 bits within the ranges of 256 neighbours, quaternions of 10 bits a
    component, opacity of 8; higher harmonics as 256 levels of -4..4."""
    ordered = select(gaussians, morton_order(gaussians.means))
    count = len(ordered)
    chunks = -(-count // _CHUNK)
    lows_and_highs, position = _packed(ordered.means.astype(np.float64), _THIRDS)
    scales = np.clip(ordered.log_scales.astype(np.float64), -_LONGEST_LOG_SCALE, _LONGEST_LOG_SCALE)
    scale_ends, scale = _packed(scales, _THIRDS)
    color_ends, color = _packed(base_colors(ordered), ((24, 8), (16, 8), (8, 8)))
    largest, others = smallest_three(ordered.quaternions)
    rotation = largest.astype(np.uint32)
    for component in levels(others * 0.5**0.5 + 0.5, 10).T:
        rotation = rotation << np.uint32(10) | component
    vertices = np.stack([position, rotation, scale, color | levels(ordered.opacities, 8)], axis=1).astype("<u4")
    ends = np.concatenate([lows_and_highs, scale_ends, color_ends], axis=1).astype("<f4")
    higher = ordered.sh[:, 1:].transpose(0, 2, 1).reshape(count, 3 * (ordered.sh.shape[1] - 1))
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"element chunk {chunks}",
        *(f"property float {name}" for name in _CHUNK_COLUMNS),
        f"element vertex {count}",
        *(f"property uint {name}" for name in _VERTEX_COLUMNS),
    ]
    if higher.shape[1]:
        header += [f"element sh {count}", *(f"property uchar f_rest_{i}" for i in range(higher.shape[1]))]
    coefficients = np.clip(np.trunc((higher.astype(np.float64) / 8 + 0.5) * 256), 0, 255).astype(np.uint8)
    text = "\n".join([*header, "end_header", ""]).encode("ascii")
    return FileContent.of(text, ends.tobytes(), vertices.tobytes(), coefficients.tobytes())


def _packed(values: Float64, places: tuple[tuple[int, int], ...]) -> tuple[Float64, np.ndarray]:
    """Each chunk's smallest and largest values [C, 6], and the three numbers of each row within them as one [N]."""
    starts = np.arange(0, len(values), _CHUNK)
    if not len(starts):
        return np.zeros((0, 6)), np.zeros(0, np.uint32)
    # The ends are stored as float32, and readers work from those.
    low = np.minimum.reduceat(values, starts).astype(np.float32).astype(np.float64)
    high = np.maximum.reduceat(values, starts).astype(np.float32).astype(np.float64)
    chunk = np.arange(len(values)) // _CHUNK
    width = (high - low)[chunk]
    share = np.where(width < _FLATTEST, 0.0, (values - low[chunk]) / np.maximum(width, _FLATTEST))
    packed = np.zeros(len(values), np.uint32)
    for axis, (place, bits) in enumerate(places):
        packed |= levels(share[:, axis], bits) << np.uint32(place)
    return np.concatenate([low, high], axis=1), packed
