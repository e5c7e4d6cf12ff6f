"""Whether the views of a capture fit together: pictures, poses and depth of neighbours compared.

Each view's pixels are carried by their depth into a neighbour. Where poses, intrinsics and depth are right, the
neighbour's depth is met there, and its photo shows the same thing. What does not fit is told with its figures; nothing
is changed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ss_flow.running import progress, warn
from ss_flow.task import task
from ss_flow.tasks.artifacts import Cameras, CaptureChecks, DepthMap, Float32, Float64, Frame
from ss_flow.tasks.capture.misfits import CheckParams, coarse, told
from ss_flow.tasks.capture.scene_files import OPENGL_TO_OPENCV
from ss_flow.tasks.geometry.cameras import Camera, backproject, camera_of, nearest_views, pixels_in_view
from ss_flow.tasks.geometry.images import decode_rgb, size_within

_SIDE = 160
"""Longer side of the images that are compared."""
_NEIGHBOURS = 2
_MOST_PIXELS, _LEAST_PIXELS = 4000, 200
"""So many pixels of a view are carried, evenly chosen, and so many must be met in the neighbour."""
_OCCLUDED = 0.25
"""Relative difference of depth beyond which something else stands in front."""
_NEAR = np.exp(0.05 * np.arange(-14, 15))
"""Factors on the depth that are tried."""
_NOW = len(_NEAR) // 2
"""The one in the middle, 1."""
_FAR = np.exp(0.25 * np.arange(-29, 30))
"""Those that are tried, and then the near ones around the best, where none of the near ones makes depth fit: as with
millimetres taken for metres."""
_ENDLESS = 1e6
"""A factor by which depth fits as well as without any motion of the camera between two views. What fits hardly better
says nothing of scale."""
_FITS = 0.01
"""A median difference up to which another factor says nothing."""
_FAR_PAIRS = 40
"""So many pairs of views are enough to find a far one."""
_TIED = 1 / 3
"""Weight of an exposure of 1 against a factor between neighbours: errors of many factors must not add up over a walk.
Slow changes are told as less than they are."""
_MIRRORS = [np.diag(signs) for signs in ([1.0, -1.0, 1.0, 1.0], [1.0, 1.0, -1.0, 1.0], [-1.0, 1.0, 1.0, 1.0])]
"""Along y, z and x of the camera and of the world."""
_FLAT, _TEXTURED = 1, 8
"""Grey values with a standard deviation up to the former show nothing, and from the latter on something."""
_SAME_PICTURE = 1.0
"""Mean difference of grey values, of 255, below which two photos are the same."""


@task(name="capture.checks")
def checks(
    frames: Sequence[Frame], cameras: Cameras, depths: Sequence[DepthMap], *, params: CheckParams = CheckParams()
) -> CaptureChecks:
    """Compare each view with its two nearest neighbours, and warn of what does not fit.

    Neighbours are the views whose cameras are nearest and look the same way. Told of are a scene so far from the
    world's origin that numbers are coarse, duplicates, principal points far from the middle, depth of another scale,
    poses that disagree with depth (all, or single ones), and, by the scale that fits, photos that show something else
    than their neighbours, and exposures that change. All lists are in the order of the frames.
    """
    views = [_view(frame, camera_of(cameras, row), depths[row]) for row, frame in enumerate(frames)]
    pairs: list[tuple[int, int]] = []
    ahead: list[float] = []
    for row, frame in enumerate(frames):
        for other in nearest_views(cameras, row, _NEIGHBOURS):
            pairs.append((row, other))
            ahead.append(_error(views[row], views[other]))
        progress(row + 1, len(frames), frame.name)
    scale = _scale([(views[row], views[other]) for row, other in pairs], ahead, params)
    error, likeness, gains = np.full(len(frames), np.nan), np.full(len(frames), np.nan), []
    now: dict[int, list[float]] = {}
    for (row, other), error_ahead in zip(pairs, ahead, strict=True):
        # A wrong pose differs both ways. One way alone, as where a view has no depth of what stands close before it and
        # its neighbour has, something hides the rest.
        differs = np.fmin(error_ahead, _error(views[other], views[row]))
        if np.isfinite(differs):
            now.setdefault(row, []).append(differs)
            error[row] = np.median(now[row])
        if _blank(views[row], views[other], scale):
            likeness[row] = np.fmax(likeness[row], 0)
        alike = _alike(views[row], views[other], scale)
        if alike is not None:
            likeness[row] = np.fmax(likeness[row], alike[0])
            gains.append((row, other, alike[1]))
    names, exposure = tuple(frame.name for frame in frames), _exposures(len(frames), gains)
    duplicates = _duplicates(names, [view.grey for view in views])
    result = CaptureChecks(names, error, likeness, exposure, scale, duplicates)
    known = error[np.isfinite(error)]
    misfit = bool(pairs) and scale == 1 and not (len(known) and np.median(known) <= params.max_depth_error)
    exchanged = _exchanged(views, cameras, params) if misfit else ""
    centers = np.array([view.camera.center for view in views]).reshape(-1, 3)
    measured = np.concatenate([np.zeros(0, np.float32), *(view.depth[view.depth > 0] for view in views)])
    depth = float(np.median(measured)) if len(measured) else np.nan
    for text in (*coarse(centers, depth), *told(result, cameras, params, compared=bool(pairs), exchanged=exchanged)):
        warn(text)
    return result


def _exchanged(views: Sequence[_View], cameras: Cameras, params: CheckParams) -> str:
    """Which exchange of conventions makes poses fit depth, as the end of a sentence; "" where none does.

    Only how cameras lie to each other counts, so the axes of the world are of no concern.
    """
    given = cameras.world_to_camera.astype(np.float64)
    inverse = np.linalg.inv(given)
    inverted = "the poses are inverted: camera-to-world and world-to-camera are exchanged"
    turned = "y and z of the cameras are turned: OpenGL's axes and OpenCV's are exchanged"
    mirrored = "the poses are mirrored: they are those of a left-handed world, as Unity's is"
    tried = [(inverse, inverted), (OPENGL_TO_OPENCV @ inverse, inverted), (OPENGL_TO_OPENCV @ given, turned)]
    tried += [(mirror @ given @ mirror, mirrored) for mirror in _MIRRORS]
    for meant, words in tried:
        moved = [replace(v, camera=replace(v.camera, world_to_camera=m)) for v, m in zip(views, meant, strict=True)]
        changed = replace(cameras, world_to_camera=meant)
        pairs = ((row, other) for row in range(len(views)) for other in nearest_views(changed, row, _NEIGHBOURS))
        errors = [_errors(moved[row], moved[other], np.array([1, _ENDLESS])) for row, other in pairs]
        if not errors:
            continue
        error, parallax = np.median(np.nan_to_num(errors, nan=_OCCLUDED), axis=0)
        if error <= min(params.max_depth_error, parallax / 2):
            return f"; they agree once {words}"
    return ""


@dataclass(frozen=True)
class _View:
    """One view at a size that is quick to compare."""

    grey: Float32
    """[h, w] 0..255, linear enough to compare."""
    depth: Float32
    """[h, w] 0 where unknown."""
    camera: Camera
    points: Float64
    """[n, 3] some pixels with depth, in the camera's frame."""
    pixels: NDArray[np.intp]
    """[n] which they are, in the flat image."""


