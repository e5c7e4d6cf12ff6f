"""The exposure and white balance of each photo, from surfaces that several photos show.

Every photo is taken to show the colours of the scene through an affine map of RGB of its own: photo = B (scene, 1).
Points of known depth are looked up in all photos that see them; colours of points and maps of photos are solved for in
turns (alternating least squares), robustly, since gloss, shadows and pixels beside an edge do not agree. Only ratios
between photos can be found: in the end the photo whose map changes least is made the reference, and its colours are the
scene's. Nothing is learnt with the Gaussians, so all trainings share the maps.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

from ss_flow.running import progress, warn
from ss_flow.task import Resources, task
from ss_flow.tasks.artifacts import Cameras, ColourTransform, DepthMap, Float32, Float64, Frame, Int32, SceneUnit
from ss_flow.tasks.geometry.cameras import backproject, camera_of
from ss_flow.tasks.geometry.images import averaged_valid, decode_rgb, decode_valid, size_within
from ss_flow.tasks.geometry.visibility import VisibilityParams, surface_points
from ss_flow.tasks.ranges import Count, Fraction, Positive

_SIDE = 320
"""Photos are compared at this size, pixels of the longer side, so that poses may be off by a pixel or two."""
_SAME_SURFACE = VisibilityParams(tau_depth=0.02, share_of_depth=0.5)
_MIN_VIEWS = 3
"""Photos that must show a point; two alone cannot tell which one is wrong."""
_UNCLIPPED = (0.02, 0.98)
"""Range of colours that a sensor does not cut off."""
_DISAGREES = 0.05
"""RGB difference at which an observation has lost half of its weight."""
_ROUNDS = 10
_FEW = 200
"""Observations that the prior weighs as many as, besides those that there are."""


@dataclass(frozen=True)
class ColourParams:
    """How the exposure and white balance of photos are evened out."""

    transform: Literal["affine", "none"] = "affine"
    """What each photo's colours go through before Split's points get them and Gaussians are trained on them: "none", as
    in the paper, or "affine", a 3 x 4 matrix, where photos differ (min_gain)."""
    points: Count = 10_000
    """Surface points that are looked up in the photos."""
    prior: Positive = 1e-2
    """How strongly a transform is drawn towards plain gains of its channels: the weight of a share of its points."""
    min_gain: Fraction = 0.35
    """Photos stay as they are unless so large a share of the disagreement about a point's colour goes, on points that
    the maps were not fitted to."""


class Observations(NamedTuple):
    """Colours of points in photos."""

    view: Int32
    """[M]."""
    point: Int32
    """[M]."""
    color: Float64
    """[M, 3] RGB, 0..1."""


@task(name="capture.colours", resources=Resources(memory_mb=800))
def colours(
    frames: tuple[Frame, ...], cameras: Cameras, depths: tuple[DepthMap, ...], unit: SceneUnit, *, params: ColourParams
) -> tuple[ColourTransform, ...]:
    """The transform of each photo's colours to those of one of them; identity for a photo that shares no surface.

    All are identity where photos agree already (`min_gain`): a fixed exposure is better than an estimate of it. Pixels
    of unknown depth, those that a frame masks out and those near black or white count nowhere. Says so where colours
    are changed.
    """
    found = _observations(frames, cameras, depths, unit, params.points)
    gained = gain(found, len(frames), params.prior)
    if gained < params.min_gain:
        return tuple(ColourTransform(frame.name, "", np.eye(4)[:3]) for frame in frames)
    to_photo = photo_maps(found, len(frames), params.prior)
    reference = int(np.abs(to_photo - np.eye(4)[:3]).sum(axis=(1, 2)).argmin())
    in_scene = _square(to_photo[reference]) @ np.linalg.inv(_square(to_photo))
    warn(
        f"Exposure or white balance change from photo to photo: points and Gaussians get the colours of photo "
        f"{frames[reference].name}, which takes {gained:.0%} of the differences away. "
        "capture.colours.transform=none leaves photos as they are."
    )
    return tuple(
        ColourTransform(frame.name, frames[reference].name, matrix[:3])
        for frame, matrix in zip(frames, in_scene, strict=True)
    )


def photo_maps(found: Observations, num_views: int, prior: float) -> Float64:
    """[K, 3, 4] from colours of the scene to colours of each photo, whose mean changes nothing.

    prior: weight of a photo's gains, as a share of the observations' own.
    """
    view, point, color = found
    if not len(view):
        return _affine(np.ones((num_views, 3)))
    count = int(point.max()) + 1
    weight, seen = np.ones(len(view)), np.bincount(view, minlength=num_views)
    gains = np.ones((num_views, 3))
    for _ in range(_ROUNDS):
        gains = _gains(found, weight * np.square(color.mean(axis=1)), num_views, count)
        scene = _means(color / gains[view], point, weight, count)
        weight = _weights(color - gains[view] * scene[point])
    first = maps = _affine(gains)
    pull = prior * (seen + _FEW)
    for _ in range(_ROUNDS):
        turned = maps[:, :, :3].transpose(0, 2, 1)
        squares = _added(weight[:, None, None] * (turned @ maps[:, :, :3])[view], point, count)
        sides = _added(weight[:, None, None] * (turned[view] @ (color - maps[view, :, 3])[..., None]), point, count)
        scene = _solved(squares + 1e-9 * np.eye(3), sides)[..., 0]
        ones = np.concatenate([scene, np.ones((count, 1))], axis=1)[point]
        squares = _added(weight[:, None, None] * ones[:, :, None] * ones[:, None], view, num_views)
        sides = _added(weight[:, None, None] * ones[:, :, None] * color[:, None], view, num_views)
        squares += pull[:, None, None] * np.eye(4)
        sides += pull[:, None, None] * first.transpose(0, 2, 1)
        maps = _solved(squares, sides).transpose(0, 2, 1)
        weight = _weights(color - (maps[view] @ ones[..., None])[..., 0])
    return maps


def gain(found: Observations, num_views: int, prior: float) -> float:
    """0..1 share of the disagreement of photos about a point's colour that maps fitted to other points take away."""
    held_out = found.point % 2 == 1
    if not held_out.any():
        return 0.0
    fitted, rest = (Observations(*(a[rows] for a in found)) for rows in (~held_out, held_out))
    to_scene = np.linalg.inv(_square(photo_maps(fitted, num_views, prior)))[rest.view]
    ones = np.concatenate([rest.color, np.ones((len(rest.color), 1))], axis=1)

    def disagreement(colors: Float64) -> float:
        mean = _means(colors, rest.point, np.ones(len(colors)), int(rest.point.max()) + 1)
        return float(np.abs(colors - mean[rest.point]).mean() / colors.std())

    before = disagreement(rest.color)
    return max(0.0, 1 - disagreement((to_scene @ ones[..., None])[:, :3, 0]) / before) if before > 0 else 0.0


