"""Whether depth lies where its photos show it: edges of depth against edges of the photo, over several views.

A depth camera of another focal length whose images pass for registered ones shows everything at a wrong place, by tens
of pixels in the corners. Where depth jumps, the nearer side is the outline of something, and the photo mostly has an
edge there; that tells the scale about the principal point and the shift that bring the two together.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ss_flow.running import in_threads, warn
from ss_flow.task import Resources, task
from ss_flow.tasks.artifacts import Cameras, DepthMap, Float32, Float64, Frame, Registration
from ss_flow.tasks.capture.lens import found_lens, undistortion_map
from ss_flow.tasks.geometry.holes import close_holes
from ss_flow.tasks.geometry.images import decode_rgb, resampled, size_within
from ss_flow.tasks.ranges import Count, Fraction
from ss_flow.tasks.unread import by_default

_SIDE = 320
"""Longer side of the images that are compared, at most; all lengths below are pixels of these."""
_SCALES = np.exp(np.arange(-0.2, 0.201, 0.01))
_REACH = 12
"""Largest shift that is looked for."""
_LEAST_EDGE, _LEAST_OUTLINE = 10, 50
"""Connected pixels of an outline below which it is noise, and points of all outlines that a view needs to count."""
_LEAST_VIEWS = 4
_BLIND = 4
"""How far from an edge a sensor may see nothing."""
_APART = 3.0
"""How far apart, at the photo's border, two halves of the views may place the depth and still mean the same."""
_IDENTITY = (1.0, 0.0, 0.0)
_CLEARLY = 1.02
"""So much better edges fit where depth is bent or straight as it should be; it is a tenth where outlines are many."""

Placing = tuple[float, float, float]
"""Scale about the principal point, then shift along x and y."""


@dataclass(frozen=True)
class RegistrationParams:
    """How depth is compared with the photos."""

    views: Count = 16
    """The most views that are compared, spread evenly."""
    jump: Fraction = 0.05
    """Step in depth, as a share of the depth, that counts as an edge."""
    tau_found: Fraction = 0.1
    """Gain from which another scale and shift count as found; calibrate=depth then applies them. The gain is the share
    of the agreement between edges of depth and of photo that is lost without them."""
    tau_clear: Fraction = 0.2
    """Gain from which they are clear: calibrate=auto then applies them, and calibrate=none warns."""

    def in_use(self, *, advise: bool) -> RegistrationParams:
        """For `registration`: tau_clear, where it does not warn, as by default, so that it does not enter the key."""
        return self if advise else by_default(self, "tau_clear")


@dataclass(frozen=True)
class _View:
    edges: Float32
    """[h, w] 0..1 how strong the photo's edges are."""
    outline: Float64
    """[N, 2] where depth has edges, from the principal point on."""
    center: Float64
    """[2] the principal point."""

    @functools.cached_property
    def neutral(self) -> float:
        """What counts for points beyond the photo, which speak neither for a placing nor against it."""
        return float(self.edges.mean())


@task(name="capture.registration", resources=Resources(cores=1, most_cores=8))
def registration(
    frames: Sequence[Frame],
    cameras: Cameras,
    depths: Sequence[DepthMap],
    *,
    advise: bool = True,
    params: RegistrationParams = RegistrationParams(),
) -> Registration:
    """The scale and shift under which the depth maps fit their photos best.

    All views together find them. They are believed only when both halves of the views find the same, and what one half
    finds holds for the other.
    advise: whether to warn where the depth maps had better be scaled and shifted.
    """
    views = _views(frames, cameras, depths, params)
    if len(views) < _LEAST_VIEWS:
        return Registration(1.0, np.zeros(2), 0.0)
    coarse = list(in_threads(_coarse_fits, views))
    found = _search(views, coarse)
    halves = views[::2], views[1::2]
    first, second = _search(halves[0], coarse[::2]), _search(halves[1], coarse[1::2])
    gained = min(
        _fit(halves[1], first) - _fit(halves[1], _IDENTITY), _fit(halves[0], second) - _fit(halves[0], _IDENTITY)
    )
    by_chance = float(np.mean([view.edges.mean() for view in views]))
    gain = max(0.0, gained / max(_fit(views, found) - by_chance, 1e-9))
    shifts_apart = np.abs(np.subtract(first[1:], second[1:])).max()
    agree = abs(first[0] - second[0]) * _SIDE / 2 + shifts_apart <= _APART
    if gain < params.tau_found or not agree:
        return Registration(1.0, np.zeros(2), gain)
    reduced = min(1.0, _SIDE / max(frames[0].width, frames[0].height))
    result = Registration(found[0], np.array(found[1:]) / reduced, gain)
    if advise and gain >= params.tau_clear:
        warn(
            f"Depth edges fit the photos better when the depth images are {_said(result)}; use --calibrate depth, or "
            "correct the capture's intrinsics."
        )
    return result


