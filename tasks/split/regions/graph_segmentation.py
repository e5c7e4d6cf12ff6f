"""Segmentation of an RGB-D view without a network: regions grow together where no surface ends between them.

Objects are mostly pieces that are convex outside and separated by depth jumps and concave creases. The image is cut
into small even regions; neighbours then merge, weakest boundary first. The strength of a boundary is the mean, over
the pixel pairs across it, of what geometry says there, plus a share for the difference of colours.
"""

from __future__ import annotations

import heapq
import math
from dataclasses import dataclass

import numpy as np

from ss_flow.tasks.artifacts import Bool, Float32, Int32, UInt8
from ss_flow.tasks.geometry.cameras import Camera
from ss_flow.tasks.geometry.images import inverse_depth

_OF_SLOPE = 3
"""Pixels over which a slope is taken."""
_OF_CREASE = 4
"""How far from a pair of pixels normals are taken, in pixels, since smoothing rounds creases off."""
_MOST_PLANES = 6
"""So many are looked for in a view."""


@dataclass(frozen=True)
class Surface:
    """The visible surface of one view, in the camera's frame."""

    inverse_depth: Float32
    """[H, W] smoothed, 0 where unknown."""
    slope: Float32
    """[H, W, 2] its change a pixel along u and v; on a plane it is constant."""
    points: Float32
    """[H, W, 3]."""
    normals: Float32
    """[H, W, 3] of unit length, towards the camera; zeros where unknown."""

    @property
    def known(self) -> Bool:
        """[H, W] where there is a normal."""
        return np.asarray(self.normals.any(axis=2))


@dataclass(frozen=True)
class Boundary:
    """Evidence between neighbouring pixels: one entry for each pixel pair of which both are valid."""

    first: Int32
    second: Int32
    """Flat pixel indices."""
    strength: Float32
    """0 = the same surface goes on, 1 = it ends for certain."""
    known: Bool
    """Whether depth was known on both sides; strength is 0 where not."""


def surface_of(depth: Float32, camera: Camera) -> Surface:
    """Points and normals of a depth map.

    depth: [H, W] z-depth at the camera's size, 0 where unknown. The inverse depth of a plane is affine in the pixel,
    so that slopes of the inverse depth give the normal without a fit. Of the slopes to either side the smaller counts:
    the other one may lie across an edge.
    """
    import cv2

    known = depth > 0
    inverse = inverse_depth(depth)
    scale = float(np.median(inverse[known])) if known.any() else 1.0
    filled = cv2.medianBlur(inverse, 5)
    filled = np.where(filled > 0, filled, inverse)
    smooth = cv2.bilateralFilter(filled, d=7, sigmaColor=0.02 * scale, sigmaSpace=3)
    smooth = np.where(known, smooth, 0).astype(np.float32)
    slope = np.stack([_slope(smooth, known, axis) for axis in (1, 0)], axis=2)
    usable = known & np.isfinite(slope).all(axis=2)
    slope = np.where(usable[..., None], slope, 0)
    # The slope is blurred only among its own kind: zeros of unknown pixels must not pull it down.
    weight = cv2.blur(usable.astype(np.float32), (3, 3))
    slope = cv2.blur(slope, (3, 3)) / np.maximum(weight, 1e-6)[..., None]

    v, u = np.mgrid[: camera.height, : camera.width] + 0.5
    x, y = u - camera.cx, v - camera.cy
    across, along = slope[..., 0], slope[..., 1]
    normals = np.stack([camera.fx * across, camera.fy * along, smooth - x * across - y * along], axis=2)
    length = np.linalg.norm(normals, axis=2, keepdims=True)
    usable &= length[..., 0] > 0
    # n . X = 1 for the unnormalised normal, which therefore points away from the camera.
    normals = np.where(usable[..., None], -normals / np.maximum(length, 1e-12), 0).astype(np.float32)
    z = inverse_depth(smooth)
    points = np.stack([x / camera.fx * z, y / camera.fy * z, z], axis=2).astype(np.float32)
    return Surface(smooth, slope.astype(np.float32), points, normals)


def _slope(image: Float32, known: Bool, axis: int) -> Float32:
    """Change a pixel along an axis, to the side where it is smaller; NaN where neither is known."""
    ahead = (np.roll(image, -_OF_SLOPE, axis) - image) / _OF_SLOPE
    ahead[~(known & np.roll(known, -_OF_SLOPE, axis))] = np.nan
    edge: list[slice] = [slice(None), slice(None)]
    edge[axis] = slice(-_OF_SLOPE, None)
    ahead[tuple(edge)] = np.nan
    behind = np.roll(ahead, _OF_SLOPE, axis)
    smaller = np.where(np.abs(behind) < np.abs(ahead), behind, ahead)
    return np.where(np.isnan(smaller), np.where(np.isnan(ahead), behind, ahead), smaller)


