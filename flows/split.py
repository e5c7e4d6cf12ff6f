"""Photos and depth -> instances that all views agree on: the first half of the DAG (Split&Splat, Sec. 3.1)."""

from __future__ import annotations

from dataclasses import dataclass, replace

from ss_flow.flows.capture import Capture
from ss_flow.flows.masks import clicked_masks, labelled, masks_of_views
from ss_flow.flows.params import SplitParams
from ss_flow.graph import INDEX, each
from ss_flow.tasks.artifacts import (
    Appearances,
    Hierarchy,
    InstanceMasks,
    InstancesInView,
    MaskSet,
    PointCloud,
    PointLabels,
    PointParts,
    PromptedMasks,
    Visibility,
)
from ss_flow.tasks.models.catalogue import Model
from ss_flow.tasks.models.sam import EmbeddedPhoto, Embedding
from ss_flow.tasks.split.appearances import appearances
from ss_flow.tasks.split.boards import part_boards
from ss_flow.tasks.split.correct import correct, corrected_tree, part_masks
from ss_flow.tasks.split.cut import cut, cut_parts
from ss_flow.tasks.split.dense import dense
from ss_flow.tasks.split.dense_splatting import dense_splatting
from ss_flow.tasks.split.embed import embed
from ss_flow.tasks.split.hierarchy import hierarchy
from ss_flow.tasks.split.observe import observe
from ss_flow.tasks.split.overlooked import asked, claimed, confirmed, overlooked, with_answers
from ss_flow.tasks.split.parts import find_parts
from ss_flow.tasks.split.propagate import propagate
from ss_flow.tasks.split.reproject import instances_in_view, reproject
from ss_flow.tasks.split.reprompt import reprompt
from ss_flow.tasks.split.tally import tally
from ss_flow.tasks.split.visibility import visibility
from ss_flow.tasks.split.visible_by_color import visible_by_color
from ss_flow.tasks.split.walls import join_walls


@dataclass(frozen=True)
class Networks:
    """The networks of a run; None stands for the stated fallback."""

    segmenter: Model | None
    encoder: Model | None
    monodepth: Model | None
    patches: Model | None = None
    """For vectors of single Gaussians; there is no fallback, as these are made on request only."""
    perception: Model | None = None
    """For LPIPS; there is no fallback."""


@dataclass(frozen=True)
class Split:
    """Nodes of the first half, by the artifacts that they stand for; the paper's signs in brackets."""

    points: PointCloud
    """The dense points (P_dense)."""
    visibility: tuple[Visibility, ...]
    """Those that each view sees (P_k)."""
    masks: tuple[MaskSet, ...]
    """What the segmenter found in each view (M_k)."""
    voted: PointLabels
    """The labels that the views voted for (l_p)."""
    pieces: PointLabels
    """The same, and those of things that had none of their own: the leaves of the tree."""
    tree: Hierarchy
    """What the pieces make up; with the instances that boards and corrections made of others."""
    labels: PointLabels
    """The instances, which the cut through the tree leaves, boards apart, and as the user corrected them (P_labeled;
    in the paper the pieces themselves)."""
    parts: PointParts
    instances: tuple[InstanceMasks, ...]
    """With their masks in all views (M~); the background first."""
    appearances: Appearances
    """The views that see each of them."""
    embeddings: tuple[Embedding, ...]
    """One a view; none without a segmenter."""
    hinted: PointLabels | None
    """By the objects that were clicked, where some were."""


def split(capture: Capture, networks: Networks, params: SplitParams) -> Split:
    """Photos and depth -> view-consistent instances (Split&Splat, Sec. 3.1)."""
    points = _dense_points(capture, params)
    segmenter = networks.segmenter
    embeddings: tuple[Embedding, ...] = ()
    if segmenter is not None:
        embeddings = each(
            capture.frames,
            names=capture.names,
            build=lambda frame: embed(frame, model=segmenter, turns=capture.turns, noise=params.noise),
        )
    seen = _seen(capture, points, params)
    masks, hinted = masks_of_views(capture, embeddings, points, seen, segmenter, params)

    # Which masks of all views show one object (Sec. 3.1.3).
    observed = each(
        seen,
        masks,
        names=capture.names,
        build=lambda visible, pool: observe(points, visible, pool, params=params.observe.in_use()),
    )
    propagating, granularity = params.propagate, params.granularity
    if capture.clicks is not None:  # what was clicked as two objects stays two, and what was clicked as one, one
        propagating, granularity = replace(propagating, touching_merge=False), 1.0
    voted = pieces = propagate(points, seen, observed, params=propagating.in_use())
    shown = masks
    if segmenter is not None and capture.masks is None and capture.clicks is None and params.overlooked.rise:
        pieces, shown = _with_overlooked(capture, embeddings, points, seen, masks, voted, segmenter, params)

    # Which of these objects are pieces of one thing (beyond the paper).
    tallies = each(seen, shown, names=capture.names, build=lambda visible, pool: tally(visible, pool, pieces))
    tree = hierarchy(points, capture.cameras, seen, pieces, tallies, params=params.hierarchy)
    things = cut(points, pieces, tree, granularity=granularity)
    nested = find_parts(observed, masks, pieces, params=params.parts)
    labels = _divided(capture, embeddings, points, seen, pieces, tree, things, segmenter, params)
    if labels is not things:
        tree, contained = corrected_tree(tree, things, labels), params.segment.contained
        shown = each(
            seen,
            shown,
            names=capture.names,
            build=lambda visible, pool: part_masks(visible, pool, things, labels, contained=contained),
        )
    parts = cut_parts(pieces, nested, labels)

    # The labelled points as masks again (Sec. 3.1.3, last part).
    prompted: tuple[PromptedMasks, ...] = ()
    if segmenter is not None and capture.masks is None:
        prompted = _prompted(capture, embeddings, seen, shown, labels, segmenter, params)
    in_views = _in_views(capture, seen, shown, labels, prompted, params)
    instances = reproject(points, labels, parts, tree, in_views, min_views=params.reproject.min_views)
    seen_in = appearances(labels, seen)
    return Split(points, seen, masks, voted, pieces, tree, labels, parts, instances, seen_in, embeddings, hinted)


