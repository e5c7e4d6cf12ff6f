"""Gaussians that stand apart from the thing whose label they carry, where the views show something else.

Beyond Split&Splat.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ss_flow.running import cores
from ss_flow.tasks.artifacts import Bool, Float64, Gaussians, Int32, LabelMap
from ss_flow.tasks.gaussians.render import shares
from ss_flow.tasks.geometry.cameras import Camera
from ss_flow.tasks.geometry.clustering import dbscan, rows_by_label
from ss_flow.tasks.geometry.images import resampled, size_within

MOST_PIXELS = 160
"""Longer side of the renderings that tell where Gaussians weigh."""
NEIGHBOURS = 3
"""The spacing of an instance is the median distance of its Gaussians to the neighbour of this rank."""
GAP = 5.0
"""Spacings without a Gaussian that part one piece of an instance from another."""
LONELY = 3.0
"""Spacings to the neighbour of that rank beyond which a Gaussian is alone, and so on no surface of its instance."""
LEAST_OWN = 0.5
"""Share of a piece's weight that lies in pixels of its instance, from which it belongs there."""
BACKGROUND = 0


def without_strays(cameras: Sequence[Camera], scene: Gaussians, masks: Sequence[LabelMap]) -> Gaussians:
    """The same rows, where what stands apart from its instance, and shows where others are, is the background's.

    Some points have a wrong label, and some Gaussians got theirs from afar. They make the box, the file and the
    pictures of a thing too large, though in the whole scene they help to show what is really there. So each instance
    but the background falls into pieces, GAP spacings and more from one another. The piece that weighs most in the
    pixels of its instance, T * alpha summed over all views, is kept, and so is each that has at least half of its own
    weight there. What of the others lies outside the box around these becomes part 0 of the background; inside of it,
    it may be a leg that masks lack. So does a LONELY Gaussian wherever it shows: where no depth is known, single ones
    hang before and behind things, and photos from one side do not contradict them. The whole scene looks as before, as
    only labels change.

    scene: fully trained. masks: exclusive label maps of all views, one a camera.
    """
    scene = _as_background(scene, _lonely(scene))
    piece = _pieces_apart(scene)
    rows = np.flatnonzero(piece >= 0)
    if not len(rows):
        return scene
    own, everywhere = (np.bincount(piece[rows], weights[rows]) for weights in _weights(cameras, scene, masks))
    instance = np.zeros(len(own), np.int32)
    instance[piece[rows]] = scene.instance_id[rows]
    order = np.lexsort((-own, instance))
    main = order[np.unique(instance[order], return_index=True)[1]]
    kept = (own >= LEAST_OWN * everywhere) & (everywhere > 0)
    kept[main] = True
    strays = (piece >= 0) & ~kept[piece]
    strays &= ~_inside_own_box(scene, ~strays)
    return _as_background(scene, strays)


def _as_background(scene: Gaussians, rows: Bool) -> Gaussians:
    return replace(
        scene,
        instance_id=np.where(rows, BACKGROUND, scene.instance_id).astype(np.int32),
        part_id=np.where(rows, 0, scene.part_id).astype(np.int32),
    )


def _lonely(scene: Gaussians) -> Bool:
    """[N] which Gaussians have hardly any of their instance near them; none of the background."""
    lonely = np.zeros(len(scene), bool)
    for rows, distance in _things(scene):
        lonely[rows] = distance > LONELY * np.median(distance)
    return lonely


def _pieces_apart(scene: Gaussians) -> Int32:
    """[N] the number of each Gaussian's piece, -1 where its instance is in one, or is the background."""
    piece = np.full(len(scene), -1, np.int32)
    count = 0
    for rows, distance in _things(scene):
        found = dbscan(scene.means[rows], GAP * float(np.median(distance)), min_samples=1)
        if pieces := int(found.max()):
            piece[rows] = count + found
            count += pieces + 1
    return piece


def _things(scene: Gaussians) -> Iterator[tuple[NDArray[np.intp], Float64]]:
    """The rows of each instance but the background and those of few Gaussians, and how far each one's neighbour of rank
    NEIGHBOURS is."""
    from scipy.spatial import cKDTree

    for instance, rows in rows_by_label(scene.instance_id).items():
        if instance != BACKGROUND and len(rows) > NEIGHBOURS:
            points = scene.means[rows]
            distance, _ = cKDTree(points).query(points, k=NEIGHBOURS + 1, workers=cores())
            yield rows, np.asarray(distance)[:, -1]


def _inside_own_box(scene: Gaussians, kept: Bool) -> Bool:
    """[N] which centres lie in the box around those of their instance that are kept."""
    inside = np.zeros(len(scene), bool)
    for rows in rows_by_label(scene.instance_id).values():
        own, known = scene.means[rows], scene.means[rows[kept[rows]]]
        inside[rows] = ((own >= known.min(axis=0)) & (own <= known.max(axis=0))).all(axis=1)
    return inside


def _weights(cameras: Sequence[Camera], scene: Gaussians, masks: Sequence[LabelMap]) -> tuple[Float64, Float64]:
    """[N] the weight of each Gaussian over all views: in pixels of its instance, and in all pixels."""
    own, everywhere = np.zeros(len(scene)), np.zeros(len(scene))
    for camera, shown in zip(cameras, masks, strict=True):
        small = camera.scaled(*size_within(MOST_PIXELS, camera.width, camera.height))
        ids = resampled(shown.ids, small.height, small.width).astype(np.int32)
        found = shares(scene, small, ids)
        mine = found.id == scene.instance_id[found.row]
        everywhere += np.bincount(found.row, found.weight, len(scene))
        own += np.bincount(found.row[mine], found.weight[mine], len(scene))
    return own, everywhere
