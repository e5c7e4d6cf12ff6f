"""What a user says of instances that Split joined or broke: points on one thing, and points on another."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ss_flow.running import warn
from ss_flow.task import task
from ss_flow.tasks.artifacts import (
    Bool,
    Clicks,
    Float64,
    Hierarchy,
    Int32,
    MaskSet,
    PointCloud,
    PointLabels,
    Visibility,
)
from ss_flow.tasks.geometry.images import at_diagonal
from ss_flow.tasks.masks.painting import PaintedView, nearest_labels, paint_labels
from ss_flow.tasks.masks.pool import canonical_order, mask_tree
from ss_flow.tasks.packed import Masks

_REACH = 6.0
"""How far from a click the point that it means may fall, in pixels of an image with a diagonal of 800."""
_NEIGHBORS = 10
"""Nearest points that each point is linked with."""
_TONE = 20.0
"""Distance at which two colours (RGB) hardly are of one thing any more."""
_OTHER_PIECE = 0.01
"""What a link between two pieces counts, of one within a piece."""
_SHOWN = 0.5
"""Share of the points that a view sees of a thing from which on a mask over them shows it."""
_COLOR, _CLICK = 0.01, 1000.0
"""What a point's colour, and a click on it, tell of its thing, where a clicked mask with all votes tells 1, and so does
a neighbour of the same colour."""


@task(name="split.correct")
def correct(
    points: PointCloud,
    visibility: Sequence[Visibility],
    clicks: Sequence[Clicks],
    pieces: PointLabels,
    labels: PointLabels,
    clicked: Sequence[PointLabels],
    *,
    names: tuple[str, ...],
) -> PointLabels:
    """The instances, corrected by points that were clicked on things. Beyond Split&Splat.

    visibility, clicks: one of each per view. pieces: the labels that the instances are made of. labels: the instances.
    clicked: the points under the masks that the segmenter gives for the clicks (`hints.label`); none without one.
    names: what the user calls each thing.

    Clicks on one thing unite the instances that they lie on. An instance with clicks on several things is divided: each
    of its points goes to the thing that it hangs together with (`divided`). What changes gets new ids; all other
    instances keep theirs, so that what follows from them alone is not computed again. Warns of clicks that lie on no
    instance, and of clicks on several things that mean one point.
    """
    row, thing = clicked_points(visibility, clicks)
    on_any = labels.label[row] > 0
    if lost := sum(int(of_view.inside.sum()) for of_view in clicks) - int(on_any.sum()):
        warn(f"{lost} clicks lie on no instance; they correct nothing.")
    row, thing = row[on_any], thing[on_any]
    for point in np.unique(row):
        claiming = [repr(names[k - 1]) for k in np.unique(thing[row == point]).tolist()]
        if len(claiming) > 1:
            warn(
                f"Clicks on {' and '.join(claiming)} mean one point, which only one of them gets; click farther apart."
            )
    instance = labels.label[row]
    changed, shown = labels.label.copy(), np.arange(labels.num_labels + 1, dtype=np.int32)
    for held in np.unique(instance).tolist():
        here = instance == held
        things = np.unique(thing[here])
        if len(things) == 1 and (instance[thing == things[0]] == held).all():
            continue  # it is this thing already
        rows = np.flatnonzero(labels.label == held)
        owner = np.full(len(rows), things[0])
        if len(things) > 1:
            place = np.searchsorted(rows, row[here])
            seeds = [place[thing[here] == one] for one in things]
            held_by = [_numbered(labelled, things) for labelled in clicked]
            owner = things[divided(points, pieces.label, rows.astype(np.int32), seeds, held_by)]
        changed[rows] = labels.num_labels + owner
        shown[held] = labels.num_labels + things[0] if len(things) == 1 else -1
    matched = shown[labels.match_label]
    kept = matched >= 0  # a mask that shows several things votes for none of them
    return PointLabels(
        label=changed,
        confidence=labels.confidence,
        num_labels=max(labels.num_labels, int(changed.max(initial=0))),
        match_view=labels.match_view[kept],
        match_mask=labels.match_mask[kept],
        match_label=matched[kept],
    )


@task(name="split.part_masks")
def part_masks(
    visibility: Visibility, masks: MaskSet, before: PointLabels, after: PointLabels, *, contained: float
) -> MaskSet:
    """The masks of a view, of which those are divided that show as one what `correct` or `part_boards` has divided.

    visibility, masks: of one view. before, after: the instances before and since. contained: as `mask_tree` takes it.
    Such a mask holds points of that instance mostly, and of several of its things half of the points that the view
    sees or more; each of its pixels goes to the thing of the nearest of these points.
    """
    seen = visibility.point_index
    if (before.label[seen] == after.label[seen]).all():
        return masks
    old, new = (paint_labels(visibility, labels.label) for labels in (before, after))
    dense, parts, origin = masks.dense(), list[Bool](), list[int]()
    for row, mask in enumerate(dense):
        inside = mask.ravel()[old.pixel]
        votes = np.bincount(old.label[inside], minlength=1)
        of_most = old.label == votes.argmax()
        held, total = (
            np.bincount(new.label[here], minlength=after.num_labels + 1) for here in (of_most & inside, of_most)
        )
        shown = np.flatnonzero((held > 0) & (held >= _SHOWN * total))
        if len(shown) < 2:
            parts.append(mask)
            origin.append(row)
            continue
        among = of_most & inside & np.isin(new.label, shown)
        nearest = nearest_labels(PaintedView.of(old.pixel[among], new.label[among]), masks.height, masks.width, np.inf)
        parts += [mask & (nearest == thing) for thing in shown]
        origin += [row] * len(shown)
    if len(parts) == len(dense):
        return masks
    found = np.array(parts)
    order = canonical_order(found)
    rows = np.array(origin)[order]
    return replace(
        masks,
        **vars(Masks.of(found[order])),
        predicted_iou=masks.predicted_iou[rows],
        stability=masks.stability[rows],
        grid=masks.grid[rows],
        parent=mask_tree(found[order], contained),
    )


@task(name="split.corrected_tree")
def corrected_tree(tree: Hierarchy, before: PointLabels, after: PointLabels) -> Hierarchy:
    """The tree with the instances that `part_boards`, `join_walls` or `correct` made of others, as nodes without
    children.

    before, after: the instances before and since. A new one is stuff where more than half of its points were, and part
    of the group that all it is made of were part of. Where there is no new one the tree comes back as it is.
    """
    row_of, names = tree.row_of(), np.setdiff1d(after.label, np.append(tree.node, 0)).astype(np.int32)
    made_of = [np.unique(before.label[after.label == name], return_counts=True) for name in names]
    rows = [np.array([row_of[old] for old in olds.tolist()]) for olds, _ in made_of]
    parents = [tree.parent[own] for own in rows]
    parent = [int(of[0]) if (of == of[0]).all() else 0 for of in parents]
    stuff = [
        bool(2 * (tree.stuff[own] * size).sum() > size.sum()) for own, (_, size) in zip(rows, made_of, strict=True)
    ]
    leaves = int((~np.isin(tree.node, tree.parent)).sum())  # which come first
    return Hierarchy(
        np.insert(tree.node, leaves, names),
        np.insert(tree.parent, leaves, parent),
        np.insert(tree.agreement, leaves, np.ones(len(names))),
        np.insert(tree.stuff, leaves, stuff),
    )


def clicked_points(visibility: Sequence[Visibility], clicks: Sequence[Clicks]) -> tuple[Int32, Int32]:
    """The dense points that clicks on things mean: [C] rows of the point cloud, and [C] the number of the thing.

    visibility, clicks: one of each per view. Of the points that a view sees, the nearest to the click in the picture is
    meant; a click with none in reach is left out, and so is one that says where a thing is not.
    """
    rows, things = [np.zeros(0, np.int32)], [np.zeros(0, np.int32)]
    for view, of_view in zip(visibility, clicks, strict=True):
        inside = of_view.inside == 1
        if not inside.any() or not len(view.point_index):
            continue
        v, u = np.divmod(view.pixel, view.width)
        away = np.hypot(*(np.stack([u, v], axis=-1) + 0.5 - of_view.points[inside, None]).transpose(2, 0, 1))
        nearest = away.argmin(axis=1)
        met = away[np.arange(len(nearest)), nearest] <= at_diagonal(_REACH, view.height, view.width)
        rows.append(view.point_index[nearest[met]])
        things.append(of_view.label[inside][met])
    return np.concatenate(rows), np.concatenate(things)


def _numbered(clicked: PointLabels, things: Int32) -> PointLabels:
    """The same points labelled 1.. by some of the things, 0 where by none of them."""
    number = np.zeros(max(clicked.num_labels, int(things.max())) + 1, np.int32)
    number[things] = np.arange(1, len(things) + 1)
    return replace(clicked, label=number[clicked.label])


def divided(
    points: PointCloud, piece: Int32, rows: Int32, seeds: Sequence[Int32], clicked: Sequence[PointLabels]
) -> Int32:
    """[R] which of T things each of some points belongs to: random walks with priors (Grady, CVPR 2005).

    piece: [N] of all points. rows: [R] the points. seeds: of each thing the clicked ones among them, as places in
    `rows`. clicked: all points, labelled 1..T where a clicked mask holds them; none without masks.

    A walker goes from a point to its nearest neighbours, the more likely the more alike their colours are, and ends at
    a click; or anywhere, as if at a click on a thing, the more likely the more the point's colour is like those around
    that thing's clicks, and the more votes it has for it. The thing counts at which a walk most probably ends.
    """
    from scipy.sparse import coo_array, diags_array
    from scipy.sparse.linalg import splu
    from scipy.spatial import cKDTree

    count, places = len(rows), points.points[rows].astype(np.float64)
    colors = points.colors[rows].astype(np.float64)
    tree = cKDTree(places)
    _, near = tree.query(places, k=np.arange(1, 2 + min(_NEIGHBORS, count - 1)))
    links = np.sort(np.column_stack([np.repeat(np.arange(count), near.shape[1]), near.ravel()]), axis=1)
    a, b = np.unique(links[links[:, 0] < links[:, 1]], axis=0).T
    weight = _alike(colors[a], colors[b]) * np.where(piece[rows[a]] == piece[rows[b]], 1, _OTHER_PIECE)
    both = np.concatenate([a, b]), np.concatenate([b, a])
    walks = coo_array((np.tile(weight, 2), both), shape=(count, count)).tocsc()

    around = [np.median(colors[near[own]].reshape(len(own), -1, 3), axis=1) for own in seeds]
    ends = np.array([np.max([_alike(colors, color) for color in of_thing], axis=0) for of_thing in around])
    ends *= _COLOR / ends.sum(axis=0)
    for thing, own in enumerate(seeds):
        for labelled in clicked:
            ends[thing] += np.where(labelled.label[rows] == thing + 1, labelled.confidence[rows], 0)
        ends[thing, own] += _CLICK
    laplacian = diags_array(walks.sum(axis=0) + ends.sum(axis=0)) - walks
    solve = splu(laplacian.tocsc(), permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True}).solve
    probability = np.round([solve(of_thing) for of_thing in ends], 9)
    return probability.argmax(axis=0).astype(np.int32)


def _alike(colors: Float64, others: Float64) -> Float64:
    """How likely two colours [..., 3] are of one thing: 1 = the same, a thousandth or less where they differ."""
    return np.exp(-(((colors - others) / _TONE) ** 2).sum(axis=-1)) + 1e-3
