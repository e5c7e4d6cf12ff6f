"""Depth where comparing photos does not tell it: surfaces of one colour go on flat.

A plain table top shows nothing to compare, and at the rim of a photo few others show the same. But neighbouring pixels
of one colour are mostly of one surface, walls, tables and boxes are flat, and the inverse depth of a plane is affine in
the pixel: 1 / z = a x + b y + c. So what is known of a region tells the rest of it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ss_flow.task import task
from ss_flow.tasks.artifacts import Bool, DepthMap, Float64, Frame, Int32
from ss_flow.tasks.geometry.images import inverse_depth, near_border, resampled, shared_rgb, shared_valid
from ss_flow.tasks.ranges import Count, Fraction, Natural, NonNegative, Positive

_SAMPLES = 100
"""Planes through three pixels that are tried; of one that half of the pixels lie on, all miss once in 600,000 times."""
_COMPARED = 1000
"""Pixels of a region that these are tried on."""
_ALIKE = 50
"""So many neighbouring pixels count as one measurement: they are matched in windows that overlap, and err alike."""
_SHARPEST = 0.002
"""No measurement of an inverse depth is believed to be more exact than this share of it."""
_THIN = 1e-4
"""Twice the area of triples of pixels that tell no plane, as a share of the image."""
_REFITS = 3
_NEARER, _FARTHER = 0.7, 1.25
"""Planes end at these multiples of the nearest and the farthest known depth."""


@dataclass(frozen=True)
class PlaneParams:
    """What is taken to be flat, and how far it goes on."""

    flat: Fraction = 0.7
    """Share of a region's known pixels that must lie on one plane; 0 = nothing goes on."""
    tolerance: Positive = 0.015
    """How far off the plane they may lie, as a share of the inverse depth."""
    certain: Positive = 0.015
    """Standard error of the plane, likewise, up to which it goes on."""
    min_known: Count = 30
    """Pixels of a region whose depth must be known."""
    contrast: Positive = 200.0
    """The larger, the more colours may differ within a region."""
    blur: NonNegative = 0.5
    """Standard deviation of the blur before, in pixels."""
    min_pixels: Count = 60
    """Smaller regions join a neighbour."""
    rim: Natural = 6
    """Photos are compared in windows, which hang over outlines: a rim of what is behind seems as near as what is in
    front. So within so many pixels of its region's border, what is nearer than the plane is taken to lie on it."""


@task(name="capture.planes")
def planes(frame: Frame, depth: DepthMap, *, params: PlaneParams = PlaneParams()) -> DepthMap:
    """The depth that photos show together, and where it is unknown that of the planes on which its regions lie.

    Known depth stays, but along outlines (`rim`). Pixels that do not count (`Frame.valid`) stay unknown.
    """
    size = depth.depth.shape
    regions, inverse = regions_of_colour(frame, size, params), inverse_depth(depth.depth.astype(np.float64))
    coefficients, covariances = fitted_planes(regions, inverse, params)
    places = _places(size)
    flat = np.einsum("hwi,hwi->hw", places, coefficients[regions])
    error = np.sqrt(np.einsum("hwi,hwij,hwj->hw", places, covariances[regions], places))
    nearest, farthest = inverse.max(), inverse.min(where=inverse > 0, initial=np.inf)
    goes_on = (flat < nearest / _NEARER) & (flat > farthest / _FARTHER) & (error < params.certain * flat)
    outline = near_border(regions.astype(np.float32), params.rim)
    gives_way = (inverse == 0) | (outline & (inverse > (1 + params.tolerance) * flat))
    changed = goes_on & gives_way & resampled(shared_valid(frame), *size)
    return replace(depth, depth=np.where(changed, 1 / np.where(changed, flat, 1), depth.depth).astype(np.float32))


def regions_of_colour(frame: Frame, size: tuple[int, int], params: PlaneParams) -> Int32:
    """[h, w] which region each pixel of a photo is of, from 0 on, by the graph of its pixels (Felzenszwalb &
    Huttenlocher 2004); size: h and w."""
    import cv2

    photo = cv2.resize(shared_rgb(frame), size[::-1], interpolation=cv2.INTER_AREA)
    graph = cv2.ximgproc.segmentation.createGraphSegmentation(params.blur, params.contrast, params.min_pixels)
    return np.asarray(graph.processImage(photo))


def fitted_planes(regions: Int32, inverse: Float64, params: PlaneParams) -> tuple[Float64, Float64]:
    """The planes of regions [h, w] with R ids, by their inverse depth [h, w], 0 where unknown.

    Returns [R, 3] a, b, c of each, for places as a share of the image, and [R, 3, 3] their covariance; NaN for regions
    that are not flat, or of which too little is known.
    """
    places, known = _places(regions.shape), inverse > 0
    count = int(regions.max()) + 1
    coefficients, covariances = np.full((count, 3), np.nan), np.full((count, 3, 3), np.nan)
    rows = np.flatnonzero(known)
    rows = rows[np.argsort(regions.ravel()[rows], kind="stable")]
    of_region = np.split(rows, np.searchsorted(regions.ravel()[rows], np.arange(1, count)))
    for region, own in enumerate(of_region):
        if len(own) >= params.min_known:
            where, there = places.reshape(-1, 3)[own], inverse.ravel()[own]
            on_it = on_plane(where, there, params.tolerance)
            if on_it.mean() >= params.flat:
                coefficients[region], covariances[region] = _least_squares(where[on_it], there[on_it])
    return coefficients, covariances


def on_plane(places: Float64, inverse: Float64, tolerance: float) -> Bool:
    """[N] which pixels lie on the plane that most lie on (RANSAC, Fischler & Bolles 1981).

    places: [N, 3] x, y, 1. inverse: [N] their inverse depth. tolerance: share of it that they may lie off the plane.
    """

    def near(planes: Float64, rows: NDArray[np.intp] | slice) -> Bool:
        return np.asarray(np.abs(places[rows] @ planes.T - inverse[rows, None]) < tolerance * inverse[rows, None])

    rng = np.random.default_rng(0)
    some = rng.permutation(len(places))[:_COMPARED]
    triples = some[rng.integers(0, len(some), (_SAMPLES, 3))]
    triples = triples[np.abs(np.linalg.det(places[triples])) > _THIN]
    if not len(triples):
        return np.zeros(len(places), bool)
    tried = np.linalg.solve(places[triples], inverse[triples, None])[..., 0]
    best = tried[near(tried, some).sum(axis=0).argmax()]
    on_it = near(best[None], slice(None))[:, 0]
    for _ in range(_REFITS):
        best, _ = _least_squares(places[on_it], inverse[on_it])
        on_it = near(best[None], slice(None))[:, 0]
    return on_it


def _least_squares(places: Float64, inverse: Float64) -> tuple[Float64, Float64]:
    """[3] the plane through pixels, and [3, 3] its covariance."""
    normal = np.linalg.pinv(places.T @ places)
    plane = normal @ (places.T @ inverse)
    variance = np.mean((places @ plane - inverse) ** 2) + (_SHARPEST * inverse.mean()) ** 2
    return plane, _ALIKE * variance * normal


def _places(size: tuple[int, int]) -> Float64:
    """[h, w, 3] x and y of each pixel's centre, as shares of the width and the height, and 1."""
    h, w = size
    y, x = np.meshgrid((np.arange(h) + 0.5) / h, (np.arange(w) + 0.5) / w, indexing="ij")
    return np.stack([x, y, np.ones(size)], axis=2)
