"""The instance ids that the finished scene shows: what its Gaussians say of the masks they grew from.

Beyond Split&Splat.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from ss_flow.task import Resources, task
from ss_flow.tasks.artifacts import DepthMap, Frame, Gaussians, LabelMap
from ss_flow.tasks.gaussians.rasterize import backend_identity
from ss_flow.tasks.gaussians.render import shown_instances
from ss_flow.tasks.geometry.cameras import Camera
from ss_flow.tasks.geometry.images import at_diagonal, decode_rgb, decode_valid, near_border, resampled
from ss_flow.tasks.ranges import Fraction
from ss_flow.tasks.splat.photo_borders import settled_by_photo

_SOLID = 0.5
"""Alpha from which a pixel shows anything."""
_BENEFIT = 0.5
"""A pixel keeps its refined id while that weighs at least this share of the heaviest: borders of good masks are finer
than Gaussians, and those of bad masks are off by more than that."""
_CRUMB = 0.01
"""Masks that cover less of a view than this are often crumbs of others, and the scene rightly takes them whole."""
_FRINGE = 5.0
"""How far a mask's border may be off, in pixels of an image with a diagonal of 800."""


@dataclass(frozen=True)
class RenderMasksParams:
    """When the finished scene overrules a refined mask."""

    share: Fraction = 0.65
    """How much of a pixel an instance must make up to take it, as a share of its alpha; 0 = more than any other."""
    background: Literal["fringe", "anywhere"] = "fringe"
    """Where the background may take a pixel of a mask: "fringe" - near the mask's border, if the depth is known there,
    as what an instance lacks Gaussians for shows background too; or "anywhere"."""
    strips: Literal["photo", "scene"] = "photo"
    """Whose the thin strips are that the scene would take off a mask: "photo" - that one's of the two whose borders lie
    where the photo changes; or the "scene"'s, as in the paper."""
    most: Fraction = 0.4
    """How much of a mask other instances may take in a view; of one under 1 % of the view, all. Where they would take
    more, they take nothing: that is not about borders but about which thing is there, and the mask has the votes of all
    views. 1 = all of it."""


@task(
    name="splat.render_masks",
    resources=Resources(cores=1, memory_mb=1000, gpus=0.1),
    environment=backend_identity,
)
def render_masks(
    frame: Frame,
    camera: Camera,
    depth: DepthMap,
    scene: Gaussians,
    refined: LabelMap,
    *,
    params: RenderMasksParams,
) -> LabelMap:
    """The instance that weighs most in each pixel of a view, all Gaussians composited together (spec P5).

    0 where that is the background, where the scene leaves a hole, and where a frame is not valid. A pixel keeps its
    refined id where that weighs half as much or more, and where `params` holds the other instance or the background
    off; an instance that has masks but no Gaussians keeps what the scene calls background. Where depth and colour are
    some pixels apart, so are Gaussians and photo: thin strips are settled by the photo. A mask of which others would
    take most loses nothing to them.

    refined: the view's exclusive masks after refinement.
    """
    known = refined.ids
    ids = _ids_of_view(scene, camera, known, params.share)
    reach = round(at_diagonal(_FRINGE, *known.shape))
    keeps = ~np.isin(known, scene.instance_id)
    if params.background == "fringe":
        keeps |= ~(near_border(known, reach) & (resampled(depth.depth, *known.shape) > 0))
    ids = np.where((ids == 0) & keeps, known, ids)
    if params.strips == "photo":
        ids = settled_by_photo(decode_rgb(frame), known, ids, reach)
    ids = _without_swallowed(known, ids, params.most)
    ids[~decode_valid(frame)] = 0
    return LabelMap(refined.name, ids)


def _ids_of_view(scene: Gaussians, camera: Camera, known: np.ndarray, share: float) -> np.ndarray:
    """[H, W] uint16."""
    shown = shown_instances(scene, camera, known)
    ids = np.where(shown.alpha < _SOLID, np.uint16(0), shown.ids)
    keeps = (shown.of_known > 0) & (shown.of_known >= _BENEFIT * shown.weight)
    keeps |= (ids > 0) & (shown.weight < share * shown.alpha)
    return np.where(keeps, known, ids)


def _without_swallowed(masks: np.ndarray, shown: np.ndarray, most: float) -> np.ndarray:
    """What a view shows, [H, W], where no mask loses more than `most` of its pixels to other instances."""
    taken = (shown != masks) & (shown > 0)
    area = np.bincount(masks.ravel())
    swallowed = np.bincount(masks[taken], minlength=len(area)) > most * area
    swallowed &= area >= _CRUMB * masks.size
    swallowed[0] = False
    return np.where(taken & swallowed[masks], masks, shown)