@task(name="capture.calibrated")
def calibrated(
    frames: Sequence[Frame], cameras: Cameras, depths: Sequence[DepthMap], registration: Registration
) -> tuple[DepthMap, ...]:
    """The depth maps, moved to where the photos show them: nearest pixels, 0 where the sensor saw nothing.

    z-depth is kept, as both cameras are taken to share their centre and axes.
    """
    import cv2

    if not registration.moves:
        warn("The depth images stay as they are: no other scale and shift fits the photos clearly better.")
        return tuple(depths)
    warn(
        f"The depth images were {_said(registration)}, so that their edges fit the photos. capture.calibrate=none "
        "keeps them as they are."
    )
    result = []
    for frame, intrinsics, depth in zip(frames, cameras.intrinsics, depths, strict=True):
        height, width = depth.depth.shape
        per_pixel = np.array([width / frame.width, height / frame.height])
        center, shift = intrinsics[2:] * per_pixel, registration.shift * per_pixel
        # Pixel centres are integers here.
        offset = center + shift - registration.scale * center + 0.5 * registration.scale - 0.5
        matrix = np.column_stack([registration.scale * np.eye(2), offset])
        moved = cv2.warpAffine(depth.depth, matrix, (width, height), flags=cv2.INTER_NEAREST)
        result.append(replace(depth, depth=moved))
    return tuple(result)


@task(name="capture.straightened", resources=Resources(cores=1, most_cores=8))
def straightened(
    frames: Sequence[Frame],
    cameras: Cameras,
    depths: Sequence[DepthMap],
    *,
    params: RegistrationParams = RegistrationParams(),
) -> tuple[DepthMap, ...]:
    """Depth beside photos out of which `registered` took a distortion that the capture does not state: straightened
    too, where its edges fit them clearly better so.

    Some of the programs that lay depth onto photos bend it as these are bent; others know nothing of their lens.
    """
    import cv2

    straight = []
    for row, depth in enumerate(depths):
        source = undistortion_map(found_lens(cameras, row).scaled(*depth.depth.shape[::-1]))
        straight.append(replace(depth, depth=cv2.remap(depth.depth, source, None, cv2.INTER_NEAREST)))
    given, other = (_views(frames, cameras, some, params) for some in (depths, straight))
    if min(len(given), len(other)) < _LEAST_VIEWS or _fit(other, _IDENTITY) < _CLEARLY * _fit(given, _IDENTITY):
        return tuple(depths)
    warn("The depth images were bent as their photos were, and straightened likewise, so that their edges fit.")
    return tuple(straight)


def _said(found: Registration) -> str:
    x, y = found.shift
    return f"scaled by {found.scale:.3f} and shifted by ({x:+.1f}, {y:+.1f}) pixels"


def _views(
    frames: Sequence[Frame], cameras: Cameras, depths: Sequence[DepthMap], params: RegistrationParams
) -> list[_View]:
    """Those of some views that have outlines."""
    chosen = np.unique(np.linspace(0, len(frames) - 1, min(params.views, len(frames))).round().astype(int))
    some = ((frames[k], cameras.intrinsics[k], depths[k]) for k in chosen.tolist())
    looked = in_threads(lambda given: _view(*given, params.jump), some)
    return [view for view in looked if len(view.outline) >= _LEAST_OUTLINE]


def _view(frame: Frame, intrinsics: Float64, depth: DepthMap, jump: float) -> _View:
    import cv2

    width, height = size_within(_SIDE, frame.width, frame.height)
    small = cv2.resize(decode_rgb(frame), (width, height), interpolation=cv2.INTER_AREA)
    lab = cv2.GaussianBlur(cv2.cvtColor(small, cv2.COLOR_RGB2LAB).astype(np.float32), (0, 0), 1)
    slopes = cv2.Sobel(lab, -1, 1, 0), cv2.Sobel(lab, -1, 0, 1)
    strength = np.sqrt(sum((slope**2).sum(axis=2) for slope in slopes))
    # A strong edge counts little more than a clear one.
    edges = strength / (strength + 3 * np.median(strength) + 1e-6)
    values = close_holes(depth.depth)
    if values.shape[0] > height:
        values = resampled(values, height, width)
    center = intrinsics[2:] * (width / frame.width, height / frame.height)
    scale = width / values.shape[1], height / values.shape[0]
    return _View(edges.astype(np.float32), _outline(values, jump) * scale - center, center)


