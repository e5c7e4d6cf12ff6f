"""An instance's masks compared with its own Gaussians (Split&Splat, Sec. 3.2.2; spec P2, P3)."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from ss_flow.running import progress
from ss_flow.task import Resources, task
from ss_flow.tasks.artifacts import DRAWN, REFINED, Bool, Float32, Gaussians, InstanceMasks
from ss_flow.tasks.gaussians.initialise import select
from ss_flow.tasks.gaussians.rasterize import backend_identity
from ss_flow.tasks.gaussians.render import render
from ss_flow.tasks.gaussians.views import CropParams, SceneViews, Views, crop_camera, sample_depth
from ss_flow.tasks.geometry.cameras import Camera
from ss_flow.tasks.geometry.images import at_diagonal, shared_valid
from ss_flow.tasks.geometry.sampling import greedy_farthest
from ss_flow.tasks.geometry.shape import box_diagonal
from ss_flow.tasks.geometry.visibility import VisibilityParams
from ss_flow.tasks.masks.dilation import grown
from ss_flow.tasks.masks.overlap import iou
from ss_flow.tasks.masks.pool import without_speckles
from ss_flow.tasks.models.catalogue import Model
from ss_flow.tasks.models.onnx import network_identity
from ss_flow.tasks.models.sam import Embedding, Sam
from ss_flow.tasks.packed import Masks
from ss_flow.tasks.ranges import Count, Fraction, Natural, NonNegative
from ss_flow.tasks.unread import by_default

_OF_PROMPTS = (
    "prompts",
    "prompt_alpha",
    "drop_hull",
    "tau_iou",
    "pred_iou",
    "margin",
    "tie",
    "max_change",
    "speckle",
    "dilation",
)
"""What is not read where no segmenter is asked."""
Prompt = Callable[[Float32], tuple[Bool, float]]
"""Points [n, 2] in pixels of a photo -> the segmenter's mask and its score."""


@dataclass(frozen=True)
class RefineParams:
    """How masks are compared and replaced."""

    prompts: Count = 5
    """Points that the segmenter is asked with."""
    prompt_alpha: NonNegative = 0.3
    """How much a prompt's distance to the mean counts against it; 0 in the paper."""
    drop_hull: bool = True
    """Whether points at the corners of the visible region are left out as prompts; False in the paper."""
    min_visible: Count = 10
    """Fewest visible Gaussians of a view that is looked at."""
    alpha_threshold: Fraction = 0.5
    """Accumulated alpha from which a pixel belongs to the rendered mask."""
    min_opacity: Fraction = 0.05
    """Fainter Gaussians are not rendered; 0 in the paper."""
    max_scale: NonNegative = 0.5
    """Gaussians longer than this share of the instance's box diagonal are not rendered; 0 = any, as in the paper."""
    cut_occluded: bool = True
    """Whether the rendered mask is cut where something is in front; False in the paper."""
    box_margin: NonNegative = 16.0
    """Pixels, in a photo with a diagonal of 800, by which the rendered mask goes on beyond the box around the centres
    of the Gaussians, less the outermost 0.5 % of them on each side; 0 = anywhere in the photo, as in the paper."""
    tau_iou: Fraction = 0.5
    """IoU with the rendered mask above which a mask is added to a view that had none; 0.95 in the paper."""
    pred_iou: Fraction = 0.8
    """IoU that the segmenter predicts for its mask, below which the mask is not taken; 0 = any, as in the paper."""
    margin: Fraction = 1.0
    """How much better the segmenter's mask must agree with the rendered one to replace a mask that the view's photo
    gave; 1 = it stays, and the segmenter is not asked. One drawn from points is replaced by any that agrees better. 0
    in the paper."""
    tie: Literal["old", "new"] = "old"
    """Which mask is taken where both agree equally well: the "old" one, or the segmenter's "new" one, as in the paper,
    which prefers the old one where its IoU is higher."""
    max_change: NonNegative = 1.5
    """A mask that the view's photo gave is only replaced by one of at most so many times its area, and of no less than
    the inverse of that; 0 = any, as in the paper."""
    speckle: Fraction = 0.05
    """Pieces of the segmenter's mask smaller than this share of its largest one are taken off, and holes as small are
    filled; 0 = none, as in the paper."""
    dilation: Natural = 0
    """Pixels by which new masks of the segmenter are dilated; 1 in the code of the paper's authors."""
    min_support: Fraction = 0.7
    """Without a segmenter: share of the rendered mask that the view's depth must confirm for it to be added."""
    min_views: Count = 2
    """An instance with masks in fewer views stays weak."""

    def in_use(self, model: Model | None) -> RefineParams:
        """With what is not read as by default, so that it does not enter the key. model: the segmenter, if any."""
        return by_default(self, "min_support") if model else by_default(self, *_OF_PROMPTS)


