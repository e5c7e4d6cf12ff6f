"""The DAG of Split&Splat: a capture -> view-consistent instances -> Gaussians -> one labelled scene -> descriptors."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, TypeVar

from ss_flow.errors import InputError
from ss_flow.flows.capture import Capture
from ss_flow.flows.params import Params, SplitParams
from ss_flow.graph import INDEX, each, expand, gather, labelled, otherwise, pick
from ss_flow.tasks.artifacts import (
    Appearances,
    Clicks,
    Descriptors,
    Gaussians,
    Hierarchy,
    InstanceMasks,
    LabelMap,
    MaskSet,
    PointCloud,
    PointLabels,
    PointParts,
    PromptedMasks,
    Visibility,
)
from ss_flow.tasks.evaluate.instances import evaluate_masks
from ss_flow.tasks.evaluate.novel_view import novel_view
from ss_flow.tasks.gaussians.views import Views
from ss_flow.tasks.models.catalogue import Model
from ss_flow.tasks.models.sam import EmbeddedPhoto, Embedding
from ss_flow.tasks.semantics.describe import describe
from ss_flow.tasks.semantics.name import given_names, name
from ss_flow.tasks.splat.collisions import MergePlan
from ss_flow.tasks.splat.merge import assemble, global_pass, merge_pair
from ss_flow.tasks.splat.plan import plan
from ss_flow.tasks.splat.reconstruct import reconstruct, retrain
from ss_flow.tasks.splat.refine import refine, rendered
from ss_flow.tasks.splat.render_masks import render_masks
from ss_flow.tasks.splat.resolve import exclusive, resolve, resolve_refined
from ss_flow.tasks.split import hints
from ss_flow.tasks.split.appearances import appearances, shown_in
from ss_flow.tasks.split.cut import cut, cut_parts
from ss_flow.tasks.split.dense import dense
from ss_flow.tasks.split.dense_splatting import dense_splatting
from ss_flow.tasks.split.embed import embed
from ss_flow.tasks.split.hierarchy import hierarchy
from ss_flow.tasks.split.observe import observe
from ss_flow.tasks.split.parts import find_parts
from ss_flow.tasks.split.propagate import propagate
from ss_flow.tasks.split.reproject import reproject
from ss_flow.tasks.split.reprompt import reprompt
from ss_flow.tasks.split.segment import segment
from ss_flow.tasks.split.segment_rgbd import segment_rgbd
from ss_flow.tasks.split.tally import tally
from ss_flow.tasks.split.visibility import visibility

R = TypeVar("R")


@dataclass(frozen=True)
class Networks:
    """The networks of a run; None stands for the stated fallback."""

    segmenter: Model | None
    encoder: Model | None
    monodepth: Model | None


@dataclass(frozen=True)
class Split:
    """Nodes of the first half, by the artifacts that they stand for."""

    points: PointCloud
    visibility: tuple[Visibility, ...]
    masks: tuple[MaskSet, ...]
    pieces: PointLabels
    """The leaves of the tree."""
    tree: Hierarchy
    labels: PointLabels
    """The instances, which the cut through the tree leaves."""
    parts: PointParts
    instances: tuple[InstanceMasks, ...]
    """The background first."""
    appearances: Appearances
    """The views that see each of them."""
    embeddings: tuple[Embedding, ...]
    """One a view; none without a segmenter."""
    hinted: PointLabels | None
    """By the objects that were clicked, where some were."""


def split_splat(capture: Capture, held_out: Capture | None, networks: Networks, params: Params) -> dict[str, Any]:
    """The whole DAG. Returns its results by step; `--until` takes these names."""
    halved = split(capture, networks, params.split)
    with labelled("split"):
        masks_split = resolve(capture.cameras, halved.instances)
    results: dict[str, Any] = {
        "ingest": capture.frames,
        "cameras": capture.cameras,
        **({"registration": capture.registration} if capture.registration is not None else {}),
        "depth": capture.depths,
        "dense": halved.points,
        "segment": halved.masks,
        "propagate": halved.pieces,
        "hierarchy": halved.tree,
        "cut": halved.labels,
        "parts": halved.parts,
        "reproject": halved.instances,
        "masks_split": masks_split,
    }
    if capture.truth is not None:
        with labelled("split"):
            results["metrics_split"] = evaluate_masks(
                masks_split, capture.truth, halved.tree, zero_is_void=params.evaluate.zero_is_void
            )
    results |= splat(capture, halved, networks, params)
    if capture.truth is not None:
        for stage, masks in (("refined", "masks_refined"), ("splat", "masks")):
            with labelled(stage):
                results[f"metrics_{stage}"] = evaluate_masks(
                    results[masks], capture.truth, halved.tree, zero_is_void=params.evaluate.zero_is_void
                )
    if held_out is not None:
        results["novel_view"] = novel_view(held_out.frames, held_out.cameras, results["scene"])
    results["names"] = name(results["describe"], encoder=networks.encoder)
    if halved.hinted is not None:
        results["names"] = given_names(results["names"], halved.hinted, halved.labels, objects=capture.objects)
    return results


def split(capture: Capture, networks: Networks, params: SplitParams) -> Split:
    """Photos and depth -> view-consistent instances (Split&Splat, Sec. 3.1)."""
    views = (capture.frames, capture.cameras, capture.depths)
    if params.dense_source == "splatting":
        points = dense_splatting(*views, capture.unit, params=params.dense, splatting=params.splatting)
    else:
        points = dense(*views, capture.unit, params=params.dense)
    segmenter = networks.segmenter
    embeddings: tuple[Embedding, ...] = ()
    if segmenter is not None:
        embeddings = each(capture.frames, names=capture.names, build=lambda frame: embed(frame, model=segmenter))
    seen = each(
        capture.by_view,
        capture.depths,
        names=capture.names,
        build=lambda camera, depth: visibility(points, camera, depth, params=params.visibility),
    )
    hinted: PointLabels | None = None
    if capture.masks is not None:
        masks = capture.masks
    elif capture.clicks is not None:
        masks, hinted = _masks_of_hints(capture, capture.clicks, embeddings, points, seen, segmenter, params)
    elif segmenter is not None:
        masks = each(
            capture.frames,
            embeddings,
            names=capture.names,
            build=lambda frame, embedding: segment(frame, embedding, params=params.segment, model=segmenter),
        )
    else:
        masks = each(
            capture.frames,
            capture.depths,
            names=capture.names,
            build=lambda frame, depth: segment_rgbd(frame, depth, capture.cameras, params=params.rgbd),
        )
    observed = each(
        seen,
        masks,
        names=capture.names,
        build=lambda visible, pool: observe(points, visible, pool, params=params.observe),
    )
    propagating, granularity = params.propagate, params.granularity
    if capture.clicks is not None:  # what was clicked as two objects stays two
        propagating, granularity = replace(propagating, touching_merge=False), 1.0
    pieces = propagate(points, seen, observed, params=propagating)
    counted = each(seen, masks, names=capture.names, build=lambda visible, pool: tally(visible, pool, pieces))
    tree = hierarchy(points, capture.cameras, pieces, counted, params=params.hierarchy)
    labels = cut(pieces, tree, granularity=granularity)
    parts = cut_parts(pieces, find_parts(observed, masks, pieces, params=params.parts), labels)
    prompted: tuple[PromptedMasks, ...] = ()
    if segmenter is not None and capture.masks is None:
        prompted = each(
            capture.frames,
            embeddings,
            seen,
            masks,
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
    instances = reproject(points, seen, masks, labels, parts, prompted, params=params.reproject)
    seen_in = appearances(labels, seen)
    return Split(points, seen, masks, pieces, tree, labels, parts, instances, seen_in, embeddings, hinted)


def _masks_of_hints(
    capture: Capture,
    clicks: tuple[Clicks, ...],
    embeddings: tuple[Embedding, ...],
    points: PointCloud,
    seen: tuple[Visibility, ...],
    segmenter: Model | None,
    params: SplitParams,
) -> tuple[tuple[MaskSet, ...], PointLabels]:
    """The masks of all views from points clicked in a few, and the points labelled by the clicked objects."""
    if segmenter is None:
        raise InputError(
            "hints need a segmenter to be prompted with, and there is none; `ss-flow models list` names some."
        )
    clicked = each(
        capture.frames,
        embeddings,
        clicks,
        names=capture.names,
        build=lambda frame, embedding, own: hints.clicked(EmbeddedPhoto(frame, embedding), own, model=segmenter),
    )
    hinted = hints.label(points, seen, clicked, erosion=params.observe.erosion, tau_label=params.propagate.tau_label)
    masks = each(
        capture.frames,
        embeddings,
        seen,
        clicked,
        names=capture.names,
        build=lambda frame, embedding, visible, own: hints.spread(
            EmbeddedPhoto(frame, embedding),
            visible,
            own,
            hinted,
            params=params.reprompt,
            contained=params.segment.contained,
            model=segmenter,
        ),
    )
    return masks, hinted


def splat(capture: Capture, halved: Split, networks: Networks, params: Params) -> dict[str, Any]:
    """Instances -> Gaussians, each on its own; refined masks; one scene (Split&Splat, Sec. 3.2)."""
    views = Views(capture.frames, capture.by_view, capture.depths, capture.unit)
    settings, visibility = params.splat, params.split.visibility

    def of_instance(row: int, build: Callable[[list[int]], R]) -> R:
        """What `build` makes of the views that see an instance: a step for one instance depends on no others."""
        return expand(halved.appearances, lambda seen_in: build(seen_in.views(row)))

    @functools.cache
    def reconstructed(row: int) -> Gaussians:
        return of_instance(
            row,
            lambda seen: reconstruct(
                some(views, seen), halved.instances[row], params=settings.reconstruct, visibility=visibility
            ),
        )

    @functools.cache
    def refined(row: int) -> InstanceMasks:
        return of_instance(
            row,
            lambda seen: refine(
                some(views, seen),
                halved.instances[row],
                reconstructed(row),
                pick(halved.embeddings, seen) if networks.segmenter is not None else (),
                model=networks.segmenter,
                params=settings.refine,
                visibility=visibility,
            ),
        )

    def retrained(row: int) -> Gaussians:
        return of_instance(
            row,
            lambda seen: retrain(
                some(views, seen),
                exclusive(refined(row), pick(masks_refined, seen)),
                reconstructed(row),
                params=settings.reconstruct,
                visibility=visibility,
            ),
        )

    def pictured(row: int, seen: list[int]) -> InstanceMasks:
        if params.semantics.masks == "refined":
            return refined(row)
        return rendered(
            some(views, seen), refined(row), reconstructed(row), params=settings.refine, visibility=visibility
        )

    def described(row: int) -> Descriptors:
        return of_instance(
            row,
            lambda seen: describe(
                pick(capture.frames, seen),
                pictured(row, seen),
                encoder=networks.encoder,
                params=params.semantics.describe,
            ),
        )

    def of_each(build: Callable[[int], R]) -> tuple[R, ...]:
        return each(halved.instances, INDEX, build=lambda _, row: build(row), on_error="skip")

    masks_of_each = of_each(refined)
    with labelled("splat"):
        masks_refined = resolve_refined(views, masks_of_each, params=settings.resolve, visibility=visibility)
        shown = shown_in(masks_refined)
    merged = merge_rounds(views, of_each(retrained), masks_refined, shown, params, 0)
    assembled = assemble(merged)
    scene = otherwise(global_pass(views, assembled, masks_refined, params=settings.merge), lambda: assembled)
    return {
        "reconstruct": of_each(reconstructed),
        "refine": masks_of_each,
        "masks_refined": masks_refined,
        "merge": merged,
        "scene": scene,
        "masks": render_masks(views, scene, masks_refined, params=settings.masks),
        "describe": of_each(described),
    }


def some(views: Views, rows: list[int]) -> Views:
    """Some views of a scene, in a flow."""
    return Views(pick(views.frames, rows), pick(views.cameras, rows), pick(views.depths, rows), views.unit)


def merge_rounds(
    views: Views,
    groups: tuple[Gaussians, ...],
    masks: tuple[LabelMap, ...],
    shown: Appearances,
    params: Params,
    number: int,
) -> tuple[Gaussians, ...]:
    """Merge the pairs that collide, disjoint pairs side by side, until none is left (spec P4).

    shown: which views show which instance.
    """

    def build(planned: MergePlan) -> tuple[Gaussians, ...]:
        if not len(planned.pairs):
            return groups
        merged: list[Gaussians] = []
        for row, (a, b) in enumerate(planned.pairs.tolist()):
            pair, seen = (groups[a], groups[b]), planned.views(row)
            with labelled(f"{number}.{a}+{b}"):
                refined = merge_pair(
                    some(views, seen),
                    *pair,
                    pick(masks, seen),
                    params=params.splat.merge,
                    w_mask=planned.mask_weight,
                    visibility=params.split.visibility,
                )
                # A pair that cannot be refined is joined as it is.
                merged.append(otherwise(refined, functools.partial(assemble, pair)))
        rest = [groups[i] for i in planned.singles.tolist()]
        return merge_rounds(views, gather([*merged, *rest]), masks, shown, params, number + 1)

    with labelled(str(number)):
        planned = plan(groups, shown, params=params.splat.plan, round=number)
    return expand(planned, build)
