"""SOG, version 2: images of small numbers, lossless WebP in a ZIP archive; of about a fifteenth of the PLY's size."""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ss_flow.task import task
from ss_flow.tasks.artifacts import Float32, Gaussians, UInt8
from ss_flow.tasks.deliver.export.content import FileContent, levels, morton_order, smallest_three
from ss_flow.tasks.gaussians.initialise import select

_LEVELS = 256
_MOST_KINDS = 1 << 16
"""The labels of the harmonics have 16 bits."""
_KINDS_A_ROW = 64
_LLOYD_STEPS = 20
_LONG_AGO = (1980, 1, 1, 0, 0, 0)
"""The date of what is in the archive: the same Gaussians give the same bytes."""
_LOSSLESS = 101
"""WebP quality above 100, for OpenCV. What lies under an alpha of 0 is lost even so, hence no alpha here is 0."""


@task(name="deliver.export.sog")
def sog(gaussians: Gaussians) -> FileContent:
    """Positions of 16 bits on a logarithmic scale, quaternions of 8 bits a component, opacity of 8; scales and base
    colour as 256 values each that are chosen for the scene; higher harmonics as one of at most 65,536 kinds whose
    coefficients are 256 chosen values too. Rows come along a curve that keeps neighbours near each other.
    """
    ordered = select(gaussians, morton_order(gaussians.means))
    count = len(ordered)
    images: dict[str, UInt8] = {}
    meta: dict[str, Any] = {"version": 2, "asset": {"generator": "ss-flow"}, "count": count}
    logs = np.sign(ordered.means) * np.log1p(np.abs(ordered.means.astype(np.float64)))
    low, high = (ends(logs, axis=0) if count else np.zeros(3) for ends in (np.min, np.max))
    fixed = levels((logs - low) / np.maximum(high - low, 1e-12), 16)
    images["means_l"], images["means_u"] = _image(fixed & 255), _image(fixed >> 8)
    meta["means"] = {"mins": low.tolist(), "maxs": high.tolist(), "files": ["means_l.webp", "means_u.webp"]}
    book, chosen = _codebook(ordered.log_scales)
    images["scales"] = _image(chosen)
    meta["scales"] = {"codebook": book.tolist(), "files": ["scales.webp"]}
    largest, others = smallest_three(ordered.quaternions)
    images["quats"] = _image(levels(others * 0.5**0.5 + 0.5, 8), 252 + largest)
    meta["quats"] = {"files": ["quats.webp"]}
    book, chosen = _codebook(ordered.sh[:, 0])
    images["sh0"] = _image(chosen, np.maximum(levels(ordered.opacities, 8), 1))
    meta["sh0"] = {"codebook": book.tolist(), "files": ["sh0.webp"]}
    if count and ordered.sh_degree:
        kind, kinds = _kinds(ordered.sh[:, 1:].reshape(count, -1))
        book, chosen = _codebook(kinds)
        coefficients = chosen.reshape(len(kinds), -1, 3)
        images["shN_centroids"] = _image_of_kinds(coefficients)
        images["shN_labels"] = _image(np.stack([kind & 255, kind >> 8, np.zeros_like(kind)], axis=1))
        files = ["shN_centroids.webp", "shN_labels.webp"]
        bands = {"count": len(kinds), "bands": ordered.sh_degree, "codebook": book.tolist()}
        meta["shN"] = bands | {"files": files}
    return FileContent.of(_archive(meta, images))