@dataclass(frozen=True)
class RenderedMask:
    """The mask that an instance's Gaussians cast on one view (Split&Splat, M^gs)."""

    mask: Bool
    """[H, W] without the pixels where something else is in front, if it was cut."""
    support: float
    """Share of the mask where the view's depth agrees with the Gaussians'."""


@task(
    name="splat.refine",
    resources=Resources(cores=1, memory_mb=1800, gpus=0.1),
    environment=lambda: backend_identity() | network_identity(),
)
def refine(
    views: Views,
    instance: InstanceMasks,
    gaussians: Gaussians,
    embeddings: Sequence[Embedding],
    *,
    params: RefineParams,
    model: Model | None = None,
    visibility: VisibilityParams = VisibilityParams(),
) -> InstanceMasks:
    """The refined masks of one instance (Split&Splat, M^_{k,l}); they may overlap those of other instances.

    In each view that sees at least `min_visible` of the Gaussians' centres, M^gs is rendered from the instance alone
    and the segmenter is prompted at visible centres (spec row 26). Where the view has a mask, it stays unless the
    segmenter's agrees better with M^gs: by `margin`, and without a change of size beyond `max_change`, where the mask
    came from the photo, whose borders are finer than the Gaussians'. Where the view has none, the segmenter's is added
    when its IoU with M^gs exceeds `tau_iou`.

    views: at least those that see the instance, or have a mask of it. model: the segmenter; embeddings: of these views,
    none without a segmenter. Without one (None) no mask is replaced; where one is missing, M^gs itself is taken when
    the view's depth confirms at least `min_support` of it. New masks are marked as REFINED in `origin`. The
    background (id 0) and an instance without Gaussians come back as they are.
    """
    if instance.instance_id == 0 or not len(gaussians):
        return instance
    scene = views.compared(visibility)
    solid = _solid(gaussians, params)
    segmenter = Sam(model) if model else None
    held = {name: row for row, name in enumerate(instance.views)}
    names, masks, origins = [], [], []
    for view, frame in enumerate(views.frames):
        row = held.get(frame.name)
        old = None if row is None else instance.mask(row)
        drawn = row is not None and instance.origin[row] == DRAWN
        prompt = functools.partial(_ask, segmenter, embeddings, view) if segmenter else None
        new = _replacement(scene, view, solid, old, drawn, params, prompt)
        if new is not None:
            masks.append(Masks.of([new]))
            origins.append(REFINED)
        elif row is not None:
            masks.append(instance.rows([row]))
            origins.append(int(instance.origin[row]))
        if new is not None or row is not None:
            names.append(frame.name)
        progress(view + 1, len(views.frames), frame.name)
    return replace(
        instance,
        **vars(Masks.joined(masks)),
        views=tuple(names),
        origin=np.array(origins, np.uint8),
        weak=instance.weak and len(names) < params.min_views,
    )


def _ask(segmenter: Sam, embeddings: Sequence[Embedding], view: int, points: Float32) -> tuple[Bool, float]:
    """The segmenter's mask of a view, and its score, for points in the photo. Few views are asked, so the embedding, by
    far the largest of what belongs to a view, is read here only."""
    return segmenter.image(embeddings[view], few=True).predict_prompt(points)


@task(
    name="splat.rendered",
    resources=Resources(cores=1, memory_mb=1800, gpus=0.1),
    environment=backend_identity,
)
def rendered(
    views: Views,
    instance: InstanceMasks,
    gaussians: Gaussians,
    *,
    params: RefineParams,
    visibility: VisibilityParams = VisibilityParams(),
) -> InstanceMasks:
    """An instance with M^gs in the place of its masks, which its descriptor then sees (Split&Splat, Sec. 5.2).

    views: at least those that have a mask. gaussians: of the instance. Views without a mask get none, and where the
    Gaussians show nothing the mask goes. The background (id 0) and an instance without Gaussians come back as they are.
    """
    if instance.instance_id == 0 or not len(gaussians):
        return instance
    scene = views.compared(visibility)
    solid = _solid(gaussians, params)
    view_of = views.row_of()
    rows, masks = [], []
    for row, name in enumerate(instance.views):
        view = view_of[name]
        shown = render_mask(solid, scene, view, params).mask & shared_valid(views.frames[view])
        if shown.any():
            rows.append(row)
            masks.append(Masks.of([shown]))
    shown_in = tuple(instance.views[row] for row in rows)
    return replace(instance, **vars(Masks.joined(masks)), views=shown_in, origin=instance.origin[rows])


