"""Pairs of instances that collide, trained together (Split&Splat, Sec. 3.2.3; spec P4).

No pair is merged unless `plan.max_rounds` is set, as in `paper`; `default` leaves all to the last pass (`global_pass`).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from ss_flow.task import Resources, task
from ss_flow.tasks.artifacts import Bool, Float32, Float64, Gaussians, Int32, LabelMap
from ss_flow.tasks.gaussians.initialise import NO_GAUSSIANS, concatenate, extents, select
from ss_flow.tasks.gaussians.learning_rates import LearningRates
from ss_flow.tasks.gaussians.objective import Objective
from ss_flow.tasks.gaussians.rasterize import backend_identity
from ss_flow.tasks.gaussians.render import render
from ss_flow.tasks.gaussians.trainer import TrainParams, train
from ss_flow.tasks.gaussians.views import (
    IGNORED,
    NONE_OF_MINE,
    CropParams,
    PointSurface,
    SceneViews,
    TrainView,
    Views,
    group_view,
)
from ss_flow.tasks.geometry.cameras import camera_extent, pixels_in_view
from ss_flow.tasks.geometry.visibility import VisibilityParams
from ss_flow.tasks.ranges import Count, Fraction, HarmonicsDegree, Natural, NonNegative
from ss_flow.tasks.splat.collisions import SOLID_OPACITY, TRIMMED, group_box
from ss_flow.tasks.splat.guard import guarded
from ss_flow.tasks.unread import by_default

_OF_PAIRS = (
    "iterations_per_view",
    "min_iterations",
    "max_iterations",
    "objective",
    "reset_opacity",
    "ignore_occluded",
    "local",
    "collision_margin",
)
"""What the last pass never reads."""
_OF_LAST_PASS = (
    "global_iterations",
    "global_objective",
    "global_mask_weight",
    "side_weight",
    "side_views",
    "relabel_after",
    "prune_hidden",
    "sh_every",
)
"""What the merging of a pair never reads."""


@dataclass(frozen=True)
class MergeParams:
    """How merged Gaussians are refined together, without densification."""

    iterations_per_view: Count = 6
    """Training steps of a pair for each view that sees it, within the two limits below."""
    min_iterations: Count = 60
    """Fewest steps of a pair."""
    max_iterations: Count = 150
    """Most steps of a pair."""
    global_iterations: Natural = 1500
    """Steps of the last pass over the whole scene; 0 leaves it out."""
    objective: Objective = Objective()
    """What the training of a pair makes small, besides w_mask times the mask loss."""
    global_objective: Objective = Objective()
    """The same for the last pass."""
    global_mask_weight: NonNegative = 0.25
    """w_mask of the last pass."""
    side_weight: NonNegative = 0.05
    """Weight, in the last pass, of the alpha where an instance, seen alone from anywhere, has no surface near: summed
    there, as a share of all pixels of such a view; 0 = only photos count."""
    side_views: Count = 24
    """Views of each instance that this is looked at from; where these are more in all than steps, as many as share out
    the steps, rounded up."""
    relabel_after: Natural = 100
    """Steps of the last pass after which its Gaussians get their labels anew, from what the scene shows by then; 0 =
    labels stay, as they do where the pass has no more steps. From there on rates fall from their first values."""
    reset_opacity: bool = False
    """Whether what collides starts from opacities of at most 0.01, as in the paper."""
    prune_opacity: Fraction = 0.005
    """Fainter Gaussians are dropped in the end."""
    prune_contribution: Fraction = 1 / 255
    """Gaussians that add no more than this to any pixel of any view are dropped in the end."""
    prune_hidden: Fraction = 0.05
    """Gaussians of which no view shows more than this share are dropped in the end of the last pass: nothing has shaped
    them, and they come to light when a thing is looked at from elsewhere, or another is taken away."""
    sh_degree: HarmonicsDegree = 2
    """Highest degree of the colour's spherical harmonics."""
    sh_every: Count = 500
    """Steps of the last pass from one degree to the next; a pass of less than two such spans keeps to 0."""
    ignore_occluded: bool = True
    """Whether pixels where something else is in front of a pair are left out; False calls them empty, as in the
    paper."""
    local: bool = True
    """Whether only what is inside the box of the smaller group is refined; False refines both groups whole."""
    collision_margin: NonNegative = 0.05
    """By how much that box is widened on every side, as a share of its diagonal."""
    extent: Literal["instance", "cameras"] = "instance"
    """What lengths are shares of, the rate of the means above all: "instance", the diagonal of each Gaussian's own
    instance; or "cameras", the radius of the cameras that see them, as in 3DGS (where that is 0, the diagonal)."""
    max_length: NonNegative = 1.5
    """No Gaussian becomes longer (one standard deviation) than so many times the median with which those of its
    instance start; the background's may. 0 = any."""
    rates: LearningRates = LearningRates(
        position=6.4e-4,
        position_final=6.4e-6,
        color=0.02,
        opacity=0.15,
        scale=0.06,
        rotation=0.012,
        final_share=0.1,
        fall="cosine",
    )
    """How fast each parameter is learnt: faster at first than training could end with, then more and more slowly."""
    guard_iou: Fraction = 0.02
    """A refinement that lowers the mean IoU of the masks by more than this is undone."""
    guard_psnr: NonNegative = 1.0
    """A refinement that lowers the PSNR by more than this, in dB, is undone."""
    guard_trade: NonNegative = 2.0
    """Such a loss is allowed where the other of the two gains more than so many times as much, both counted in these
    limits: 0.06 of IoU for more than 6 dB. 0 = never, nor where a limit is 0."""
    guard_views: Natural = 12
    """Views that the two are measured on; 0 = nothing is measured and no refinement undone, as in the paper."""
    crop: CropParams = CropParams()
    """The part of each view that is rendered."""
    seed: Natural = 0
    """Another one trains on the views in another order, and before other random backgrounds."""

    def iterations(self, num_views: int) -> int:
        """Training steps of a pair that so many views see (spec row 34)."""
        return int(np.clip(self.iterations_per_view * num_views, self.min_iterations, self.max_iterations))

    def of_pairs(self) -> MergeParams:
        """For `merge_pair`: what only the last pass reads is as by default, so that it does not enter the key."""
        return by_default(self, *_OF_LAST_PASS)

    def of_last_pass(self) -> MergeParams:
        """For `global_pass`: what only pairs read is as by default, so that it does not enter the key."""
        return replace(by_default(self, *_OF_PAIRS), crop=CropParams(max_side=self.crop.max_side))


