"""Whether the views of a capture fit together: pictures, poses and depth of neighbours compared.

Each view's pixels are carried by their depth into a neighbour. Where poses, intrinsics and depth are right, the
neighbour's depth is met there, and its photo shows the same thing. What does not fit is told with its figures; nothing
is changed.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from ss_flow.running import progress, warn
from ss_flow.task import task
from ss_flow.tasks.artifacts import Cameras, CaptureChecks, DepthMap, Float32, Float64, Frame
from ss_flow.tasks.capture.ingest import first_of
from ss_flow.tasks.geometry.cameras import Camera, backproject, camera_of, pixels_in_view
from ss_flow.tasks.geometry.images import decode_rgb, size_within
from ss_flow.tasks.ranges import Fraction, NonNegative

_SIDE = 160
"""Longer side of the images that are compared."""
_NEIGHBOURS = 2
_MOST_PIXELS, _LEAST_PIXELS = 4000, 200
"""So many pixels of a view are carried, evenly chosen, and so many must be met in the neighbour."""
_OCCLUDED = 0.25
"""Relative difference of depth beyond which something else stands in front."""
_SCALES = np.exp(np.arange(-0.7, 0.701, 0.05))
"""Factors on the depth that are tried."""
_TIED = 1 / 3
"""Weight of an exposure of 1 against a factor between neighbours: errors of many factors must not add up over a walk.
Slow changes are told as less than they are."""
_SAME_PICTURE = 1.0
"""Mean difference of grey values, of 255, below which two photos are the same."""


@dataclass(frozen=True)
class CheckParams:
    """From when on the views of a capture are told to misfit."""

    max_depth_error: NonNegative = 0.025
    """Relative difference of neighbours' depth, the median over all views, above which poses and depth disagree."""
    max_view_error: NonNegative = 4.0
    """A view is told of whose difference is so many times the median of all views', and above a hundredth."""
    min_scale_gain: Fraction = 0.3
    """Share of that difference which another scale of the depth must take away to be told of."""
    min_likeness: Fraction = 0.35
    """How much less than the median of all views' a photo's correlation with its neighbours may be."""
    max_exposure: NonNegative = 1.35
    """Factor between the darkest and the brightest exposure, 5th to 95th percentile, above which it is told of."""
    max_center: Fraction = 0.08
    """How far the principal point may lie from the photo's middle, as a share of its longer side."""


