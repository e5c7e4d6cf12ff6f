"""What moves while a scene is captured, a hand or a passer-by, is no part of it.

Each photo shows it somewhere else, and the depth of the others sees through the place where it was.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ss_flow.running import in_threads, warn
from ss_flow.task import Resources, task
from ss_flow.tasks.artifacts import Bool, Cameras, DepthMap, Float32, Frame, Int32
from ss_flow.tasks.geometry.cameras import Camera, backproject, camera_of, nearest_views, pixels_in_view
from ss_flow.tasks.geometry.images import decode_valid, encode_valid, size_within
from ss_flow.tasks.packed import Masks
from ss_flow.tasks.ranges import Fraction, Natural
from ss_flow.tasks.words import first_of

_SIDE = 160
"""Longer side of the depth maps that are compared; all lengths below are pixels of these."""
_OTHERS = 24
"""A view is compared with so many at most: the nearest, whichever way they look."""
_BEHIND, _SAME = 0.05, 0.03
"""Relative differences of depth from which on a view sees through a place, and up to which it sees it."""
_CONFIRMED = 0.25
"""So many views as a share of those that see through a place may see it: a slow hand is hardly farther in the next."""
_THICK, _AROUND = 7, 2
"""What is narrower may be an edge that was not measured well; and so far round the rest its border may lie."""
_TRUSTED, _STILL = 0.9, 2
"""Of all other pixels so many, and so many times as many as move, must be where other views see them: where a pose is
wrong, everything seems to move. Under right poses, with noisy depth, .89 and more are, under wrong ones .64 to .83."""


@dataclass(frozen=True)
class TransientParams:
    """What moves before a depth sensor."""

    views: Natural = 3
    """So many views must see through a place for what was there to be ignored; 0 = never."""
    min_area: Fraction = 0.01
    """Pieces that are a smaller share of their photo stay."""


@dataclass(frozen=True)
class Transients(Masks):
    """What moves, as a mask for each view that shows any, at the size at which depth was compared."""

    view: Int32
    """[N] their places in the scene's order, ascending."""


@task(name="capture.transients", resources=Resources(cores=1, most_cores=8))
def transients(
    cameras: Cameras, depths: Sequence[DepthMap], *, params: TransientParams = TransientParams()
) -> Transients:
    """The pixels of each view through whose places at least `params.views` others see, and hardly any sees them.

    Says what is ignored. What has no depth, what stands where no other view looks, and what stood still in some of the
    photos, stays.
    """
    views = [_View.of(camera_of(cameras, row), depths[row].depth) for row in range(len(cameras))]

    def moving(row: int) -> Bool:
        near = nearest_views(cameras, row, _OTHERS, within=180)
        return _moving(views[row], [views[other] for other in near], params)

    found = {row: mask for row, mask in enumerate(in_threads(moving, range(len(views)))) if mask.any()}
    if found:
        shares = [mask.mean() for mask in found.values()]
        warn(
            f"In {len(found)} of {len(cameras)} views something moves, as the depth of others sees through it: "
            f"{np.median(shares):.1%} of their pixels (median; at most {max(shares):.1%}) are ignored, in "
            f"{first_of([cameras.names[row] for row in found])}. capture.transients.views=0 keeps them."
        )
    return Transients(**vars(Masks.of(found.values())), view=np.array(list(found), np.int32))


@task(name="capture.without_transients")
def without_transients(frame: Frame, found: Transients, *, view: int) -> Frame:
    """A frame whose pixels do not count where something moves; view: its place in the scene's order."""
    import cv2

    mask = found.mask(found.view.tolist().index(view)).astype(np.uint8)
    there = cv2.resize(mask, (frame.width, frame.height), interpolation=cv2.INTER_NEAREST) > 0
    return replace(frame, valid=encode_valid(decode_valid(frame) & ~there))


@dataclass(frozen=True)
class _View:
    """A view at a size that is quick to compare."""

    camera: Camera
    depth: Float32
    """[h, w] 0 where unknown."""

    @classmethod
    def of(cls, camera: Camera, depth: Float32) -> _View:
        import cv2

        size = size_within(_SIDE, *depth.shape[::-1])
        return cls(camera.scaled(*size), cv2.resize(depth, size, interpolation=cv2.INTER_NEAREST_EXACT))


def _moving(view: _View, others: Sequence[_View], params: TransientParams) -> Bool:
    """[h, w] what moves in a view; nothing where the rest of it does not fit the others."""
    known = np.flatnonzero(view.depth)
    points = backproject(view.depth, view.camera)[known]
    through, seen = np.zeros(len(known), int), np.zeros(len(known), int)
    for other in others:
        rows, column, row, z = pixels_in_view(points, other.camera)
        measured = other.depth[row, column]
        through[rows[measured > (1 + _BEHIND) * z]] += 1
        seen[rows[np.abs(measured - z) < _SAME * z]] += 1
    moves = (through >= params.views) & (seen <= _CONFIRMED * through)
    judged = ~moves & (through + seen >= params.views)
    stands = (judged & (seen > through)).sum()
    mask = np.zeros(view.depth.shape, bool)
    if stands >= _TRUSTED * judged.sum() and stands >= _STILL * moves.sum():
        mask.ravel()[known[moves]] = True
    return _pieces(mask, params.min_area)


def _pieces(mask: Bool, min_area: float) -> Bool:
    """A mask [h, w] without thin and small pieces, and a little wider."""
    import cv2

    def disc(size: int) -> np.ndarray:
        return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))

    thick = cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_OPEN, disc(_THICK))
    _, piece, stats, _ = cv2.connectedComponentsWithStats(thick, connectivity=8)
    large = stats[:, cv2.CC_STAT_AREA] >= min_area * mask.size
    large[0] = False
    return np.asarray(cv2.dilate(large[piece].astype(np.uint8), disc(2 * _AROUND + 1)) > 0)
