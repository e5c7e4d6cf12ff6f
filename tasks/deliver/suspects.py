"""Which objects of a result deserve a second look, and why."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ss_flow.tasks.artifacts import Float32, Hierarchy, InstanceMasks
from ss_flow.tasks.deliver.instances_json import is_doubtful
from ss_flow.tasks.geometry.clustering import dbscan
from ss_flow.tasks.words import first_of

_FEW_VIEWS = 3
_FEW_SHARE = 0.05
"""An object has few views below three, and below a twentieth of all."""
_UNSURE = 0.5
"""Confidence below which an object is told of: it is likelier no whole thing than one."""
_NEARLY_ONE = 0.4
"""Share of the views that show several objects as one thing, from which they may be fragments of it."""
_HARDLY_ONE = 0.5
"""Share of the views that show an object as one thing, below which it may have swallowed a neighbour."""
_SAME_SPACE = 0.5
"""IoU of their boxes from which two objects collide."""
_APART = 6.0
"""Objects lie in pieces where these are farther apart than so many spacings of the dense points."""
_NAMED = 3
"""Other objects that a reason names; more are counted."""
_HARDLY_THERE = 0.1
"""Gaussians for each dense point, below which an object was hardly reconstructed."""
_PIECE = 0.2
"""Share of an object's points that a piece must hold."""


def suspects(
    instances: Sequence[InstanceMasks], document: Mapping[str, Any], tree: Hierarchy, *, spacing: float, num_views: int
) -> list[dict[str, Any]]:
    """The suspicious objects, by rising id: id, name, and reasons in words.

    instances: after refinement. document: that of instances.json; crumbs, which say of themselves that they are small
    or hardly seen, and what is doubtful, which stands apart in lists, are left out. tree: what is part of what.
    spacing: of the dense points, world units.
    """
    entries = {entry["id"]: entry for entry in document["instances"] if not (entry["crumb"] or is_doubtful(entry))}
    own = {one.instance_id: one for one in instances if one.instance_id in entries}
    things = [i for i in own if entries[i]["kind"] == "thing"]
    reasons: dict[int, list[str]] = {i: [] for i in sorted(own)}
    names = {i: entry["name"] for i, entry in entries.items()}
    few = max(_FEW_VIEWS, _FEW_SHARE * num_views)
    for i, one in own.items():
        if len(one.views) < few:
            reasons[i].append(f"few views: it is seen in {len(one.views)} of {num_views}")
        if (count := entries[i]["num_gaussians"]) < _HARDLY_THERE * len(one.points):
            many = "1 Gaussian" if count == 1 else f"{count} Gaussians"
            reasons[i].append(f"hardly anything of it was reconstructed: {many} for {len(one.points):,} points")
        if i in things and one.confidence < _UNSURE:
            reasons[i].append(f"low confidence: {one.confidence:.0%}")
        if i in things and (pieces := _pieces(one.points, _APART * spacing)) > 1:
            reasons[i].append(f"in pieces: its points lie in {pieces} places apart")
    for i, text in (*_fragments(document["groups"], names), *_swallowed(tree, names), *_collisions(own, things, names)):
        if i in reasons:
            reasons[i].append(text)
    return [{"id": i, "name": names[i], "reasons": texts} for i, texts in reasons.items() if texts]


def _fragments(groups: Sequence[Mapping[str, Any]], names: Mapping[int, str]) -> list[tuple[int, str]]:
    """The objects that many views show as one: of the smallest such group that holds each."""
    found: dict[int, str] = {}
    for group in groups:  # the smallest first
        members = [i for i in group["instances"] if i in names]
        if group["agreement"] < _NEARLY_ONE or len(members) < 2:
            continue
        for i in members:
            others = [names[other] for other in members if other != i]
            among = first_of(others, _NAMED)
            found.setdefault(i, f"a fragment: {group['agreement']:.0%} of the views show it as one thing with {among}")
    return list(found.items())


def _swallowed(tree: Hierarchy, names: Mapping[int, str]) -> list[tuple[int, str]]:
    """The objects that were put together from pieces which hardly half of the views show as one thing."""
    return [
        (int(node), f"a swallowed neighbour: only {agreement:.0%} of the views show all of it as one thing")
        for node, agreement in zip(tree.node, tree.agreement, strict=True)
        if int(node) in names and agreement < _HARDLY_ONE
    ]


def _collisions(
    own: Mapping[int, InstanceMasks], things: Sequence[int], names: Mapping[int, str]
) -> list[tuple[int, str]]:
    """The things whose boxes, without a fiftieth of their points on either side, are nearly the same."""
    placed = [i for i in things if len(own[i].points)]
    if len(placed) < 2:
        return []
    boxes = np.array([np.quantile(own[i].points, (0.02, 0.98), axis=0) for i in placed])
    low, high = boxes[:, 0], boxes[:, 1]
    shared = np.prod(
        np.clip(np.minimum(high[:, None], high[None]) - np.maximum(low[:, None], low[None]), 0, None), axis=2
    )
    volume = np.prod(high - low, axis=1)
    iou = shared / np.maximum(volume[:, None] + volume[None] - shared, np.finfo(np.float64).tiny)
    np.fill_diagonal(iou, 0)
    return [
        (placed[a], f"boxes that collide: it fills the same place as {names[placed[b]]} (IoU {iou[a, b]:.2f})")
        for a, b in zip(*np.nonzero(iou > _SAME_SPACE), strict=True)
    ]


def _pieces(points: Float32, distance: float) -> int:
    """In how many places farther than `distance` from each other a fifth or more of the points lies."""
    if not len(points) or distance <= 0:
        return 0
    cells, count = np.unique(np.floor(points / distance).astype(np.int64), axis=0, return_counts=True)
    # Cells that touch, also at a corner, belong together.
    cluster = dbscan(cells.astype(np.float64), 1.75, 1)
    return int((np.bincount(cluster, weights=count) >= _PIECE * len(points)).sum())