@task(name="capture.checks")
def checks(
    frames: Sequence[Frame], cameras: Cameras, depths: Sequence[DepthMap], *, params: CheckParams = CheckParams()
) -> CaptureChecks:
    """Compare each view with its two nearest neighbours, and warn of what does not fit.

    Neighbours are the views whose cameras are nearest and look alike. Told of are duplicates, principal points far from
    the middle, depth of another scale, poses that disagree with depth (all, or single ones), photos that show something
    else than their neighbours, and exposures that change. All lists are in the order of the frames.
    """
    small = [_grey(frame) for frame in frames]
    sized = [camera_of(cameras, view).scaled(*image.shape[::-1]) for view, image in enumerate(small)]
    maps = [_resized(depth.depth, image.shape) for depth, image in zip(depths, small, strict=True)]
    clouds = [_cloud(camera, depth) for camera, depth in zip(sized, maps, strict=True)]
    error, likeness, gains = np.full(len(frames), np.nan), np.full(len(frames), np.nan), []
    by_scale = np.zeros((0, len(_SCALES)))
    for view, frame in enumerate(frames):
        met = []
        for other in _neighbours(cameras, view):
            found = _carried(clouds[view], sized, (view, other), small, maps[other])
            if found is not None:
                errors, alike, gain = found
                met.append((errors, alike))
                gains.append((view, other, gain))
        if met:
            table = np.array([errors for errors, _ in met])
            by_scale = np.concatenate([by_scale, table])
            error[view] = np.median(table[:, len(_SCALES) // 2])
            likeness[view] = max(alike for _, alike in met)
        progress(view + 1, len(frames), frame.name)
    exposure = _exposures(len(frames), gains)
    found_scale = _scale(by_scale, params)
    names = tuple(frame.name for frame in frames)
    result = CaptureChecks(names, error, likeness, exposure, found_scale, _duplicates(names, small))
    for text in _told(result, cameras, params):
        warn(text)
    return result


def _told(found: CaptureChecks, cameras: Cameras, params: CheckParams) -> Iterable[str]:
    """What is to be said, with figures."""
    names = np.array(found.names)
    if found.duplicates:
        share = len(found.duplicates) / len(names)
        yield f"{len(found.duplicates)} photos ({share:.0%}) repeat an earlier one: {first_of(found.duplicates)}."
    off = np.abs(cameras.intrinsics[:, 2:] - cameras.sizes / 2).max(axis=1) / cameras.sizes.max(axis=1)
    if len(off) and off.max() > params.max_center:
        worst = int(off.argmax())
        cx, cy = cameras.intrinsics[worst, 2:]
        width, height = cameras.sizes[worst]
        yield (
            f"The principal point of {(off > params.max_center).sum()} views lies far from the middle, that of "
            f"{names[worst]} at ({cx:.0f}, {cy:.0f}) of {width} x {height} pixels; are its intrinsics exchanged?"
        )
    known = found.depth_error[np.isfinite(found.depth_error)]
    if not len(known):
        return
    usual = float(np.median(known))
    if found.depth_scale != 1:
        yield (
            f"Depth fits the poses {found.depth_scale:.2f} times as large: neighbours' depth then differs clearly less "
            f"than now (median {usual:.1%}); is its unit right?"
        )
    elif usual > params.max_depth_error:
        yield f"Depth carried from view to view differs by {usual:.1%} (median): poses, intrinsics and depth disagree."
    with np.errstate(invalid="ignore"):
        odd = found.depth_error > max(params.max_view_error * usual, 0.01)
        strange = found.likeness < np.nanmedian(found.likeness) - params.min_likeness
    if strange.any():
        worst = int(np.nanargmin(found.likeness))
        yield (
            f"{strange.sum()} photos do not show what their neighbours do (correlation {found.likeness[worst]:.2f}, "
            f"usually {np.nanmedian(found.likeness):.2f}): {first_of(names[strange].tolist())}; turned, or elsewhere?"
        )
    if (odd & ~strange).any():
        worst = int(np.nanargmax(np.where(odd & ~strange, found.depth_error, np.nan)))
        yield (
            f"The poses of {(odd & ~strange).sum()} views do not fit their depth (difference to neighbours "
            f"{found.depth_error[worst]:.1%}, usually {usual:.1%}): {first_of(names[odd & ~strange].tolist())}."
        )
    low, high = np.quantile(found.exposure, (0.05, 0.95))
    if high / low > params.max_exposure:
        yield (
            f"The photos' exposure changes by a factor of {high / low:.2f} between nearby views; "
            "capture.colours.transform=affine takes it out before training."
        )


def _grey(frame: Frame) -> Float32:
    """[h, w] 0..255, linear enough to compare."""
    import cv2

    image = cv2.cvtColor(decode_rgb(frame), cv2.COLOR_RGB2GRAY)
    return cv2.resize(image, size_within(_SIDE, frame.width, frame.height), interpolation=cv2.INTER_AREA).astype(
        np.float32
    )


def _resized(depth: Float32, shape: tuple[int, ...]) -> Float32:
    import cv2

    return np.asarray(cv2.resize(depth, shape[::-1], interpolation=cv2.INTER_NEAREST_EXACT), np.float32)


def _cloud(camera: Camera, depth: Float32) -> tuple[Float64, np.ndarray]:
    """[n, 3] some pixels with depth in the camera's frame, and their flat indices."""
    at_home = Camera(camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy, np.eye(4))
    known = np.flatnonzero(depth > 0)
    known = known[:: -(-len(known) // _MOST_PIXELS) or 1]
    return backproject(depth, at_home)[known], known


def _neighbours(cameras: Cameras, view: int) -> list[int]:
    """The nearest views that look the same way, within 45 degrees."""
    poses = cameras.world_to_camera
    centres = -np.einsum("kji,kj->ki", poses[:, :3, :3], poses[:, :3, 3])
    distance = np.linalg.norm(centres - centres[view], axis=1)
    distance[(poses[:, 2, :3] @ poses[view, 2, :3]) < np.sqrt(0.5)] = np.inf
    distance[view] = np.inf
    nearest = np.argsort(distance, kind="stable")[:_NEIGHBOURS]
    return [int(other) for other in nearest if np.isfinite(distance[other])]


def _carried(
    cloud: tuple[Float64, np.ndarray],
    cameras: Sequence[Camera],
    pair: tuple[int, int],
    small: Sequence[Float32],
    depth: Float32,
) -> tuple[Float64, float, float] | None:
    """A view carried into a neighbour: the median relative difference of depth for each scale, the correlation of their
    grey values, and the factor between these; None where they share too little.

    depth: of the neighbour.
    """
    view, other = pair
    points, pixels = cloud
    relative = cameras[other].world_to_camera @ np.linalg.inv(cameras[view].world_to_camera)
    at_home = cameras[other]
    home = Camera(at_home.width, at_home.height, at_home.fx, at_home.fy, at_home.cx, at_home.cy, relative)
    errors = np.full(len(_SCALES), np.nan)
    seen: tuple[float, float] | None = None
    for row, scale in enumerate(_SCALES):
        rows, u, v, z = pixels_in_view(points * scale, home)
        measured = depth[v, u] * scale
        known = measured > 0
        if known.sum() < _LEAST_PIXELS:
            continue
        difference = np.abs(z[known] / measured[known] - 1)
        errors[row] = np.median(np.minimum(difference, _OCCLUDED))
        if row == len(_SCALES) // 2:
            visible = known.copy()
            visible[known] = difference < _OCCLUDED
            a, b = small[view].ravel()[pixels[rows[visible]]], small[other][v[visible], u[visible]]
            if len(a) >= _LEAST_PIXELS and a.std() > 1 and b.std() > 1:
                seen = float(np.corrcoef(a, b)[0, 1]), float(np.median((b + 1) / (a + 1)))
    if seen is None:
        return None
    return errors, *seen


def _scale(by_scale: Float64, params: CheckParams) -> float:
    """The factor on the depth that makes neighbours agree best, 1 where it is hardly better than none."""
    enough = 2 * np.isfinite(by_scale).sum(axis=0) >= max(len(by_scale), 1)
    if not enough[len(_SCALES) // 2]:
        return 1.0
    curve = np.full(len(_SCALES), np.inf)
    curve[enough] = np.nanmedian(by_scale[:, enough], axis=0)
    best, now = int(curve.argmin()), curve[len(_SCALES) // 2]
    clear = curve[best] < (1 - params.min_scale_gain) * now and now > 0.01 and abs(np.log(_SCALES[best])) > 0.07
    return float(_SCALES[best]) if clear else 1.0


def _exposures(count: int, gains: Sequence[tuple[int, int, float]]) -> Float64:
    """[K] the exposure of each view, 1 on (geometric) average: log factors between neighbours, by least squares."""
    if not gains:
        return np.ones(count)
    system, side = np.zeros((len(gains) + count, count)), np.zeros(len(gains) + count)
    for row, (view, other, gain) in enumerate(gains):
        system[row, other], system[row, view], side[row] = 1, -1, np.log(gain)
    system[len(gains) :] = _TIED * np.eye(count)
    return np.exp(np.linalg.lstsq(system, side, rcond=None)[0])


def _duplicates(names: Sequence[str], small: Sequence[Float32]) -> tuple[str, ...]:
    """The views whose photo is that of an earlier one."""
    found: list[str] = []
    kept: list[tuple[float, Float32]] = []
    for name, image in zip(names, small, strict=True):
        mean = float(image.mean())  # that of the difference is no less than the difference of the means
        alike = (one for of_one, one in kept if abs(mean - of_one) < _SAME_PICTURE and one.shape == image.shape)
        if any(np.abs(image - one).mean() < _SAME_PICTURE for one in alike):
            found.append(name)
        else:
            kept.append((mean, image))
    return tuple(found)
