"""Matches of one photo with others: pairs of features that look alike and fit one epipolar geometry."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ss_flow.running import progress
from ss_flow.task import task
from ss_flow.tasks.artifacts import Bool, Float32, Float64, Int32
from ss_flow.tasks.capture.colmap import SEED, load_pycolmap
from ss_flow.tasks.capture.features import UNIT, Features

Allowed = Callable[[slice], Bool]
"""For some features of a photo, which of the other photo's they may match: [n, M]."""

_RATIO, _MAX_ANGLE = 0.8, 0.7
"""COLMAP's: the nearest descriptor must be so much nearer than the next, and no farther than this angle (radians)."""
MAX_ERROR = 4.0
"""COLMAP's: how far from its epipolar line a point may lie, in pixels."""
_TRIALS = 2000
"""The most that RANSAC samples: enough for pairs of which 45 % fit (Hartley and Zisserman, Sec. 4.7.1; 1 - 0.45^7 a
sample of seven). With COLMAP's 10,000 a pair that fits nothing costs four times as much as its matching."""
_BLOCK = 512
"""Rows of the table of products that are looked at together, so that they stay in the processor's cache."""
FIRST_FOCAL = 1.2
"""COLMAP's first guess of a focal length, by the photo's longer side."""


@dataclass(frozen=True)
class Matches:
    """What one photo has in common with some others."""

    name: str
    others: tuple[str, ...]
    """[P] the photos with which it fits one geometry."""
    configuration: Int32
    """[P] COLMAP's kind of two-view geometry (`TwoViewGeometryConfiguration`)."""
    fundamental: Float64
    """[P, 3, 3] F in x_other^T F x_own = 0."""
    first: Int32
    """[P + 1] where the matches with each begin."""
    pair: Int32
    """[M, 2] rows of the two photos' features, this one's first."""

    def pairs_with(self, other: int) -> Int32:
        """[m, 2] those of `pair` with one of the other photos, by its place in `others`."""
        return self.pair[self.first[other] : self.first[other + 1]]


@task(name="capture.match")
def match(photo: Features, others: Sequence[Features], *, guided: bool = False) -> Matches:
    """Match a photo with others, and keep what RANSAC confirms.

    guided: match once more along the epipolar lines that the first matches give, where the ratio test has fewer rivals.
    """
    pycolmap = load_pycolmap()
    options = pycolmap.TwoViewGeometryOptions()
    options.ransac.random_seed = SEED
    options.ransac.max_num_trials = _TRIALS
    own = _Prepared(pycolmap, photo)
    found = []
    for i in range(len(others)):
        progress(i, len(others), f"{photo.name} with {others[i].name}")
        other = _Prepared(pycolmap, others[i])
        pairs = descriptor_matches(own.descriptors, other.descriptors)
        geometry = own.geometry(other, pairs, options)
        inliers = np.asarray(geometry.inlier_matches, np.int32).reshape(-1, 2)
        if guided and len(inliers) and geometry.F is not None:
            allowed = near_epipolar_lines(own.points, other.points, np.asarray(geometry.F))
            pairs = descriptor_matches(own.descriptors, other.descriptors, allowed)
            again = own.geometry(other, pairs, options)
            if len(again.inlier_matches) > len(inliers):
                geometry, inliers = again, np.asarray(again.inlier_matches, np.int32)
        if len(inliers):
            fundamental = np.zeros((3, 3)) if geometry.F is None else np.asarray(geometry.F)
            found.append((others[i].name, int(geometry.config), fundamental, inliers))
    progress(len(others), len(others), f"{photo.name}: {len(found)} of {len(others)} pairs fit")
    return Matches(
        name=photo.name,
        others=tuple(name for name, *_ in found),
        configuration=np.array([kind for _, kind, _, _ in found], np.int32),
        fundamental=np.array([f for _, _, f, _ in found], np.float64).reshape(-1, 3, 3),
        first=np.cumsum([0, *(len(pairs) for *_, pairs in found)]).astype(np.int32),
        pair=np.concatenate([np.zeros((0, 2), np.int32), *(pairs for *_, pairs in found)]),
    )