@task(
    name="splat.merge_pair",
    resources=Resources(cores=1, most_cores=8, memory_mb=2000, gpus=0.05),
    environment=backend_identity,
)
def merge_pair(
    views: Views,
    a: Gaussians,
    b: Gaussians,
    masks: tuple[LabelMap, ...],
    *,
    params: MergeParams,
    w_mask: float,
    visibility: VisibilityParams = VisibilityParams(),
) -> Gaussians:
    """Two groups as one, refined together where they collide (Split&Splat, Eq. 5, 6).

    What collides are, with `local`, the Gaussians inside the box of the smaller group, and the instances they belong
    to; all else is kept as it is, and with it the time that a merge takes grows with the smaller group, not with the
    scene. With `reset_opacity`, opacities of what collides start from min(alpha, 0.01), so that what only explained an
    occluder does not come back (spec A23). The loss is w_mask * l_mask, the masks of those instances composited jointly
    (spec A25, A26), besides `objective`: l_RGB, and the losses of alpha and depth where they have a weight. When
    refinement makes masks or colours worse than the guard allows, the plain union comes back, with a warning (spec P4).

    views: at least those that show an instance of a or b; masks: their exclusive label maps. The order of a and b does
    not matter.
    """
    parts = sorted((part for part in (a, b) if len(part)), key=lambda part: int(part.instance_id.min()))
    if len(parts) < 2:
        return parts[0] if parts else NO_GAUSSIANS
    union = concatenate(parts)
    low, high = collision_box(min(parts, key=len), params.collision_margin)
    reach = ((union.means >= low) & (union.means <= high)).all(axis=1) | (not params.local)
    near = np.isin(union.instance_id, union.instance_id[reach])
    colliding, reach = select(union, near), reach[near]
    ids = np.unique(colliding.instance_id)
    seen = _group_views(
        views.compared(visibility), masks, ids, colliding, params, others=union.instance_id, around=reach
    )
    if not seen:
        return union
    started = _faded(colliding, reach) if params.reset_opacity else colliding
    settings = TrainParams(
        iterations=params.iterations(len(seen)),
        sh_degree=params.sh_degree,
        objective=params.objective,
        densify="none",
        mask_weight=w_mask,
        prune_opacity=0.0,
        prune_contribution=0.0,
        max_length=params.max_length,
        rates=params.rates,
    )
    trained = train(
        started,
        seen,
        params=settings,
        extent=extent(colliding, seen, params),
        seed=int(ids[0]) + (params.seed << 32),
        label_ids=ids.tolist(),
    ).gaussians
    refined = select(trained, ~reach | _shows(trained, seen, params))
    merged = guarded(colliding, refined, seen, ids, params)
    return concatenate([select(union, ~near), merged]) if not near.all() else merged


