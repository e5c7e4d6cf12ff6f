"""Instances -> Gaussians -> one labelled scene: the second half of the DAG (Split&Splat, Sec. 3.2)."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, TypeVar

from ss_flow.flows.capture import Capture
from ss_flow.flows.params import Params
from ss_flow.flows.split import Networks, Split
from ss_flow.graph import INDEX, each, expand, gather, labelled, otherwise, pick
from ss_flow.tasks.artifacts import (
    Appearances,
    Descriptors,
    Gaussians,
    InstanceMasks,
    LabelMap,
)
from ss_flow.tasks.gaussians.views import Views
from ss_flow.tasks.semantics.describe import describe
from ss_flow.tasks.splat.collisions import MergePlan
from ss_flow.tasks.splat.global_pass import assemble, global_pass
from ss_flow.tasks.splat.merge import merge_pair
from ss_flow.tasks.splat.plan import plan
from ss_flow.tasks.splat.reconstruct import reconstruct, retrain
from ss_flow.tasks.splat.refine import refine, rendered
from ss_flow.tasks.splat.render_masks import render_masks
from ss_flow.tasks.splat.resolve import exclusive, resolve_refined
from ss_flow.tasks.split.appearances import shown_in

R = TypeVar("R")


def splat(capture: Capture, found: Split, networks: Networks, params: Params) -> dict[str, Any]:
    """Instances -> Gaussians, each on its own; refined masks; one scene (Split&Splat, Sec. 3.2).

    What is built for an instance takes its row in `found.instances`: a step for one row depends on no other's.
    """
    views = capture.views
    settings, visibility = params.splat, params.split.visibility.of_splat()

    @functools.cache
    def reconstructed(row: int) -> Gaussians:
        """G_l, from the instance's own pixels (Sec. 3.2.1)."""
        return of_instance(
            found,
            row,
            lambda seen: reconstruct(
                some(views, seen), found.instances[row], params=settings.reconstruct.of_first(), visibility=visibility
            ),
        )

    @functools.cache
    def refined(row: int) -> InstanceMasks:
        """M^_l, its masks as M^gs and the segmenter mend them (Sec. 3.2.2)."""
        return of_instance(
            found,
            row,
            lambda seen: refine(
                some(views, seen),
                found.instances[row],
                reconstructed(row),
                pick(found.embeddings, seen) if networks.segmenter is not None else (),
                model=networks.segmenter,
                params=settings.refine.in_use(networks.segmenter),
                visibility=visibility,
            ),
        )

    def retrained(row: int) -> Gaussians:
        """G_l once more, where its masks have changed."""
        return of_instance(
            found,
            row,
            lambda seen: retrain(
                some(views, seen),
                exclusive(refined(row), pick(masks_refined, seen)),
                found.instances[row],
                reconstructed(row),
                params=settings.reconstruct,
                visibility=visibility,
            ),
        )

    def of_each(build: Callable[[int], R]) -> tuple[R, ...]:
        return each(found.instances, INDEX, build=lambda _, row: build(row), on_error="skip")

    masks_of_each = of_each(refined)
    with labelled("splat"):
        masks_refined = resolve_refined(views, masks_of_each, params=settings.resolve, visibility=visibility)
        shown = shown_in(masks_refined)

    # One scene (Sec. 3.2.3): pairs that collide, where parameters ask for them; then all at once, with the background.
    merged = merge_rounds(views, of_each(retrained), masks_refined, shown, params, 0)
    assembled = assemble(merged)
    last = settings.merge.of_last_pass()
    finished = global_pass(views, assembled, masks_refined, params=last, visibility=visibility)
    scene = otherwise(finished, lambda: assembled)
    return {
        "reconstruct": of_each(reconstructed),
        "refine": masks_of_each,
        "masks_refined": masks_refined,
        "merge": merged,
        "scene": scene,
        "masks": final_masks(capture, scene, masks_refined, params),
        "describe": described(capture, found, networks, params, refined, reconstructed),
    }


def final_masks(
    capture: Capture, scene: Gaussians, masks: tuple[LabelMap, ...], params: Params
) -> tuple[LabelMap, ...]:
    """The masks that the finished scene shows in all views; masks: the exclusive ones before."""
    return each(
        capture.frames,
        capture.by_view,
        capture.depths,
        masks,
        names=capture.names,
        build=lambda frame, camera, depth, known: render_masks(
            frame, camera, depth, scene, known, params=params.splat.masks
        ),
    )


def described(
    capture: Capture,
    found: Split,
    networks: Networks,
    params: Params,
    masks: Callable[[int], InstanceMasks],
    gaussians: Callable[[int], Gaussians],
) -> tuple[Descriptors, ...]:
    """The descriptors of all instances (f_obj; Sec. 5.2); masks, gaussians: the nodes of an instance's own, by its
    row."""
    describing = params.semantics.describe.in_use(networks.encoder)

    def build(row: int, seen: list[int]) -> Descriptors:
        pictured = masks(row)
        if params.semantics.masks == "rendered":
            pictured = rendered(
                some(capture.views, seen),
                pictured,
                gaussians(row),
                params=params.splat.refine.in_use(None),
                visibility=params.split.visibility.of_splat(),
            )
        frames = pick(capture.frames, seen)
        turns = capture.turns if networks.encoder is not None else 0  # colours have no upper side
        return describe(frames, pictured, encoder=networks.encoder, params=describing, turns=turns)

    return each(
        found.instances,
        INDEX,
        build=lambda _, row: of_instance(found, row, lambda seen: build(row, seen)),
        on_error="skip",
    )


def of_instance(found: Split, row: int, build: Callable[[list[int]], R]) -> R:
    """What `build` makes of the views that see an instance: a step for one instance depends on no others."""
    return expand(found.appearances, lambda seen_in: build(seen_in.views(row)))


def some(views: Views, rows: list[int]) -> Views:
    """Some views of a scene, in a flow."""
    colours = pick(views.colours, rows) if views.colours else ()
    return Views(pick(views.frames, rows), pick(views.cameras, rows), pick(views.depths, rows), views.unit, colours)


def merge_rounds(
    views: Views,
    groups: tuple[Gaussians, ...],
    masks: tuple[LabelMap, ...],
    shown: Appearances,
    params: Params,
    number: int,
) -> tuple[Gaussians, ...]:
    """Merge the pairs that collide, disjoint pairs side by side, until none is left (Split&Splat, Sec. 3.2.3; spec P4).

    shown: which views show which instance. number: of the round, from 0.
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
                    params=params.splat.merge.of_pairs(),
                    w_mask=planned.mask_weight,
                    visibility=params.split.visibility.of_splat(),
                )
                # A pair that cannot be refined is joined as it is.
                merged.append(otherwise(refined, functools.partial(assemble, pair)))
        rest = [groups[i] for i in planned.singles.tolist()]
        return merge_rounds(views, gather([*merged, *rest]), masks, shown, params, number + 1)

    with labelled(str(number)):
        planned = plan(groups, shown, params=params.splat.plan.in_use(), round=number)
    return expand(planned, build)
