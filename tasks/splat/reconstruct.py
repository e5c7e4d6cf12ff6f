"""One instance's Gaussians from its masked views (Split&Splat, Sec. 3.2.1; spec P1)."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Annotated, Literal

import numpy as np

from ss_flow.running import warn
from ss_flow.task import Resources, task
from ss_flow.tasks.artifacts import Float32, Gaussians, InstanceMasks, Int32
from ss_flow.tasks.gaussians.densification import Schedule
from ss_flow.tasks.gaussians.initialise import NO_GAUSSIANS, initialise, laid_flat
from ss_flow.tasks.gaussians.learning_rates import LearningRates
from ss_flow.tasks.gaussians.objective import Objective
from ss_flow.tasks.gaussians.rasterize import backend_identity
from ss_flow.tasks.gaussians.trainer import TrainParams, train
from ss_flow.tasks.gaussians.views import (
    CropParams,
    PointSurface,
    SceneViews,
    Views,
    background_view,
    channels_of_mask,
    group_view,
)
from ss_flow.tasks.geometry.cameras import camera_extent
from ss_flow.tasks.geometry.sampling import first_of_each_cube
from ss_flow.tasks.geometry.shape import box_diagonal
from ss_flow.tasks.geometry.visibility import VisibilityParams
from ss_flow.tasks.masks.dilation import dilated
from ss_flow.tasks.ranges import Count, Fraction, HarmonicsDegree, Natural, NonNegative, Positive, Range
from ss_flow.tasks.splat.consensus import agreed, completed
from ss_flow.tasks.unread import by_default


@dataclass(frozen=True)
class ReconstructParams:
    """How an instance is trained."""

    iterations_per_view: Count = 8
    """Training steps for each view of the instance, within the two limits below."""
    min_iterations: Count = 30
    """Fewest steps."""
    max_iterations: Count = 60
    """Most steps."""
    retrain_share: NonNegative = 0.0
    """Steps of training after refinement, as a share of the first training's; 0 leaves it out."""
    warm_start: bool = True
    """Whether training after refinement goes on from the Gaussians of the first, or starts over."""
    sh_degree: HarmonicsDegree = 3
    """Highest degree of the colour's spherical harmonics; they stay at 0 below 2000 steps."""
    max_points: Natural = 10_000
    """Most points that training starts from; more are thinned out. 0 = all points, as in the paper."""
    max_gaussians: Natural = 30_000
    """Most Gaussians of an instance to which clones and splits lead; 0 = any number, as in the paper."""
    background_scale: Positive = 2.0
    """Factor on steps, points and Gaussians for the background, which is the largest by far."""
    thickness: Annotated[float, Range(0.0, 1.0, open_below=True)] = 0.1
    """Standard deviation of the first Gaussians along the normal of the surface that the points lie on, as a share of
    that along the surface; 1 = round, as in 3DGS."""
    first_opacity: Annotated[float, Range(0.0, 1.0, open_below=True, open_above=True)] = 0.5
    """Opacity of the first Gaussians; 0.1 in 3DGS."""
    tau_agree: Fraction = 0.7
    """Near the border of a mask, pixels count neither as inside nor as outside if less than this share of the views
    that see their surface point agree; and surface without a labelled point joins if at least this share agree. 0 =
    all pixels count, and the labelled points are all."""
    objective: Objective = Objective()
    """What the training makes small."""
    ignore_occluded: bool = True
    """Whether pixels where something else is in front are left out; False calls them empty, as in the paper."""
    densify: Literal["classic", "none"] = "classic"
    """How their number grows: "classic" clones and splits where the picture is still wrong (3DGS), but nothing in
    trainings of less than 200 steps, as those of `default` and `fast` are; "none" leaves it."""
    schedule: Schedule = Schedule()
    """When "classic" clones and splits."""
    prune_contribution: Fraction = 1 / 255
    """Gaussians that add no more than this to any pixel of any view are dropped in the end; 0 keeps them (3DGS)."""
    extent: Literal["instance", "cameras"] = "instance"
    """What lengths are shares of, the rate of the means above all: "instance", the diagonal of the instance's box; or
    "cameras", the radius of the cameras that see it, as in 3DGS (where that is 0, the diagonal)."""
    max_length: NonNegative = 1.5
    """No Gaussian becomes longer (one standard deviation) than so many times the median with which those of its
    instance start; the background's may. 0 = any."""
    rates: LearningRates = LearningRates(rotation=3e-4)
    """How fast each parameter is learnt; discs that turn fast come to stand on end."""
    dilation: Natural = 0
    """Pixels by which masks are dilated for the first training; 1 in the code of the paper's authors."""
    crop: CropParams = CropParams()
    """The part of each view that is rendered."""
    seed: Natural = 0
    """Another one trains on the views in another order, and before other random backgrounds."""

    def of_first(self) -> ReconstructParams:
        """For `reconstruct`: what it does not read is as by default, so that it does not enter the key. Only `retrain`
        reads some of it, and some nobody, where no training is long enough for clones and splits."""
        longest = round(max(1.0, self.background_scale) * self.max_iterations)
        grows = self.schedule.reached(longest)
        unread = () if grows else ("densify", "schedule", "max_gaussians")
        return by_default(self, "retrain_share", "warm_start", *unread)

    def iterations(self, instance: InstanceMasks) -> int:
        """Training steps for an instance, by the number of its views (spec row 22)."""
        wanted = self.iterations_per_view * len(instance.views)
        return round(self.scale_of(instance) * float(np.clip(wanted, self.min_iterations, self.max_iterations)))

    def scale_of(self, instance: InstanceMasks) -> float:
        """The factor on all that an instance is given."""
        return self.background_scale if instance.instance_id == 0 else 1.0