def _image(colors: NDArray[Any], alpha: NDArray[Any] | int = 255) -> UInt8:
    """[h, w, 4] one pixel a row, from the top left on; sides are multiples of 4. colors: [N, 3], alpha: [N] or one."""
    count = len(colors)
    width = max(4, -(-int(np.ceil(count**0.5)) // 4) * 4)
    height = max(4, -(-count // (4 * width)) * 4)
    pixels = np.full((height * width, 4), 255, np.uint8)
    pixels[:count, :3] = colors
    pixels[:count, 3] = alpha
    return pixels.reshape(height, width, 4)


def _image_of_kinds(coefficients: NDArray[Any]) -> UInt8:
    """[h, 64 K, 4] the kinds, 64 a row, each K pixels wide. coefficients: [P, K, 3]."""
    count, width = coefficients.shape[:2]
    rows = -(-count // _KINDS_A_ROW)
    pixels = np.full((rows * _KINDS_A_ROW, width, 4), 255, np.uint8)
    pixels[:count, :, :3] = coefficients
    return pixels.reshape(rows, _KINDS_A_ROW * width, 4)


def _codebook(values: Float32) -> tuple[Float32, UInt8]:
    """256 values, ascending, that stand for all numbers of an array with a small squared error, and which stands for
    each (k-means in one dimension: quantiles, then Lloyd's steps).

    Up to 256 different numbers stand for themselves.
    """
    distinct, inverse, counts = np.unique(values, return_inverse=True, return_counts=True)
    if len(distinct) <= _LEVELS:
        book = np.append(distinct, np.repeat(distinct[-1:] if len(distinct) else [0.0], _LEVELS - len(distinct)))
        return book.astype(np.float32), inverse.reshape(values.shape).astype(np.uint8)
    number = np.append(0.0, np.cumsum(counts))
    total = np.append(0.0, np.cumsum(distinct.astype(np.float64) * counts))
    book = np.interp((np.arange(_LEVELS) + 0.5) / _LEVELS * number[-1], number[1:], distinct)
    for _ in range(_LLOYD_STEPS):
        ends = np.concatenate([[0], np.searchsorted(distinct, (book[1:] + book[:-1]) / 2), [len(distinct)]])
        held = number[ends[1:]] - number[ends[:-1]]
        book = np.where(held > 0, (total[ends[1:]] - total[ends[:-1]]) / np.maximum(held, 1), book)
    book32 = np.sort(book).astype(np.float32)
    middles = (book32[1:].astype(np.float64) + book32[:-1]) / 2
    return book32, np.searchsorted(middles, values).astype(np.uint8)


def _kinds(rows: Float32, most: int = _MOST_KINDS) -> tuple[NDArray[np.int64], Float32]:
    """Which kind stands for each row [N], and the kinds [P, D]: the means of at most `most` groups of like rows.

    All rows are halved at the median of the coefficient that varies most in them, each half again, and so on, so that
    equally many rows share each kind; rows that are few enough stand for themselves.
    """
    if len(rows) <= most:
        return np.arange(len(rows)), rows
    kind = np.zeros(len(rows), np.int64)
    groups: Sequence[NDArray[np.intp]] = [np.arange(len(rows))]
    while 2 * len(groups) <= most:
        groups = [half for group in groups for half in _halves(rows, group)]
    for number, group in enumerate(groups):
        kind[group] = number
    return kind, np.stack([rows[group].mean(axis=0) for group in groups])


def _halves(rows: Float32, group: NDArray[np.intp]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    own = rows[group]
    order = np.argsort(own[:, own.var(axis=0).argmax()], kind="stable")
    middle = len(group) // 2
    return group[order[:middle]], group[order[middle:]]


def _archive(meta: dict[str, Any], images: dict[str, UInt8]) -> bytes:
    import cv2

    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        for name, pixels in images.items():
            bgra = np.ascontiguousarray(pixels[..., [2, 1, 0, 3]])
            ok, data = cv2.imencode(".webp", bgra, [cv2.IMWRITE_WEBP_QUALITY, _LOSSLESS])
            if not ok:
                raise ValueError(f"cannot encode {name}, an image of shape {pixels.shape}")
            archive.writestr(zipfile.ZipInfo(f"{name}.webp", _LONG_AGO), data.tobytes())
        archive.writestr(zipfile.ZipInfo("meta.json", _LONG_AGO), json.dumps(meta))
    return stream.getvalue()