def boundaries(surface: Surface, valid: Bool, jump: float, crease: float) -> Boundary:
    """What geometry says between each pixel and its right and lower neighbour.

    valid: [H, W]. jump: relative step in depth, beyond what the slope explains, at which a surface ends. crease: angle
    in degrees between the normals at which a concave crease ends an object; a convex one (a box's own edge) ends none.
    """
    height, width = valid.shape
    index = np.arange(height * width, dtype=np.int32).reshape(height, width)
    parts = []
    for axis in (1, 0):
        first, second = _pair(axis)
        pairs = valid[first] & valid[second]
        d0, d1 = surface.inverse_depth[first], surface.inverse_depth[second]
        known = (d0 > 0) & (d1 > 0)
        channel = 1 - axis
        step0 = np.abs(d0 + surface.slope[first][..., channel] - d1)
        step1 = np.abs(d1 - surface.slope[second][..., channel] - d0)
        relative = np.minimum(step0, step1) / np.maximum(np.minimum(d0, d1), 1e-9)
        ended = np.clip(relative / jump - 0.5, 0, 1)

        before = _shift(index, _OF_CREASE - 1, axis)[first]
        after = _shift(index, -(_OF_CREASE - 1), axis)[second]
        n0, n1 = (surface.normals.reshape(-1, 3)[i] for i in (before, after))
        x0, x1 = (surface.points.reshape(-1, 3)[i] for i in (before, after))
        both = n0.any(axis=2) & n1.any(axis=2) & known
        angle = np.degrees(np.arccos(np.clip((n0 * n1).sum(axis=2), -1, 1)))
        concave = ((n0 - n1) * (x0 - x1)).sum(axis=2) < 0
        bend = np.where(both & concave, angle, 0).astype(np.float32)
        folded = np.clip(_ridge(bend, axis, _OF_CREASE) / crease - 0.5, 0, 1)
        strength = np.where(known, np.maximum(ended, folded), 0).astype(np.float32)
        parts.append((index[first][pairs], index[second][pairs], strength[pairs], known[pairs]))
    return Boundary(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def _ridge(bend: Float32, axis: int, reach: int) -> Float32:
    """Thin a response that is smeared along an axis: what is not nearly the largest within `reach` becomes 0."""
    import cv2

    def largest(image: Float32, size: int) -> Float32:
        kernel = np.ones((1, size) if axis == 1 else (size, 1), np.uint8)
        return np.asarray(cv2.dilate(image, kernel), np.float32)

    crest = np.where(bend >= largest(bend, 2 * reach + 1), bend, 0).astype(np.float32)
    return largest(crest, 3)


def _pair(axis: int) -> tuple[tuple[slice, slice], tuple[slice, slice]]:
    every = slice(None)
    if axis == 1:
        return (every, slice(None, -1)), (every, slice(1, None))
    return (slice(None, -1), every), (slice(1, None), every)


def _shift(image: np.ndarray, by: int, axis: int) -> np.ndarray:
    """The image moved by some pixels along an axis, its border repeated."""
    size = image.shape[axis]
    return np.take(image, np.clip(np.arange(size) - by, 0, size - 1), axis=axis)


def superpixels(rgb: UInt8, surface: Surface, boundary: Boundary, valid: Bool, min_size: int) -> Int32:
    """Small even regions: [H, W] ids from 0, -1 where not valid.

    Graph-based segmentation (Felzenszwalb and Huttenlocher, 2004) over colour, normal and boundary strength.
    """
    import cv2

    lab = cv2.cvtColor(rgb, cv2.COLOR_RGB2LAB).astype(np.float32)
    strength = np.zeros(valid.size, np.float32)
    np.maximum.at(strength, boundary.first, boundary.strength)
    features = np.concatenate([lab / 2, 40 * surface.normals, 60 * strength.reshape(*valid.shape, 1)], axis=2)
    features[~valid] = -200
    segmenter = cv2.ximgproc.segmentation.createGraphSegmentation(sigma=0.6, k=60, min_size=min_size)
    regions = segmenter.processImage(np.ascontiguousarray(features))
    regions = np.where(valid, regions, -1)
    _, ids = np.unique(regions, return_inverse=True)
    return (ids.reshape(valid.shape) - int((~valid).any())).astype(np.int32)


class RegionGraph:
    """Regions and the boundaries between them, merged from the weakest boundary up (average linkage)."""

    def __init__(
        self, regions: Int32, lab: Float32, boundary: Boundary, color_weight: float, color_scale: float
    ) -> None:
        """regions: [H, W] ids from 0, -1 = none. lab: [H, W, 3], each 0..255. color_weight: strength that colour alone
        can add where depth is known. color_scale: distance in `lab` at which colours count as different."""
        flat = regions.ravel()
        self.size = count = int(flat.max()) + 1
        inside = flat >= 0
        area = np.bincount(flat[inside], minlength=count).astype(np.float64)
        sums = [np.bincount(flat[inside], lab[..., c].ravel()[inside], count) for c in range(3)]
        # Lists from here on: single numbers out of arrays would take most of the time.
        self._area: list[float] = area.tolist()
        self._color: list[list[float]] = (np.stack(sums, axis=1) / np.maximum(area, 1)[:, None]).tolist()
        self._united_with = list(range(count))
        self._version = [0] * count
        self._weight, self._scale = color_weight, color_scale
        a, b = flat[boundary.first], flat[boundary.second]
        low, high = np.minimum(a, b), np.maximum(a, b)
        between = (low >= 0) & (low != high)
        key, where = np.unique(low[between].astype(np.int64) * count + high[between], return_inverse=True)
        length = np.bincount(where)
        seen = np.bincount(where, boundary.known[between])
        strength = np.bincount(where, boundary.strength[between])
        self._links: list[dict[int, tuple[float, float, float]]] = [{} for _ in range(count)]
        for k, n, s, e in zip(key.tolist(), length.tolist(), seen.tolist(), strength.tolist(), strict=True):
            i, j = divmod(k, count)
            self._links[i][j] = self._links[j][i] = (n, s, e)
        self._heap = [(self.strength(i, j), i, j, 0, 0) for i in range(count) for j in self._links[i] if i < j]
        heapq.heapify(self._heap)

    def strength(self, i: int, j: int) -> float:
        """How strong the boundary between two neighbours is, 0..1 + color_weight."""
        length, seen, strength = self._links[i][j]
        color = 1 - math.exp(-math.dist(self._color[i], self._color[j]) / self._scale)
        share = seen / length
        return strength / max(seen, 1) * share + color * (share * self._weight + (1 - share))

    def merge(self, level: float) -> None:
        """Unite neighbours until no boundary is weaker than `level`."""
        while self._heap and self._heap[0][0] < level:
            _, i, j, vi, vj = heapq.heappop(self._heap)
            if (self._version[i], self._version[j]) == (vi, vj):
                self._unite(i, j)

    def _unite(self, i: int, j: int) -> None:
        one, other = self._area[i], self._area[j]
        colors = zip(self._color[i], self._color[j], strict=True)
        self._color[i] = [(one * a + other * b) / (one + other) for a, b in colors]
        self._area[i] = one + other
        self._united_with[j] = i
        self._version[i] += 1
        self._version[j] = -1
        del self._links[i][j], self._links[j][i]
        for k, link in self._links[j].items():
            del self._links[k][j]
            old = self._links[i].get(k, (0.0, 0.0, 0.0))
            new = (old[0] + link[0], old[1] + link[1], old[2] + link[2])
            self._links[i][k] = self._links[k][i] = new
        self._links[j] = {}
        for k in self._links[i]:
            low, high = min(i, k), max(i, k)
            entry = (self.strength(low, high), low, high, self._version[low], self._version[high])
            heapq.heappush(self._heap, entry)

    def owners(self) -> Int32:
        """The merged region of each region of the start: [R]."""
        owner = np.array(self._united_with, np.int32)
        while (owner != owner[owner]).any():
            owner = owner[owner]
        return owner

    def enclosures(self) -> dict[int, float]:
        """Mean strength of the whole boundary of each merged region, 0 where it has no neighbour."""
        result = {}
        for i in np.unique(self.owners()).tolist():
            links = self._links[i]
            length = sum(link[0] for link in links.values())
            total = sum(self.strength(i, j) * links[j][0] for j in sorted(links))
            result[i] = total / length if length else 0.0
        return result


def find_planes(surface: Surface, valid: Bool, min_share: float, tolerance: float) -> list[Bool]:
    """The large planes of a view (walls, floor, table tops), largest first: a list of [H, W].

    min_share: least share of the valid pixels. tolerance: distance from the plane, relative to depth. Random sampling
    with a fixed seed; a hypothesis is one pixel's point and normal.
    """
    rng = np.random.default_rng(0)
    rows = np.flatnonzero((valid & surface.known).ravel())
    points, normals = (array.reshape(-1, 3)[rows] for array in (surface.points, surface.normals))
    least = min_share * valid.sum()
    planes: list[Bool] = []
    while len(planes) < _MOST_PLANES and len(rows) >= max(least, 1):
        sample = rng.choice(len(rows), size=min(len(rows), 2000), replace=False)
        some, tried = points[sample], slice(100)
        sides = normals[sample]
        # A table for each coordinate: one of short rows would take several times as long.
        apart = sum((some[:, c] - some[tried, c, None]) * sides[tried, c, None] for c in range(3))
        near = (np.abs(apart) < tolerance * some[:, 2]) & (sides[tried] @ sides.T > 0.9)
        best = int(near.sum(axis=1).argmax())
        normal, offset = sides[best], sides[best] @ some[best]
        inlier = np.zeros(len(rows), bool)
        for _ in range(3):
            inlier = (np.abs(points @ normal - offset) < tolerance * points[:, 2]) & (normals @ normal > 0.85)
            inliers = points[inlier]
            if len(inliers) < 3:
                break
            centre = inliers.mean(axis=0)
            spread = (inliers - centre).astype(np.float64)
            axis = np.linalg.eigh(spread.T @ spread)[1][:, 0].astype(np.float32)
            normal = axis if axis @ normal > 0 else -axis
            offset = normal @ centre
        if inlier.sum() < least:
            break
        mask = np.zeros(valid.size, bool)
        mask[rows[inlier]] = True
        planes.append(mask.reshape(valid.shape))
        rows, points, normals = rows[~inlier], points[~inlier], normals[~inlier]
    return planes