@task(
    name="splat.reconstruct",
    resources=Resources(cores=1, most_cores=8, memory_mb=1500, gpus=0.05),
    environment=backend_identity,
)
def reconstruct(
    views: Views,
    instance: InstanceMasks,
    *,
    params: ReconstructParams,
    visibility: VisibilityParams = VisibilityParams(),
) -> Gaussians:
    """Gaussians of one instance, or of the background (id 0), from its own pixels alone (spec P1, A28).

    Training starts from the labelled points and sees, in the views that have a mask, the three kinds of pixels that
    `group_view` tells apart; where there are more views than steps, in as many of them, evenly spread. A weak instance,
    and one without masks or points, gives no Gaussians: it is kept as points alone (spec row 21), and the last pass
    over the whole scene lets the background fill its place.

    views: at least those that have a mask. visibility: when one surface is in front of another.
    Raises InputError when a frame's size is not that of the masks.
    """
    if instance.weak or not len(instance.points) or not instance.views:
        return NO_GAUSSIANS
    scene = views.compared(visibility)
    instance = _completed(scene, instance, params)
    initial = _from_points(instance, params)
    return _trained(scene, dilated(instance, params.dilation), initial, params, params.iterations(instance))


@task(
    name="splat.retrain",
    resources=Resources(cores=1, most_cores=8, memory_mb=1500, gpus=0.05),
    environment=backend_identity,
)
def retrain(
    views: Views,
    instance: InstanceMasks,
    first: InstanceMasks,
    gaussians: Gaussians,
    *,
    params: ReconstructParams,
    visibility: VisibilityParams = VisibilityParams(),
) -> Gaussians:
    """The Gaussians of an instance after its masks were refined (spec row 31).

    instance: with the refined masks. first: with those of the first training. gaussians: of the first training; they
    come back as they are where it saw the same masks, or where `retrain_share` is 0. The rest as for `reconstruct`.
    """
    seen_already = not params.dilation and first.views == instance.views and first.same(instance)
    if seen_already or not params.retrain_share or instance.weak or not len(instance.points) or not instance.views:
        return gaussians
    scene = views.compared(visibility)
    instance = _completed(scene, instance, params)
    initial = gaussians if params.warm_start and len(gaussians) else _from_points(instance, params)
    steps = max(1, round(params.retrain_share * params.iterations(instance)))
    return _trained(scene, instance, initial, params, steps)


def _completed(scene: SceneViews, instance: InstanceMasks, params: ReconstructParams) -> InstanceMasks:
    """With the surface that masks agree on (`tau_agree`); the background has no masks of its own to agree."""
    if not params.tau_agree or not instance.instance_id:
        return instance
    return completed(scene, instance, params.tau_agree, max_side=params.crop.max_side)


