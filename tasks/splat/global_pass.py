"""The whole scene as one: assembled, and trained together on whole photos (spec P4, A22).

Beyond Split&Splat, which merges pairs (Sec. 3.2.3) and ends with the last one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ss_flow.running import counted, nothing_kept
from ss_flow.task import Resources, task
from ss_flow.tasks.artifacts import Float32, Gaussians, Int32, LabelMap
from ss_flow.tasks.gaussians.initialise import NO_GAUSSIANS, concatenate, select
from ss_flow.tasks.gaussians.rasterize import backend_identity
from ss_flow.tasks.gaussians.trainer import PartView, TrainParams, train
from ss_flow.tasks.gaussians.views import NONE_OF_MINE, SceneViews, TrainView, Views, whole_view
from ss_flow.tasks.geometry.visibility import VisibilityParams
from ss_flow.tasks.splat.guard import guarded
from ss_flow.tasks.splat.merge import MergeParams, channels, extent
from ss_flow.tasks.splat.relabel import relabelled, shown_masks
from ss_flow.tasks.splat.side_views import side_views
from ss_flow.tasks.splat.strays import without_strays

SIDES_PER_STEP = 2
"""Views of instances alone that a step of the last pass sees besides a photo."""


@task(name="splat.assemble")
def assemble(groups: tuple[Gaussians, ...]) -> Gaussians:
    """All groups as one scene, ordered by instance id; inside an instance the order stays."""
    parts = [group for group in groups if len(group)]
    if not parts:
        return NO_GAUSSIANS
    return by_instance(concatenate(sorted(parts, key=lambda part: int(part.instance_id.min()))))


def by_instance(gaussians: Gaussians) -> Gaussians:
    """Ordered by instance id; inside an instance the order stays."""
    return select(gaussians, np.argsort(gaussians.instance_id, kind="stable"))


@task(
    name="splat.global_pass",
    resources=Resources(cores=1, most_cores=16, memory_mb=4000, gpus=0.5),
    environment=backend_identity,
)
def global_pass(
    views: Views,
    scene: Gaussians,
    masks: tuple[LabelMap, ...],
    *,
    params: MergeParams,
    visibility: VisibilityParams = VisibilityParams(),
) -> Gaussians:
    """A last, short training of the whole scene with its background, on whole photos (spec P4, A22).

    scene: as `assemble` gives it. masks: exclusive label maps of all views. visibility: how far depths of one surface
    may differ. Opacities are kept and nothing is split or cloned. The loss is that of a pair (Eq. 5, 6), here
    `global_objective` and `global_mask_weight` times the mask loss, and `side_weight` times what an instance covers
    beside its surface (`side_views`); the guard of `merge_pair` holds here too. A scene of which no mask shows
    anything comes back as it is.

    After `relabel_after` steps the scene shows what belongs to what better than the masks do. So a Gaussian whose place
    shows another instance in most views becomes that one's, and only then is each instance looked at from the side. In
    the end what stands apart from its instance, where those views show others, is the background's.
    """
    if not len(scene) or not params.global_iterations:
        return scene
    ids = np.unique(scene.instance_id)
    compared = views.compared(visibility)
    seen = _whole_views(compared, masks, ids, params.crop.max_side)
    if not seen:
        return scene
    first = params.relabel_after if params.relabel_after < params.global_iterations else 0
    settings = _settings(params, params.global_iterations - first)
    surface, begun, shown = scene, scene, masks
    if first:
        with nothing_kept(), counted(0, params.global_iterations):
            begun = _trained(scene, seen, ids, _opening(settings, first), params, extent(scene, seen, params))
        shown = tuple(shown_masks(views, begun, masks))
        surface = relabelled(compared, scene, shown)
        labels = {name: getattr(surface, name) for name in ("instance_id", "instance_conf", "part_id")}
        surface, begun = by_instance(surface), by_instance(replace(begun, **labels))
    parts: list[PartView] = []
    if params.side_weight:
        parts = side_views(compared, surface, shown, params.side_views, params.global_iterations)
    with counted(first, params.global_iterations):
        finished = _trained(begun, seen, ids, settings, params, extent(surface, seen, params), parts)
    if first:
        finished = by_instance(without_strays(views.cameras, finished, shown))
    return guarded(scene, finished, seen, ids, params)


def _settings(params: MergeParams, steps: int) -> TrainParams:
    return TrainParams(
        iterations=steps,
        sh_degree=params.sh_degree,
        sh_every=params.sh_every,
        objective=params.global_objective,
        densify="none",
        mask_weight=params.global_mask_weight,
        part_weight=params.side_weight,
        parts_per_step=SIDES_PER_STEP,
        prune_opacity=params.prune_opacity,
        prune_contribution=params.prune_contribution,
        prune_hidden=params.prune_hidden,
        max_length=params.max_length,
        rates=params.rates,
    )


def _opening(settings: TrainParams, steps: int) -> TrainParams:
    """For the steps before labels are given anew: nothing falls, and every Gaussian stays."""
    return replace(
        settings,
        iterations=steps,
        objective=replace(settings.objective, depth_weight_final=settings.objective.depth_weight_start),
        rates=replace(settings.rates, position_final=settings.rates.position, final_share=1.0),
        prune_opacity=0.0,
        prune_contribution=0.0,
        prune_hidden=0.0,
    )


def _trained(
    begun: Gaussians,
    seen: Sequence[TrainView],
    ids: Int32,
    settings: TrainParams,
    params: MergeParams,
    extent: float | Float32,
    parts: Sequence[PartView] = (),
) -> Gaussians:
    """extent, parts: as `train` takes them."""
    seed, labels = params.seed << 32, ids.tolist()
    return train(begun, seen, params=settings, extent=extent, seed=seed, label_ids=labels, parts=parts).gaussians


def _whole_views(scene: SceneViews, masks: Sequence[LabelMap], ids: Int32, max_side: int) -> list[TrainView]:
    """The entire photos that show any of the instances."""
    # What has no Gaussians of its own can only be explained by the background.
    rest = 0 if ids[0] == 0 else NONE_OF_MINE
    shows = channels(masks, ids, rest, np.zeros(0, np.int32))
    views = [whole_view(scene, view, c, max_side) for view, c in enumerate(shows) if (c >= 0).any()]
    return [view for view in views if view.inside.any()]