def _dense_points(capture: Capture, params: SplitParams) -> PointCloud:
    """The points that labels are given to (P_dense; Sec. 3.1.2)."""
    views = (capture.frames, capture.cameras)
    if params.dense_source == "splatting":
        return dense_splatting(
            *views, capture.depths, capture.unit, capture.colours, params=params.dense, splatting=params.splatting
        )
    return dense(*views, capture.presumed, capture.unit, capture.colours, params=params.dense)


def _seen(capture: Capture, points: PointCloud, params: SplitParams) -> tuple[Visibility, ...]:
    """Which points each view sees: by depth (P_k; Eq. 1, 2), and by their colour where it has none."""
    seen = each(
        capture.by_view,
        capture.presumed,
        names=capture.names,
        build=lambda camera, depth: visibility(points, camera, depth, params=params.visibility),
    )
    if capture.completed or not params.visible_color:
        return seen
    looks, color = capture.colours, params.visible_color
    return each(
        capture.presumed,
        capture.frames,
        seen,
        INDEX,
        names=capture.names,
        build=lambda depth, frame, visible, view: visible_by_color(
            points, capture.by_view[view], depth, frame, visible, (looks[view],) if looks else (), color=color
        ),
    )


def _with_overlooked(
    capture: Capture,
    embeddings: tuple[Embedding, ...],
    points: PointCloud,
    seen: tuple[Visibility, ...],
    masks: tuple[MaskSet, ...],
    voted: PointLabels,
    segmenter: Model,
    params: SplitParams,
) -> tuple[PointLabels, tuple[MaskSet, ...]]:
    """The labels, and those of things that had none of their own, since few views have a mask of them; and all masks,
    with those that the segmenter gave when it was asked for these things (beyond the paper)."""
    suspected = overlooked(points, capture.cameras, seen, voted, params=params.overlooked)
    answers = each(
        capture.frames,
        embeddings,
        seen,
        names=capture.names,
        build=lambda frame, embedding, visible: asked(
            EmbeddedPhoto(frame, embedding),
            visible,
            suspected,
            params=params.reprompt,
            pred_iou=params.segment.pred_iou,
            model=segmenter,
        ),
    )
    things = confirmed(suspected, answers)
    voting, segmenting = params.propagate, params.segment
    pieces = claimed(seen, voted, things, answers, tau_label=voting.tau_label, min_points=voting.min_label_points)
    shown = each(
        masks,
        answers,
        names=capture.names,
        build=lambda pool, more: with_answers(
            pool,
            more,
            things,
            grid=len(segmenting.grids),
            max_iou=segmenting.mask_nms,
            contained=segmenting.contained,
        ),
    )
    return pieces, shown


def _divided(
    capture: Capture,
    embeddings: tuple[Embedding, ...],
    points: PointCloud,
    seen: tuple[Visibility, ...],
    pieces: PointLabels,
    tree: Hierarchy,
    things: PointLabels,
    segmenter: Model | None,
    params: SplitParams,
) -> PointLabels:
    """The instances after what masks cannot tell: boards apart from what rises from them, the pieces of a wall as one,
    then the user's corrections (beyond the paper). Things come back as they are where there is none of these."""
    labels = things
    if capture.masks is None and capture.clicks is None:  # what the user showed stays
        if params.boards.rises:
            labels = part_boards(points, capture.cameras, labels, tree, params=params.boards)
        if params.walls.colors:
            labels = join_walls(points, labels, tree, params=params.walls, stuff=params.hierarchy.stuff)
    if capture.corrections is not None:
        by_clicks: list[PointLabels] = []
        if segmenter is not None:
            clicked = clicked_masks(capture, capture.corrections, embeddings, segmenter, params, apart=True)
            by_clicks = [labelled(points, seen, clicked, params)]
        labels = correct(points, seen, capture.corrections, pieces, labels, by_clicks, names=capture.things)
    return labels


def _prompted(
    capture: Capture,
    embeddings: tuple[Embedding, ...],
    seen: tuple[Visibility, ...],
    shown: tuple[MaskSet, ...],
    labels: PointLabels,
    segmenter: Model,
    params: SplitParams,
) -> tuple[PromptedMasks, ...]:
    """The segmenter's masks of the instances in all views, prompted with their points."""
    return each(
        capture.frames,
        embeddings,
        seen,
        shown,
        names=capture.names,
        build=lambda frame, embedding, visible, pool: reprompt(
            EmbeddedPhoto(frame, embedding),
            visible,
            pool,
            labels,
            model=segmenter,
            params=params.reprompt,
            selection=params.reproject.selection,
        ),
    )


def _in_views(
    capture: Capture,
    seen: tuple[Visibility, ...],
    shown: tuple[MaskSet, ...],
    labels: PointLabels,
    prompted: tuple[PromptedMasks, ...],
    params: SplitParams,
) -> tuple[InstancesInView, ...]:
    """The masks of the instances in each view, by its own masks and those that the segmenter was asked for."""
    return each(
        seen,
        shown,
        INDEX,
        names=capture.names,
        build=lambda visible, pool, view: instances_in_view(
            visible, pool, labels, (prompted[view],) if prompted else (), params=params.reproject.in_view()
        ),
    )