def _from_points(instance: InstanceMasks, params: ReconstructParams) -> Gaussians:
    """The Gaussians that training starts from, one a labelled point that is left when they are thinned out."""
    rows = thin(instance.points, round(params.max_points * params.scale_of(instance)))
    first = initialise(
        instance.points[rows],
        instance.colors[rows],
        instance.instance_id,
        instance.point_confidence[rows],
        instance.point_part[rows],
        opacity=params.first_opacity,
    )
    return laid_flat(first, params.thickness) if params.thickness < 1 else first


def thin(points: Float32, limit: int) -> Int32:
    """Rows of at most `limit` points, evenly spread: the first point in each cell of a grid. points: [N, 3]; limit: 0
    for all of them."""
    if not limit or len(points) <= limit:
        return np.arange(len(points), dtype=np.int32)
    low = points.min(axis=0)
    # A surface as large as the box's diagonal squared would fill 64 times too many cells: the loop ends from above.
    side = float(np.linalg.norm(points.max(axis=0) - low)) / (8 * np.sqrt(limit))
    while True:
        rows = first_of_each_cube(points, side)
        if len(rows) <= limit:
            return rows
        side *= 1.02 * np.sqrt(len(rows) / limit)


def _trained(
    scene: SceneViews, instance: InstanceMasks, initial: Gaussians, params: ReconstructParams, iterations: int
) -> Gaussians:
    """The Gaussians after so many steps on the views of an instance; with a warning as they began, where no view shows
    it or nothing of it is left."""
    instance = _evenly(instance, iterations)
    surface = PointSurface.of(instance.points)
    build = background_view if instance.instance_id == 0 else group_view
    row_of = scene.row_of()
    views = [
        build(scene, row_of[name], channels, surface, crop=params.crop, ignore_occluded=params.ignore_occluded)
        for name, channels in zip(instance.views, _channels(scene, instance, params), strict=True)
    ]
    views = [view for view in views if view.inside.any()]
    if not views:
        warn(f"No view shows instance {instance.instance_id} where it may be seen; it stays as its points.")
        return initial
    # Points that are all at one place are as large as their Gaussians.
    extent = max(box_diagonal(surface.points), surface.spacing) or float(np.exp(initial.log_scales.max()))
    if params.extent == "cameras":
        extent = camera_extent([view.camera for view in views]) or extent
    result = train(
        initial,
        views,
        params=_settings(params, iterations, params.scale_of(instance)),
        extent=extent,
        seed=instance.instance_id + (params.seed << 32),
    )
    if not len(result.gaussians):
        warn(f"Training left nothing of instance {instance.instance_id}; it stays as its points.")
        return initial
    return result.gaussians


def _evenly(instance: InstanceMasks, most: int) -> InstanceMasks:
    """The instance with no more than so many of its views, evenly spread: a training shows one view a step, and holds
    those in memory that it never shows, too."""
    if len(instance.views) <= most:
        return instance
    rows = np.linspace(0, len(instance.views) - 1, most).round().astype(int)
    views = tuple(instance.views[row] for row in rows)
    return replace(instance, **vars(instance.rows(rows)), views=views, origin=instance.origin[rows])


def _channels(scene: SceneViews, instance: InstanceMasks, params: ReconstructParams) -> Iterable[Int32]:
    """[H, W] of each view with a mask: 0 inside, NONE_OF_MINE outside, IGNORED where the pixel says nothing."""
    # What is background is what is left over: there is no mask of it to doubt.
    if params.tau_agree and instance.instance_id:
        return agreed(scene, instance, params.tau_agree)
    return map(channels_of_mask, map(instance.mask, range(len(instance.views))))


def _settings(params: ReconstructParams, iterations: int, scale: float) -> TrainParams:
    """scale: the factor on the number of Gaussians."""
    return TrainParams(
        iterations=iterations,
        sh_degree=params.sh_degree,
        objective=params.objective,
        densify=params.densify,
        schedule=params.schedule,
        max_gaussians=round(params.max_gaussians * scale),
        prune_contribution=params.prune_contribution,
        max_length=params.max_length,
        rates=params.rates,
    )