def _view(frame: Frame, camera: Camera, depth: DepthMap) -> _View:
    import cv2

    size = size_within(_SIDE, frame.width, frame.height)
    grey = cv2.resize(cv2.cvtColor(decode_rgb(frame), cv2.COLOR_RGB2GRAY), size, interpolation=cv2.INTER_AREA)
    small = np.asarray(cv2.resize(depth.depth, size, interpolation=cv2.INTER_NEAREST_EXACT), np.float32)
    sized = camera.scaled(*size)
    known = np.flatnonzero(small > 0)
    known = known[:: -(-len(known) // _MOST_PIXELS) or 1]
    points = backproject(small, replace(sized, world_to_camera=np.eye(4)))[known]
    return _View(grey.astype(np.float32), small, sized, points, known)


def _error(view: _View, other: _View) -> float:
    """What `_errors` gives for depth as it is."""
    return float(_errors(view, other, np.ones(1))[0])


def _errors(view: _View, other: _View, scales: Float64) -> Float64:
    """[S] the median relative difference of a view's depth, carried to another one, and that one's, for each factor on
    both; NaN where they share too little."""
    errors = np.full(len(scales), np.nan)
    home = _from(view, other)
    for row, scale in enumerate(scales):
        _, u, v, z = pixels_in_view(view.points * scale, home)
        measured = other.depth[v, u]
        if (measured > 0).sum() >= _LEAST_PIXELS:
            errors[row] = np.median(_difference(z, scale * measured)[measured > 0])
    return errors


def _alike(view: _View, other: _View, scale: float) -> tuple[float, float] | None:
    """How a view's grey values go with another's where both show the same: the correlation, and the factor between
    them; None where they share too little.

    scale: a factor on the depth of both.
    """
    rows, u, v, z = pixels_in_view(view.points * scale, _from(view, other))
    measured = other.depth[v, u]
    visible = (measured > 0) & (_difference(z, scale * measured) < _OCCLUDED)
    a, b = view.grey.ravel()[view.pixels[rows[visible]]], other.grey[v[visible], u[visible]]
    if len(a) < _LEAST_PIXELS or a.std() <= _FLAT or b.std() <= _FLAT:
        return None
    return float(np.corrcoef(a, b)[0, 1]), float(np.median((b + 1) / (a + 1)))


def _blank(view: _View, other: _View, scale: float) -> bool:
    """Whether a view shows nothing at all where another one shows something; its own depth need not be known."""
    if view.grey.std() > _FLAT:
        return False
    rows, u, v, z = pixels_in_view(other.points * scale, _from(other, view))
    measured = view.depth[v, u]
    met = (measured == 0) | (_difference(z, scale * measured) < _OCCLUDED)
    shown = other.grey.ravel()[other.pixels[rows[met]]]
    return len(shown) >= _LEAST_PIXELS and bool(shown.std() > _TEXTURED)


def _from(view: _View, other: _View) -> Camera:
    """The other's camera, as seen in the frame of the first."""
    camera = other.camera
    relative = camera.world_to_camera @ np.linalg.inv(view.camera.world_to_camera)
    return replace(camera, world_to_camera=relative)


def _difference(carried: Float64, measured: NDArray[np.floating]) -> Float64:
    """Relative, 0 to that of an occlusion, which also stands where nothing was measured."""
    return np.minimum(np.abs(carried - measured) / np.maximum(measured, 1e-12), _OCCLUDED)


def _scale(pairs: Sequence[tuple[_View, _View]], ahead: Sequence[float], params: CheckParams) -> float:
    """The factor on the depth that makes neighbours agree best, 1 where it is hardly better than none.

    ahead: of each pair, the error of depth as it is. Where that is small no factor is looked for.
    """
    if len(ahead) and np.median(np.nan_to_num(ahead, nan=_OCCLUDED)) <= min(_FITS, params.max_depth_error):
        return 1.0
    curve = _curve([_errors(*pair, _NEAR) for pair in pairs])
    best, now = int(curve.argmin()), curve[_NOW]
    if curve[best] > params.max_depth_error:
        some = pairs[:: -(-len(pairs) // _FAR_PAIRS) or 1]
        around = _FAR[_curve([_errors(*pair, _FAR) for pair in some]).argmin()] * _NEAR
        far = _curve([_errors(*pair, around) for pair in some])
        parallax = _curve([_errors(*pair, np.array([_ENDLESS])) for pair in some])[0]
        if far.min() <= min(params.max_depth_error, parallax / 2):
            return float(around[far.argmin()])
    clear = curve[best] < (1 - params.min_scale_gain) * now and now > _FITS and abs(np.log(_NEAR[best])) > 0.07
    return float(_NEAR[best]) if clear else 1.0


def _curve(errors: Sequence[Float64]) -> Float64:
    """[S] the median over the pairs that are met at any scale; where one is not met, it differs most."""
    met = [np.nan_to_num(one, nan=_OCCLUDED) for one in errors if np.isfinite(one).any()]
    return np.median(met, axis=0) if met else np.full(len(_NEAR), _OCCLUDED)


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
