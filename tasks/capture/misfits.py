"""What is to be said of views that do not fit together, with the figures that `capture.checks` finds."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from ss_flow.tasks.artifacts import Cameras, CaptureChecks, Float64
from ss_flow.tasks.ranges import Fraction, NonNegative
from ss_flow.tasks.words import first_of

_COARSEST = 1e-3
"""A step between two float32 numbers at the cameras, as a share of the median depth, above which pictures suffer: a
generated room, moved away, is drawn with a PSNR of 56 dB to what it was at steps of 1 mm, and of 36 dB at 8 mm."""


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


def coarse(centers: Float64, depth: float) -> Iterable[str]:
    """What is to be said of cameras that stand far from the origin: points and Gaussians are float32.

    centers: [K, 3] of the cameras. depth: median of all views, nan where none is known.
    """
    farthest = float(np.abs(centers).max(initial=0))
    step = float(np.spacing(np.float32(farthest)))
    if step > _COARSEST * depth:
        yield (
            f"The cameras stand up to {farthest:,.0f} world units from the origin along an axis, where numbers have "
            f"steps of {step:.2g}, too coarse for depth of {depth:.3g} (median): subtract one offset from "
            "all poses, as the mean of the cameras' places, and from given points."
        )


def told(
    found: CaptureChecks, cameras: Cameras, params: CheckParams, *, compared: bool, exchanged: str
) -> Iterable[str]:
    """All the rest. compared: whether any view has others beside it. exchanged: what would make poses fit that do not,
    as the end of a sentence."""
    known = found.depth_error[np.isfinite(found.depth_error)]
    usual = float(np.median(known)) if len(known) else None
    yield from _duplicates(found)
    yield from _centers(cameras, params)
    disagree = found.depth_scale == 1 and (usual is None or usual > params.max_depth_error)
    if found.depth_scale != 1:
        yield from _scale(found, usual)
    elif disagree and compared:
        yield from _disagreement(usual, exchanged)
    if np.isnan(found.likeness).all() or exchanged:
        return
    with np.errstate(invalid="ignore"):
        odd = found.depth_error > max(params.max_view_error * (usual or 0), 0.01)
        strange = found.likeness < np.nanmedian(found.likeness) - params.min_likeness
    strange &= not disagree  # by wrong poses the wrong pixels are compared
    yield from _strange(found, strange)
    if found.depth_scale == 1:
        yield from _odd(found, usual, odd & ~strange)
    if not disagree:
        yield from _exposure(found, params)


def _duplicates(found: CaptureChecks) -> Iterable[str]:
    if found.duplicates:
        number = f"{len(found.duplicates)} of {len(found.names)}"
        yield f"Photos that repeat an earlier one: {number}, {first_of(found.duplicates)}."


def _centers(cameras: Cameras, params: CheckParams) -> Iterable[str]:
    off = np.abs(cameras.intrinsics[:, 2:] - cameras.sizes / 2).max(axis=1) / cameras.sizes.max(axis=1)
    if len(off) and off.max() > params.max_center:
        worst = int(off.argmax())
        cx, cy = cameras.intrinsics[worst, 2:]
        width, height = cameras.sizes[worst]
        yield (
            f"The principal point of {(off > params.max_center).sum()} of {len(off)} views lies far from the middle, "
            f"that of {cameras.names[worst]} at ({cx:.0f}, {cy:.0f}) of {width} x {height} pixels; are its intrinsics "
            "exchanged, or those of a photo of another size?"
        )


def _scale(found: CaptureChecks, usual: float | None) -> Iterable[str]:
    now = "hardly any of it is met now" if usual is None else f"median {usual:.1%} now"
    factor = float(f"{found.depth_scale:.2g}")  # the steps in which it was searched tell no more digits
    yield (
        f"Depth fits the poses {factor:g} times as large: neighbours' depth then differs clearly less ({now}); is "
        "its unit right?"
    )


def _disagreement(usual: float | None, exchanged: str) -> Iterable[str]:
    if usual is None:
        yield (
            "No view's depth is met in the views beside it: poses, intrinsics and depth disagree, or nothing overlaps"
            f"{exchanged}."
        )
    else:
        yield (
            f"Depth carried from view to view differs by {usual:.1%} (median): poses, intrinsics and depth disagree"
            f"{exchanged}."
        )


def _strange(found: CaptureChecks, strange: np.ndarray) -> Iterable[str]:
    if strange.any():
        worst = int(np.nanargmin(found.likeness))
        yield (
            f"Photos that differ from what their neighbours show: {strange.sum()} of {len(found.names)}, "
            f"{first_of(np.array(found.names)[strange].tolist())} (correlation {found.likeness[worst]:.2f}, usually "
            f"{np.nanmedian(found.likeness):.2f}); turned, elsewhere, or blank?"
        )


def _odd(found: CaptureChecks, usual: float | None, odd: np.ndarray) -> Iterable[str]:
    if odd.any():
        worst = int(np.nanargmax(np.where(odd, found.depth_error, np.nan)))
        yield (
            f"The poses of {odd.sum()} of {len(found.names)} views do not fit their depth (difference to "
            f"neighbours {found.depth_error[worst]:.1%}, usually {usual:.1%}): "
            f"{first_of(np.array(found.names)[odd].tolist())}."
        )


def _exposure(found: CaptureChecks, params: CheckParams) -> Iterable[str]:
    low, high = np.quantile(found.exposure, (0.05, 0.95))
    if high / low > params.max_exposure:
        yield f"The photos' exposure changes by a factor of {high / low:.2f} between nearby views."