def _outline(depth: Float32, jump: float) -> Float64:
    """[N, 2] x, y where surfaces end before something farther: the borders of known pixels to pixels that are farther
    or unknown, with something farther known within 4 pixels, since sensors see nothing right beside an edge."""
    import cv2

    known = depth > 0
    farther = cv2.dilate(depth, np.ones((2 * _BLIND + 1, 2 * _BLIND + 1), np.uint8)) > (1 + jump) * depth
    around = np.pad(np.where(known, depth, np.float32(np.inf)), 1, mode="edge")
    height, width = depth.shape
    steps = ((0, 1), (0, -1), (1, 0), (-1, 0))
    beside = [around[1 + y : 1 + y + height, 1 + x : 1 + x + width] for y, x in steps]
    ends = [known & farther & (other > (1 + jump) * depth) for other in beside]
    _, part, stats, _ = cv2.connectedComponentsWithStats(np.any(ends, axis=0).astype(np.uint8), connectivity=8)
    large = (stats[:, cv2.CC_STAT_AREA] >= _LEAST_EDGE)[part]
    # Half a pixel on from the pixel's centre lies its border.
    at = [np.argwhere(end & large) + 0.5 + 0.5 * np.array(step) for end, step in zip(ends, steps, strict=True)]
    return np.concatenate(at)[:, ::-1]


def _fit(views: Sequence[_View], placing: Placing) -> float:
    """0..1 how strong the photos' edges are along the outlines, placed so; a mean over views."""
    import cv2

    scale, *shift = placing
    fits = []
    for view in views:
        at = (view.outline * scale + view.center + shift - 0.5).astype(np.float32)
        here = cv2.remap(
            view.edges, at[:, None], None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=view.neutral
        )
        fits.append(float(here.mean()))
    return float(np.mean(fits))


def _search(views: Sequence[_View], coarse: Sequence[Float32]) -> Placing:
    """The placing that fits best: a descent from the best of the coarse ones.

    coarse: `_coarse_fits` of each view.
    """
    from scipy.optimize import minimize

    fits = np.mean(coarse, axis=0)
    s, y, x = np.unravel_index(int(fits.argmax()), fits.shape)
    fine = _blurred(views, 1)
    # In units of about one pixel at the photo's border.
    start = np.array([np.log(_SCALES[s]) * _SIDE / 2, x - _REACH, y - _REACH])
    simplex = np.vstack([start, start + np.diag([1.5, 1.5, 1.5])])

    def placing(at: Float64) -> Placing:
        return float(np.exp(at[0] * 2 / _SIDE)), float(at[1]), float(at[2])

    options = {"initial_simplex": simplex, "xatol": 0.02, "fatol": 1e-6}
    return placing(minimize(lambda at: -_fit(fine, placing(at)), start, method="Nelder-Mead", options=options).x)


def _blurred(views: Sequence[_View], sigma: float) -> list[_View]:
    import cv2

    return [replace(view, edges=cv2.GaussianBlur(view.edges, (0, 0), sigma)) for view in views]


def _coarse_fits(view: _View) -> Float32:
    """[S, 2 R + 1, 2 R + 1] the fit of a view, its edges blurred, at every scale and whole shift (y, x) up to R."""
    from scipy import fft

    (view,) = _blurred([view], 2)
    height, width = view.edges.shape
    padded = np.pad(view.edges, _REACH, constant_values=view.neutral)
    # Of all scales the photo is the same, so it is transformed once; and of the shifts only these are wanted.
    size = [fft.next_fast_len(side, real=True) for side in padded.shape]
    photo, shifts = fft.rfft2(padded, size), slice(2 * _REACH + 1)
    fits = []
    for scale in _SCALES.tolist():
        at = np.floor(view.outline * scale + view.center).astype(int)
        at = at[((at >= 0) & (at < (width, height))).all(axis=1)]
        drawn = np.bincount(at[:, 1] * width + at[:, 0], minlength=height * width).astype(np.float32)
        product = photo * fft.rfft2(drawn.reshape(height, width), size).conj()
        fit = fft.irfft(fft.ifft(product, axis=0)[shifts], size[1])[:, shifts]
        fits.append(fit + view.neutral * (len(view.outline) - len(at)))
    return np.asarray(np.stack(fits) / len(view.outline), np.float32)
