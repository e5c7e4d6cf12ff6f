"""A wall goes on behind what stands before it: instances that lie in its plane and have its colours are pieces of it.

`gaps` asks what the views see between two pieces of one plane, since a table may end there. Nothing is behind stuff, so
there it need not be asked, however far apart they are. Masks tell nothing either: the segmenter is as sure of a piece
of wall between a curtain and a corner, and of a tile, as of a picture. Beyond Split&Splat.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ss_flow.task import task
from ss_flow.tasks.artifacts import Hierarchy, PointCloud, PointLabels
from ss_flow.tasks.geometry.clustering import rows_by_label
from ss_flow.tasks.geometry.shape import on_plane, refitted, thinned
from ss_flow.tasks.ranges import Fraction
from ss_flow.tasks.split.stuff import StuffParams, planes_of
from ss_flow.tasks.split.votes.color_histograms import bins_of, histogram

_THICKNESS = 2.0
"""Distance from the plane up to which points lie in it, in spacings."""
_FLAT = 0.8
"""Share of a piece's points that must do so."""
_FEW = 10
"""Points below which nothing has a plane."""
_ROUNDS = 4
_SPREAD = 4.0
"""Standard deviation of the smoothing of a wall's colours, in CIELAB units: paper is whiter than a white table."""
_RARE = 0.1
"""How often a wall must have a colour, as a share of its most frequent one: a floor may have tiles of two."""


@dataclass(frozen=True)
class WallParams:
    """When an instance is a piece of a wall or a floor."""

    colors: Fraction = 0.9
    """Least share of its points whose colours the wall has, too; 0 = pieces are not looked for."""


@task(name="split.join_walls")
def join_walls(
    points: PointCloud,
    labels: PointLabels,
    tree: Hierarchy,
    *,
    params: WallParams,
    stuff: StuffParams = StuffParams(),
) -> PointLabels:
    """The instances, of which those are one that are pieces of one wall or floor.

    labels: the instances, after the cut of `tree`, which tells what is stuff. stuff: as it was found. A piece lies in a
    plane of stuff that has more points, and has hardly a colour that this has not; it may be stuff itself. What is
    joined gets a new id, and all other instances keep theirs.
    """
    rows_of = {name: rows for name, rows in rows_by_label(labels.label).items() if name and len(rows) >= _FEW}
    largest_first = sorted(rows_of, key=lambda name: (-len(rows_of[name]), name))
    places = {name: thinned(points.points[rows]) for name, rows in rows_of.items()}
    bins = bins_of(points.colors) if rows_of else np.zeros(0, np.int32)
    walls = set(tree.node[tree.stuff].tolist())
    wall_of = dict[int, int]()
    for rank, wall in enumerate(largest_first):
        if wall not in walls:
            continue
        thickness = _THICKNESS * points.spacing_of(rows_of[wall])
        planes = [refitted(places[wall], plane, thickness, _ROUNDS) for plane in planes_of(places[wall], stuff)]
        often = histogram(bins[rows_of[wall]], _SPREAD)
        has = often >= _RARE * often.max()
        for piece in largest_first[rank + 1 :]:
            if (
                piece not in wall_of
                and any(on_plane(places[piece], plane, thickness).mean() >= _FLAT for plane in planes)
                and has[bins[rows_of[piece]]].mean() >= params.colors
            ):
                wall_of[piece] = wall_of.get(wall, wall)
    new = np.arange(labels.num_labels + 1, dtype=np.int32)
    number = {wall: n for n, wall in enumerate(sorted(set(wall_of.values())), labels.num_labels + 1)}
    for piece, wall in wall_of.items():
        new[[wall, piece]] = number[wall]
    return replace(
        labels, label=new[labels.label], num_labels=labels.num_labels + len(number), match_label=new[labels.match_label]
    )