def extent(gaussians: Gaussians, seen: Sequence[TrainView], params: MergeParams) -> float | Float32:
    """World units, of all or for each of them."""
    own = extents(gaussians)
    return own if params.extent == "instance" else camera_extent([view.camera for view in seen]) or own


def collision_box(group: Gaussians, margin: float) -> Float64:
    """The box of a group's solid centres, widened on every side by `margin` of its diagonal: [2, 3], world."""
    low, high = group_box(group, min_opacity=SOLID_OPACITY, quantile=TRIMMED)
    wider = margin * float(np.linalg.norm(high - low))
    return np.array([low - wider, high + wider])


def _solid_centres(gaussians: Gaussians) -> Float32:
    """Centres of the Gaussians that are not faint; of all where hardly any is left."""
    solid = gaussians.means[gaussians.opacities >= SOLID_OPACITY]
    return solid if len(solid) > 1 else gaussians.means


def _faded(gaussians: Gaussians, rows: Bool) -> Gaussians:
    """With opacities of at most 0.01 in these rows (Kerbl et al. 2023; spec A23)."""
    faded = np.minimum(gaussians.opacity_logits, np.float32(np.log(0.01 / 0.99)))
    return replace(gaussians, opacity_logits=np.where(rows, faded, gaussians.opacity_logits))


def _shows(gaussians: Gaussians, views: Sequence[TrainView], params: MergeParams) -> Bool:
    """[N] which Gaussians are worth keeping (spec row 37)."""
    strongest = np.zeros(len(gaussians), np.float32)
    for view in views:
        np.maximum(strongest, render(gaussians, view.camera).max_contribution, out=strongest)
    opaque = gaussians.opacities >= params.prune_opacity
    return opaque & (strongest >= params.prune_contribution)


def _group_views(
    scene: SceneViews,
    masks: Sequence[LabelMap],
    ids: Int32,
    group: Gaussians,
    params: MergeParams,
    *,
    others: Int32,
    around: Bool,
) -> list[TrainView]:
    """The views that see any of a group's Gaussians that collide.

    ids: its instances. others: ids of instances that are not trained, whose pixels say nothing. around: [N] the
    Gaussians that collide, which the crops show.
    """
    surface, shown = PointSurface.of(_solid_centres(group)), group.means[around]
    views = []
    for view, shows in enumerate(channels(masks, ids, NONE_OF_MINE, others)):
        if (shows >= 0).any() and len(pixels_in_view(shown, scene.cameras[view])[0]):
            views.append(
                group_view(
                    scene, view, shows, surface,
                    crop=params.crop, ignore_occluded=params.ignore_occluded, around=shown,
                )
            )  # fmt: skip
    return [view for view in views if view.inside.any()]


def channels(masks: Sequence[LabelMap], ids: Int32, rest: int, others: Int32) -> Iterator[Int32]:
    """[H, W] of each view: the place in `ids` of the instance at a pixel, IGNORED for `others`, else `rest`."""
    channel_of = np.full(np.iinfo(np.uint16).max + 1, rest, np.int32)
    channel_of[others] = IGNORED
    channel_of[ids] = np.arange(len(ids))
    return (channel_of[label_map.ids] for label_map in masks)