def descriptor_matches(a: Float32, b: Float32, allowed: Allowed | None = None) -> Int32:
    """[M, 2] rows of descriptors that are each other's nearest, clearly nearer than the next (Lowe 2004, Sec. 7.1).

    a, b: [N, 128], [M, 128] whole numbers of length 512, so that their products are exact in whatever order they are
    added. allowed: which may match at all.
    """
    if len(a) == 0 or len(b) == 0:
        return np.zeros((0, 2), np.int32)
    least = np.float32(UNIT**2 * np.cos(_MAX_ANGLE))
    rows, columns = [np.zeros(0, int)], [np.zeros(0, int)]
    for start in range(0, len(a), _BLOCK):
        block = slice(start, min(start + _BLOCK, len(a)))
        product = a[block] @ b.T
        if allowed is not None:
            product[~allowed(block)] = 0
        near = np.flatnonzero(product.max(axis=1) >= least)
        product = product[near]
        here, nearest = np.arange(len(near)), product.argmax(axis=1)
        angle = _angle(product[here, nearest])
        product[here, nearest] = 0
        clear = angle < _RATIO * _angle(product.max(axis=1, initial=0))
        rows.append(start + near[clear])
        columns.append(nearest[clear])
    row, column = np.concatenate(rows), np.concatenate(columns)
    if allowed is None:
        mutual = _nearest(b[column], a) == row
    else:
        # Of several that chose the same feature along their lines, the nearest stays.
        product = np.einsum("ij,ij->i", a[row], b[column])
        order = np.lexsort((row, -product, column))
        mutual = np.zeros(len(row), bool)
        mutual[order] = np.diff(column[order], prepend=-1) != 0
    return np.stack([row[mutual], column[mutual]], axis=1).astype(np.int32)


def near_epipolar_lines(a: Float64, b: Float64, fundamental: Float64) -> Allowed:
    """Which points of two photos lie near each other's epipolar lines, by Sampson's distance (Hartley and Zisserman,
    Eq. 11.9).

    a, b: [N, 2], [M, 2] pixels. fundamental: F in b^T F a = 0.
    """
    lines = (_homogeneous(a) @ fundamental.T).astype(np.float32)
    back = (_homogeneous(b) @ fundamental).astype(np.float32)
    points = _homogeneous(b).astype(np.float32)
    of_lines, of_back = (lines[:, :2] ** 2).sum(axis=1), (back[:, :2] ** 2).sum(axis=1)

    def allowed(block: slice) -> Bool:
        off: Bool = (lines[block] @ points.T) ** 2 <= MAX_ERROR**2 * (of_lines[block, None] + of_back)
        return off

    return allowed


class _Prepared:
    """Features as the functions above and COLMAP take them."""

    def __init__(self, pycolmap: Any, photo: Features) -> None:
        self._pycolmap = pycolmap
        self.points = photo.points.astype(np.float64)
        self.descriptors = photo.descriptors.astype(np.float32)
        focal = FIRST_FOCAL * max(photo.width, photo.height)
        model = pycolmap.CameraModelId.SIMPLE_PINHOLE
        self.camera = pycolmap.Camera.create_from_model_id(1, model, focal, photo.width, photo.height)

    def geometry(self, other: _Prepared, pairs: Int32, options: Any) -> Any:
        if len(pairs) < options.min_num_inliers:
            return self._pycolmap.TwoViewGeometry()
        return self._pycolmap.estimate_two_view_geometry(
            self.camera, self.points, other.camera, other.points, pairs.astype(np.uint32), options
        )


def _nearest(a: Float32, b: Float32) -> Int32:
    """[N] the row of b that is nearest to each of a."""
    found = [(a[start : start + _BLOCK] @ b.T).argmax(axis=1) for start in range(0, len(a), _BLOCK)]
    return np.concatenate([np.zeros(0, np.int32), *found]).astype(np.int32)


def _angle(product: Float32) -> Float32:
    angle: Float32 = np.arccos(np.minimum(product / np.float32(UNIT**2), np.float32(1)))
    return angle


def _homogeneous(points: Float64) -> Float64:
    return np.column_stack([points, np.ones(len(points))])
