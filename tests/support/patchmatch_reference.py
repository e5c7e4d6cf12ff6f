"""PatchMatch as native/patchmatch.cpp does it, in plain NumPy and float64: slow, one obvious line for each formula."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ss_flow.tasks.artifacts import Float64
from ss_flow.tasks.capture.patchmatch import PatchMatchParams, Source
from ss_flow.tasks.geometry.plane_sweep import SweepView, pixel_transfer

WAYS = ((-1, 0), (1, 0), (0, -1), (0, 1))


class Reference:
    """The planes of one photo's pixels, [3, H, W] inverse depth and its gradient, and what they cost."""

    def __init__(self, photo: SweepView, sources: Sequence[Source], planes: Float64, params: PatchMatchParams):
        self.photo, self.sources, self.params = photo, sources, params
        self.planes = planes.astype(np.float64)
        self.low, self.high = self.planes[0].min(), self.planes[0].max()
        self.steepest = 5 / photo.camera.fx
        self.gray = np.rint(photo.gray).astype(np.float64)
        self.v, self.u = np.mgrid[: self.gray.shape[0], : self.gray.shape[1]]
        self.cost = self.match(self.planes)

    def match(self, planes: Float64) -> Float64:
        """[H, W] the mean over the best sources that see the window."""
        every = np.sort([self.match_one(planes, s) for s in self.sources], axis=0)[: self.params.best]
        seen = np.isfinite(every)
        mean = np.where(seen, every, 0).sum(axis=0) / np.maximum(seen.sum(axis=0), 1)
        return np.where(seen.any(axis=0), mean, 0.5)

    def match_one(self, planes: Float64, source: Source) -> Float64:
        """[H, W] (1 - weighted correlation) / 2, infinite where the source does not see the whole window."""
        radius, (w, wx, wy) = self.params.window // 2, planes
        a, b = pixel_transfer(self.photo.camera, source.view.camera)
        other = np.rint(source.view.gray).astype(np.float64)
        offsets = range(-radius, radius + 1, 2)
        seen = np.ones(self.gray.shape, bool)
        weights, here, there = [], [], []
        for dv in offsets:
            for du in offsets:
                near = self.at(self.gray, du, dv)
                far = (du**2 + dv**2) / (2 * radius**2)
                weights.append(np.exp(-far - np.abs(near - self.gray) / self.params.gray_scale))
                here.append(near)
                u, v, inside = self.seen_at(a, b, w + du * wx + dv * wy, du, dv, other.shape)
                seen &= inside
                there.append(bilinear(other, u, v))
        weight = np.array(weights) / np.sum(weights, axis=0)
        x, y = (np.array(values) - (weight * values).sum(axis=0) for values in (here, there))
        deviation = np.sqrt(((weight * x**2).sum(axis=0) + 4) * ((weight * y**2).sum(axis=0) + 4))
        cost = 0.5 - 0.5 * (weight * x * y).sum(axis=0) / deviation
        return np.where(seen, cost + self.objection(source, a, b, w), np.inf)

    def seen_at(self, a, b, w, du, dv, shape):
        """Where the source sees the pixel moved by (du, dv), at inverse depth w, and whether that is in its photo."""
        x, y, z = (a[r, 0] * (self.u + du) + a[r, 1] * (self.v + dv) + a[r, 2] + w * b[r] for r in range(3))
        with np.errstate(divide="ignore", invalid="ignore"):
            u, v = x / z, y / z
        inside = (z > 1e-6) & (u >= 0) & (v >= 0) & (u <= shape[1] - 1) & (v <= shape[0] - 1)
        return np.where(inside, u, 0), np.where(inside, v, 0), inside

    def objection(self, source: Source, a, b, w) -> Float64:
        """[H, W] `consistency` by how far the way there and back misses; infinite on pixels that do not count."""
        u, v, _ = self.seen_at(a, b, w, 0, 0, source.view.gray.shape)
        place = np.floor(v + 0.5).astype(int), np.floor(u + 0.5).astype(int)
        depth = source.depth[place].astype(np.float64)
        back, shift = pixel_transfer(source.view.camera, self.photo.camera)
        with np.errstate(divide="ignore", invalid="ignore"):
            x, y, z = (back[r, 0] * u + back[r, 1] * v + back[r, 2] + shift[r] / depth for r in range(3))
            miss = np.hypot(x / z - self.u, y / z - self.v)
            share = np.where((z > 0) & (miss < 3), miss / 3, 1)
        return np.where(source.view.valid[place], np.where(depth > 0, self.params.consistency * share, 0), np.inf)

    def improve(self, turn: int, seed: int) -> None:
        """One turn: first the pixels whose column and row add up to an even number, then the others."""
        for color in range(2):
            best, match = self.planes.copy(), self.cost.copy()
            total = match + self.roughness(best)
            for kind in (*WAYS, 0, 1, 2):
                tried = self.lent(kind) if isinstance(kind, tuple) else self.varied(best, turn, kind, seed)
                tried[0] = np.clip(tried[0], self.low, self.high)
                tried[1:] = np.clip(tried[1:], -self.steepest * tried[0], self.steepest * tried[0])
                matched = self.match(tried)
                whole = matched + self.roughness(tried)
                better = whole < total
                best, match = np.where(better, tried, best), np.where(better, matched, match)
                total = np.where(better, whole, total)
            mine = (self.u + self.v) % 2 == color
            self.planes, self.cost = np.where(mine, best, self.planes), np.where(mine, match, self.cost)

    def roughness(self, planes: Float64) -> Float64:
        """[H, W] what it costs that a plane misses the inverse depths of the neighbours, at 1 and at 3 pixels."""
        total = np.zeros(self.gray.shape)
        for far in (1, 3):
            for x, y in WAYS:
                dx, dy = x * far, y * far
                off = np.abs(planes[0] + dx * planes[1] + dy * planes[2] - self.at(self.planes[0], dx, dy))
                weight = np.exp(-np.abs(self.at(self.gray, dx, dy) - self.gray) / self.params.gray_scale) / 8
                share = np.minimum(off / (self.params.smooth_scale * planes[0]), 1)
                total += np.where(self.holds(dx, dy), self.params.smoothness * weight * share, 0)
        return total

    def lent(self, way: tuple[int, int]) -> Float64:
        """[3, H, W] in one direction, the plane of least cost up to 11 pixels away."""
        least, result = np.full(self.gray.shape, np.inf), self.planes.copy()
        for far in range(1, 12, 2):
            dx, dy = way[0] * far, way[1] * far
            cost = np.where(self.holds(dx, dy), self.at(self.cost, dx, dy), np.inf)
            w, wx, wy = (self.at(part, dx, dy) for part in self.planes)
            result = np.where(cost < least, np.stack([w - dx * wx - dy * wy, wx, wy]), result)
            least = np.minimum(least, cost)
        return result

    def varied(self, best: Float64, turn: int, kind: int, seed: int) -> Float64:
        """[3, H, W] another inverse depth (kind 0), another slope (1), or a little of both (2)."""
        share = 0.5**turn
        pixel = (self.v * self.gray.shape[1] + self.u).astype(np.uint32)
        state = hashed(pixel ^ hashed(np.full(1, seed + 3 * turn + kind, np.uint32)))
        draws = []
        for _ in range(3):
            state = hashed(state)
            draws.append((state >> np.uint32(8)) / 2**23 - 1)
        depth, slope = (0.1, 0, 0.02)[kind] * share, (0, 0.5, 0.5)[kind] * share * self.steepest
        w, wx, wy = best
        return np.stack([w * (1 + depth * draws[0]), wx + slope * w * draws[1], wy + slope * w * draws[2]])

    def at(self, image: Float64, du: int, dv: int) -> Float64:
        """[H, W] the image moved, its border repeated."""
        height, width = self.gray.shape
        return image[np.clip(self.v + dv, 0, height - 1), np.clip(self.u + du, 0, width - 1)]

    def holds(self, du: int, dv: int):
        height, width = self.gray.shape
        u, v = self.u + du, self.v + dv
        return (u >= 0) & (u < width) & (v >= 0) & (v < height)


def bilinear(image: Float64, u: Float64, v: Float64) -> Float64:
    i, j = np.floor(u).astype(int), np.floor(v).astype(int)
    i1, j1 = np.minimum(i + 1, image.shape[1] - 1), np.minimum(j + 1, image.shape[0] - 1)
    top = image[j, i] + (u - i) * (image[j, i1] - image[j, i])
    bottom = image[j1, i] + (u - i) * (image[j1, i1] - image[j1, i])
    return top + (v - j) * (bottom - top)


def hashed(x: np.ndarray) -> np.ndarray:
    x = x * np.uint32(747796405) + np.uint32(2891336453)
    x = ((x >> ((x >> np.uint32(28)) + np.uint32(4))) ^ x) * np.uint32(277803737)
    return (x >> np.uint32(22)) ^ x