def render_mask(
    gaussians: Gaussians, scene: SceneViews, view: int, params: RefineParams = RefineParams()
) -> RenderedMask:
    """M^gs of one view: the Gaussians rendered alone with full opacity, cut where something is in front, and far from
    their centres (spec P2).

    Full opacity gives the outline; with it, however, the Gaussian whose centre is nearest hides the surface that it is
    part of, so the depth is that of the ordinary rendering wherever that is solid. Depth is compared no more finely
    than the Gaussians are thick and a pixel is wide.
    """
    camera = full = scene.cameras[view]
    if params.box_margin:
        margin = round(at_diagonal(params.box_margin, full.height, full.width))
        nothing = np.zeros((full.height, full.width), bool)
        camera = crop_camera(full, nothing, gaussians.means, CropParams(margin, max(nothing.shape)))
    outline, surface = (render(gaussians, camera, opaque=opaque, winners=False) for opaque in (True, False))
    solid = outline.alpha >= params.alpha_threshold
    total, weight = np.where(surface.alpha >= 0.5, (surface.depth, surface.alpha), (outline.depth, outline.alpha))
    depth = np.where(solid, total / np.maximum(weight, 1e-6), 0)
    measured = sample_depth(scene.depths[view], full, camera)
    thickness = float(np.median(np.exp(gaussians.log_scales.max(axis=1))))
    tolerance = scene.tolerance(depth) + thickness + depth / camera.fx
    visible = solid & ((measured == 0) | (measured + tolerance >= depth) | (not params.cut_occluded))
    agrees = visible & (measured > 0) & (np.abs(measured - depth) <= tolerance)
    return RenderedMask(_pasted(visible, camera, full), float(agrees.sum() / max(1, visible.sum())))


def _pasted(mask: Bool, camera: Camera, full: Camera) -> Bool:
    x0, y0 = round(full.cx - camera.cx), round(full.cy - camera.cy)
    image = np.zeros((full.height, full.width), bool)
    image[y0 : y0 + camera.height, x0 : x0 + camera.width] = mask
    return image


def _solid(gaussians: Gaussians, params: RefineParams) -> Gaussians:
    """Without the faint and the oversized Gaussians (spec row 28); all of them where none would remain."""
    longest = np.exp(gaussians.log_scales.max(axis=1))
    keep = gaussians.opacities >= params.min_opacity
    if params.max_scale:
        keep &= longest <= params.max_scale * box_diagonal(gaussians.means)
    return select(gaussians, keep) if keep.any() else gaussians


def _replacement(
    scene: SceneViews,
    view: int,
    gaussians: Gaussians,
    old: Bool | None,
    drawn: bool,
    params: RefineParams,
    prompt: Prompt | None,
) -> Bool | None:
    """The mask that takes the place of `old` in a view, None where nothing changes.

    drawn: whether `old` was made of points. prompt: gives the segmenter's mask of the view, and its score, for points
    in the photo.
    """
    stays = prompt is None or (not drawn and params.margin >= 1)
    if old is not None and stays:
        return None
    rows, column, row, _ = scene.surface_points(view, gaussians.means)
    if len(rows) < params.min_visible:
        return None
    valid = shared_valid(scene.frames[view])
    rendered = render_mask(gaussians, scene, view, params)
    shown = rendered.mask & valid
    if not shown.any():
        return None
    if prompt is None:
        return shown if rendered.support >= params.min_support else None
    wanted, least, most = params.tau_iou, 0.0, float(shown.size)
    if old is not None:
        wanted = iou(old, shown) + (0 if drawn else params.margin)
        if params.max_change and not drawn:
            least, most = old.sum() / params.max_change, old.sum() * params.max_change
    area = shown.sum()
    if min(1.0, most / area, area / max(least, 1.0)) < wanted:
        return None  # no mask of a size that is taken could agree so well, so the segmenter need not be asked
    places = np.stack([column, row], axis=-1) + 0.5
    taken = greedy_farthest(places, params.prompts, alpha=params.prompt_alpha, drop_hull=params.drop_hull)
    candidate, score = prompt(places[taken])
    candidate = grown(without_speckles(candidate, params.speckle), params.dilation) & valid
    doubted = params.pred_iou and score < params.pred_iou
    if doubted or not least <= candidate.sum() <= most:
        return None
    agreement = iou(candidate, shown)
    equal = old is not None and params.tie == "new" and agreement == wanted
    return candidate if agreement > wanted or equal else None
