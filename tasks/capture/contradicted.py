"""Photos that were placed wrongly among others: where things repeat, what one shows is taken for its twin elsewhere.

COLMAP's mapper looks at a photo once, when it places it, by the matches with those that have a place then; whatever
later ones tell, it stays.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ss_flow.tasks.artifacts import Cameras, Float64
from ss_flow.tasks.capture.features import Features
from ss_flow.tasks.capture.matches import Matches
from ss_flow.tasks.capture.pose_fit import pairs_that_fit

_LEAST_MATCHES = 30
"""Pairs of photos with fewer matches do not count: they fit some geometry by chance now and then."""
_LEAST_SHARE = 0.75
"""So much of a photo's features must fit its pose, by the median of all photos, which is lower where more repeats.
By that median it was .78 and more of photos that were placed rightly, .9 and more where nothing repeats, and .14 to .68
of those that were placed wrongly among right ones."""


def contradicted(cameras: Cameras, photos: Sequence[Features], matches: Sequence[Matches]) -> tuple[str, ...]:
    """Names of the photos that must go so that each of the others is where its matches with these say, worst first.

    A feature fits where half of its matches or more lie near their epipolar lines: it counts once, however many photos
    show the twin that it was taken for. A photo that goes takes its matches with it, so that those are not blamed whom
    only it contradicts. Photos of which nothing tells are not named.
    """
    placed = set(cameras.names)
    fit, met = ({photo.name: np.zeros(len(photo.points)) for photo in photos if photo.name in placed} for _ in (0, 1))
    partners: dict[str, list[tuple[str, Float64, Float64]]] = {name: [] for name in placed}
    for own, other, pair, fits in pairs_that_fit(cameras, photos, matches):
        if len(pair) < _LEAST_MATCHES:
            continue
        for name, beside, rows in ((own, other, pair[:, 0]), (other, own, pair[:, 1])):
            size = len(met[name])
            of_pair = [np.bincount(row, minlength=size).astype(np.float64) for row in (rows[fits], rows)]
            fit[name] += of_pair[0]
            met[name] += of_pair[1]
            partners[beside].append((name, of_pair[0], of_pair[1]))

    def share(name: str) -> float:
        seen = met[name] > 0
        return float((2 * fit[name] >= met[name])[seen].mean()) if seen.any() else 1.0

    shares = {name: share(name) for name in cameras.names if partners[name]}
    least = _LEAST_SHARE * float(np.median(list(shares.values()))) if shares else 0.0
    gone = []
    while len(shares) > 2 and min(shares.values()) < least:
        worst = min(shares, key=shares.__getitem__)
        gone.append(worst)
        del shares[worst]
        for name, of_fit, of_met in partners[worst]:
            fit[name] -= of_fit
            met[name] -= of_met
            if name in shares:
                shares[name] = share(name)
    return tuple(gone)
