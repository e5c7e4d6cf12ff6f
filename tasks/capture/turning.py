"""Whether photos were taken from one place, by a camera that only turned: what they have in common then tells no depth.

Matches of such photos fit any epipolar geometry, so nothing later would contradict the scene that is made up of them.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ss_flow.errors import InputError
from ss_flow.tasks.artifacts import Float64
from ss_flow.tasks.capture.features import Features
from ss_flow.tasks.capture.matches import Matches

_LEAST_MATCHES, _LEAST_PAIRS = 30, 3
"""With fewer matches a pair of photos does not count; fewer pairs tell nothing."""
_FAR = 0.2
"""So far, as a share of the photo's longer side, matches must lie apart in two photos (median). Where the camera hardly
moved, as between neighbouring frames of a video, a turn explains its way, too."""
_SAMPLED_PAIRS, _SAMPLED_MATCHES = 60, 32
_FOCALS = np.geomspace(0.4, 1.6, 18)
"""Focal lengths that are tried, by the longer side. Under longer ones a turn is hard to tell from a walk along a flat
wall, which gives depth."""
_ROUNDS = 6
_EXPLAINED = 0.004
"""How far off its place a match may lie, by the longer side, to be explained."""
_NOISE = 0.0005
"""Matches that lie nearer weigh alike."""
_MOST = 0.8
"""The share of matches that a turn may explain. It was .97 in photos of a room from one place, .93 from places that
were 1 cm apart; .06 to .18 in photos of walks, and .46 along a flat wall, which a turn explains best of all."""


def refuse_turning(photos: Sequence[Features], matches: Sequence[Matches]) -> None:
    """Raise InputError where photos were taken from one place.

    matches: with photos that are not among `photos` do not count.
    """
    share = explained_by_turning(photos, matches)
    if share >= _MOST:
        raise InputError(
            f"turning the camera explains {share:.0%} of what the photos have in common, so they were taken from one "
            "place and give no depth; walk around, and take each photo from another place."
        )


def explained_by_turning(photos: Sequence[Features], matches: Sequence[Matches]) -> float:
    """The share of matches, 0..1, that a turn about the camera's centre brings onto each other, by the one focal length
    that explains most; 0 where too few photos have too little in common.

    Each pair of photos has a turn of its own. Pairs and matches are sampled evenly.
    """
    points = {}
    for photo in photos:
        size = np.array([photo.width, photo.height])
        points[photo.name] = (photo.points.astype(np.float64) - size / 2) / size.max()
    pairs = []
    for own in matches:
        for i, other in enumerate(own.others):
            rows = own.pairs_with(i)
            if len(rows) >= _LEAST_MATCHES and own.name in points and other in points:
                rows = rows[np.linspace(0, len(rows) - 1, _SAMPLED_MATCHES).astype(int)]
                pair = np.stack([points[own.name][rows[:, 0]], points[other][rows[:, 1]]])
                if np.median(np.linalg.norm(pair[0] - pair[1], axis=1)) >= _FAR:
                    pairs.append(pair)
    if len(pairs) < _LEAST_PAIRS:
        return 0.0
    chosen = np.linspace(0, len(pairs) - 1, min(len(pairs), _SAMPLED_PAIRS)).astype(int)
    first, second = np.stack([pairs[row] for row in chosen], axis=1)
    return max(float((_off_after_turning(first, second, focal) < _EXPLAINED).mean()) for focal in _FOCALS)


def _off_after_turning(first: Float64, second: Float64, focal: float) -> Float64:
    """[P, M] how far the first points, turned, lie from the second ones: of each pair of photos by the rotation that
    fits best (Arun, Huang and Blostein 1987), found anew with less weight on what lies off (least absolute distances).

    first, second: [P, M, 2] matched points of P pairs, from the photo's middle. focal: in their unit.
    """
    rays, aims = (_unit(np.insert(points, 2, focal, axis=2)) for points in (first, second))
    weight, off = np.ones(first.shape[:2]), np.zeros(first.shape[:2])
    for _ in range(_ROUNDS):
        u, _, vt = np.linalg.svd(np.einsum("pmi,pmj,pm->pij", aims, rays, weight))
        u[:, :, 2] *= np.linalg.det(u @ vt)[:, None]
        turned = rays @ (u @ vt).transpose(0, 2, 1)
        off = np.linalg.norm(focal * turned[..., :2] / np.maximum(turned[..., 2:], 1e-6) - second, axis=2)
        weight = 1 / np.maximum(off, _NOISE)
    return off


def _unit(vectors: Float64) -> Float64:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=2, keepdims=True))
