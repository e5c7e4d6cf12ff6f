"""Which labels are pieces of one thing: a tree over all views, from how often a mask shows several of them as one.

A segmenter shows the box, its faces and the label printed on it, and often the box with what stands beside it. The
level that is a thing is the one that the views repeat: most views which see two pieces of it have a mask with just
these pieces, and the segmenter is as sure of that mask as of those of the pieces. Pieces that touch each other more
than anything else are one rather, and pieces that do not touch are rather not. Four things are known without masks:
what light alone or nothing parts is one surface, what touches nothing but walls and floors stands alone, and what meets
in a convex edge, or lies in another's surface, is of one thing, unless the views deny it. Beyond Split&Splat.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from ss_flow.task import Resources, task
from ss_flow.tasks.artifacts import (
    Cameras,
    Hierarchy,
    PointCloud,
    PointLabels,
    Tally,
    Visibility,
)
from ss_flow.tasks.geometry.clustering import rows_by_label
from ss_flow.tasks.ranges import Count, Fraction, NonNegative
from ss_flow.tasks.split.agreement import ONE_THING, views_of
from ss_flow.tasks.split.casts import find_casts
from ss_flow.tasks.split.contact import find_contact
from ss_flow.tasks.split.edges import convex_edges
from ss_flow.tasks.split.inlays import find_inlays
from ss_flow.tasks.split.looks import Looks
from ss_flow.tasks.split.mounds import find_mounds
from ss_flow.tasks.split.stuff import StuffParams, find_stuff
from ss_flow.tasks.split.supports import find_supports
from ss_flow.tasks.split.surfaces import ShadowParams, lit_surfaces
from ss_flow.tasks.split.unions import Members, Pieces
from ss_flow.tasks.split.votes.touching import TouchingParams, borders


@dataclass(frozen=True)
class HierarchyParams:
    """What counts as being shown as one thing."""

    doubt: Fraction = 0.2
    """By how much the segmenter may be surer of a piece than of the whole (predicted IoU times stability) before the
    whole no longer counts; from nothing to this, it counts less and less. Twice as much, of the largest piece."""
    silent: Fraction = 0.5
    """How much a view counts that says nothing of the pieces: none of its masks lies mostly on them and holds half of
    one. Small things have none from afar, neither as one nor in pieces. 1 = as much as one that shows them apart."""
    prior: NonNegative = 1.0
    """So many views more are taken to have been asked about each union, so that one view alone does not decide."""
    prior_agreement: Fraction = 0.2
    """Share of these that are taken to show it. If none did, what only a few views can see would come apart."""
    min_agreement: Fraction = 0.2
    """Agreement below which pieces are not united even to a group."""
    min_points: Count = 10
    """Points of a piece that a view must see to count."""
    min_visible: Fraction = 0.2
    """Share of the points that any view sees of a piece, which a view must see to count."""
    around: Fraction = 0.8
    """Share of its border with other labels along which a piece is surrounded by what it stands on."""
    bulge: Fraction = 0.09
    """How far it must rise from there, as a share of its extent, where its colours are half like those around it; the
    farther, the more they are alike. A bag on a sofa is no part of the sofa, but its arm is."""
    stuff: StuffParams = field(default_factory=StuffParams)
    """What is a wall or a floor rather than a thing."""
    shadows: ShadowParams = field(default_factory=ShadowParams)
    """What is one surface, in light and shadow or without a border that can be seen, whatever the masks say."""
    alone: Fraction = 0.3
    """Share by which an agreement rises towards 1 where the pieces touch each other and stuff, and nothing else: a
    chair on a floor. Less where they touch other things, down to nothing at half of what they touch."""
    contact: Fraction = 0.2
    """How much it counts what the pieces touch: an agreement falls by this share where it is other labels only, and
    rises by it where it is each other."""
    apart: Fraction = 0.3
    """Share by which an agreement falls where the pieces do not touch each other: the views show a group."""
    convex: Fraction = ONE_THING + 0.01
    """Agreement that two pieces have at least where they meet in a convex edge, as the faces of a box do, and half of
    the views that see both hold them under one mask. Just above the default of `split.granularity`, so that what the
    views show as one comes first. 0 = convex edges are not looked for."""
    inlaid: Fraction = ONE_THING + 0.01
    """The same where one piece lies in the plane of the other, which is all round it, as a picture in its mount. 0 =
    not looked for."""


@task(name="split.hierarchy", resources=Resources(cores=1, most_cores=8))
def hierarchy(
    points: PointCloud,
    cameras: Cameras,
    visibility: Sequence[Visibility],
    labels: PointLabels,
    tallies: Sequence[Tally],
    *,
    params: HierarchyParams,
) -> Hierarchy:
    """The tree of what the labels make up.

    visibility, tallies: one of each a view; labels: of `points`. What light alone or nothing parts is united first.
    Then, round by round, the sets of pieces with the highest agreement are, each piece once a round, until none reaches
    `min_agreement`; a thing and stuff never are. The order of the views does not matter, nor that of the masks.
    """
    leaves = np.unique(labels.label[labels.label > 0]).astype(np.int32)
    ends = borders(labels.label, points, TouchingParams())
    looks = Looks(points, cameras, visibility)
    surface = lit_surfaces(looks, labels.label, ends, params.shadows)
    is_stuff = find_stuff(points, cameras, replace(labels, label=surface[labels.label]), params.stuff)
    _, surface_of = np.unique(surface[leaves], return_inverse=True)
    is_stuff = (is_stuff | find_casts(points, labels.label, surface, ends, is_stuff))[surface_of]
    mounds = find_mounds(points, cameras, labels, tallies, ends, around=params.around, height=params.bulge)
    contact = find_contact(ends, labels.label)
    supports = find_supports(points, cameras, labels, height=params.bulge)
    edges = np.zeros((len(leaves), len(leaves)), bool)
    if params.convex:
        edges = convex_edges(points, cameras, visibility, labels.label, ends)
    inlays = find_inlays(looks, labels.label, ends, ~is_stuff & (params.inlaid > 0))
    own: list[Members] = [(row,) for row in range(len(leaves))]
    views = views_of(leaves, tallies)
    pieces = Pieces(views, is_stuff, contact, edges, own, mounds, supports, inlays, params)
    node, parent, agreement, stuff = leaves.tolist(), [0] * len(leaves), [1.0] * len(leaves), is_stuff.tolist()
    top = list(range(len(leaves)))  # the tree's row of each piece
    lit = [tuple(rows.tolist()) for rows in rows_by_label(surface_of.astype(np.int32)).values() if len(rows) > 1]
    united = [(members, params.shadows.agreement) for members in lit] or pieces.best_unions()
    while united:
        for members, share in united:
            row = len(node)
            node.append(labels.num_labels + 1 + row - len(leaves))
            parent.append(0)
            agreement.append(share)
            stuff.append(stuff[top[members[0]]])
            for piece in members:
                parent[top[piece]] = node[row]
            top.append(row)
        left = sorted(set(range(len(top))) - {piece for members, _ in united for piece in members})
        pieces = pieces.united([members for members, _ in united])
        top = [top[piece] for piece in left]
        united = pieces.best_unions()
    return Hierarchy(
        np.array(node, np.int32), np.array(parent, np.int32), np.array(agreement, np.float32), np.array(stuff, bool)
    )