def _gains(found: Observations, weight: Float64, num_views: int, count: int) -> Float64:
    """[K, 3] factors of each photo's channels, whose geometric mean is 1: least squares of logarithms.

    weight: [M]; with the squared brightness in it, errors of colours count and not those of their logarithms, which
    are largest where it is dark. Colours of points are eliminated, which leaves one equation a photo.
    """
    from scipy.sparse import csr_array

    view, point, color = found
    at = csr_array((weight, (point, view)), shape=(count, num_views))
    logs = csr_array((np.ones(len(view)), (np.arange(len(view)), view)), shape=(len(view), num_views))
    share = at.multiply(1 / np.maximum(at.sum(axis=1), 1e-12)[:, None]).tocsr()
    laplacian = np.diag(at.sum(axis=0)) - (at.T @ share).toarray()
    log = np.log(color)
    off = weight[:, None] * (log - _means(log, point, weight, count)[point])
    solved = np.linalg.solve(laplacian + np.eye(num_views), logs.T @ off)
    return np.exp(solved - solved.mean(axis=0))


def _affine(gains: Float64) -> Float64:
    """[K, 3, 4] of [K, 3]."""
    return np.concatenate([gains[:, :, None] * np.eye(3), np.zeros((len(gains), 3, 1))], axis=2)


def _weights(off: Float64) -> Float64:
    """[M] of observations, by how far they are off: [M, 3]."""
    return 1 / (1 + np.square(off).sum(axis=1) / _DISAGREES**2)


def _means(values: Float64, rows: Int32, weight: Float64, length: int) -> Float64:
    """Weighted means of the values [M, C] by row."""
    return (
        _added(weight[:, None] * values, rows, length) / np.maximum(np.bincount(rows, weight, length), 1e-12)[:, None]
    )


def _solved(squares: Float64, sides: Float64) -> Float64:
    return np.asarray(np.linalg.solve(squares, sides), np.float64)


def _added(values: Float64, rows: Int32, length: int) -> Float64:
    """Sums of the values [M, ...] by row."""
    flat = values.reshape(len(values), -1).T
    sums = np.stack([np.bincount(rows, column, length) for column in flat], axis=-1).astype(np.float64, copy=False)
    return sums.reshape(length, *values.shape[1:])


def _square(maps: Float64) -> Float64:
    """[..., 4, 4] of [..., 3, 4]."""
    last = np.broadcast_to(np.array([[0.0, 0, 0, 1]]), (*maps.shape[:-2], 1, 4))
    return np.concatenate([maps, last], axis=-2)


def _observations(
    frames: tuple[Frame, ...], cameras: Cameras, depths: tuple[DepthMap, ...], unit: SceneUnit, most: int
) -> Observations:
    """Points of known depth, about as many from each view, and their colours in all photos that see them."""
    import cv2

    rng = np.random.default_rng(0)
    points = np.concatenate(
        [_some_points(depth, cameras, view, -(-most // len(frames)), rng) for view, depth in enumerate(depths)]
    )
    views, rows, colors = [], [], []
    for view, (frame, depth) in enumerate(zip(frames, depths, strict=True)):
        progress(view, len(frames), frame.name)
        size = size_within(_SIDE, frame.width, frame.height)
        photo = cv2.resize(decode_rgb(frame), size, interpolation=cv2.INTER_AREA).astype(np.float64) / 255
        valid = averaged_valid(decode_valid(frame), *size)
        row, x, y, _ = surface_points(points, camera_of(cameras, view).scaled(*size), depth, _SAME_SURFACE, unit.length)
        color = photo[y, x]
        counts = valid[y, x] & (color > _UNCLIPPED[0]).all(axis=1) & (color < _UNCLIPPED[1]).all(axis=1)
        views.append(np.full(int(counts.sum()), view, np.int32))
        rows.append(row[counts])
        colors.append(color[counts])
    point = np.concatenate(rows)
    shared = np.bincount(point, minlength=len(points))[point] >= _MIN_VIEWS
    _, renumbered = np.unique(point[shared], return_inverse=True)
    return Observations(np.concatenate(views)[shared], renumbered.astype(np.int32), np.concatenate(colors)[shared])


def _some_points(depth: DepthMap, cameras: Cameras, view: int, most: int, rng: np.random.Generator) -> Float32:
    """[N, 3] world: some of the pixels whose depth is known."""
    height, width = depth.depth.shape
    known = np.flatnonzero(depth.depth)
    chosen = rng.choice(known, min(most, len(known)), replace=False)
    return backproject(depth.depth, camera_of(cameras, view).scaled(width, height))[chosen].astype(np.float32)
