"""Renderings of a scene object by object: near each object, at its border, and without it (spec 2.3)."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ss_flow.errors import InputError
from ss_flow.running import progress
from ss_flow.task import Resources, task
from ss_flow.tasks.artifacts import Bool, Cameras, Float32, Float64, Frame, Gaussians, Int32, LabelMap, UInt8
from ss_flow.tasks.evaluate.novel_view import identity, perceived, psnr, ssim, to_8bit
from ss_flow.tasks.evaluate.objects import change_elsewhere
from ss_flow.tasks.gaussians.rasterize import backend_identity
from ss_flow.tasks.geometry.cameras import camera_of
from ss_flow.tasks.geometry.images import decode_rgb, decode_valid, near_border
from ss_flow.tasks.models.catalogue import Model
from ss_flow.tasks.models.lpips import distance
from ss_flow.tasks.packed import bounds

_BAND = 5
"""Pixels on either side of an instance's border."""
_REMOVED_IN = 4
"""Views in which an object is taken away: those that show most of it."""


@dataclass(frozen=True)
class ObjectViews:
    """How the renderings of a scene compare with photos, as 8-bit images; means over the views."""

    instance: Int32
    """[G] the true instances."""
    views: Int32
    """[G] how many of the views show each."""
    psnr: Float64
    """[G] dB in the box around the instance's true mask."""
    ssim: Float64
    """[G] in the same box."""
    lpips: Float64
    """[G] in the same box, of features of the whole view; NaN without a network for it."""
    whole_psnr: float
    """dB over whole views."""
    whole_ssim: float
    whole_lpips: float
    band_psnr: float
    """dB within 5 pixels of the borders of true instances; NaN where there is no border, as the next two."""
    band_ssim: float
    band_lpips: float
    """NaN without a network for it, too."""


@dataclass(frozen=True)
class Removals:
    """What taking instances out of a scene changes elsewhere."""

    instance: Int32
    """[L] those that have Gaussians and a mask."""
    residual: Float64
    """[L] mean absolute difference of colour, 0..1, outside the instance's mask; 0 for a clean object."""


@task(name="evaluate.object_views", resources=Resources(cores=1, memory_mb=1500, gpus=0.1), environment=identity)
def object_views(
    frames: Sequence[Frame],
    cameras: Cameras,
    scene: Gaussians,
    truth: Sequence[LabelMap],
    *,
    perception: Model | None = None,
) -> ObjectViews:
    """Render the annotated views and compare them with their photos, box by box.

    frames, cameras: the views, those without ground truth among them. truth: true ids, 0 = none. perception: the
    network of LPIPS.
    Pixels that a frame's `valid` mask excludes do not count, nor does a view that has no others. Raises InputError when
    no view shows an instance.
    """
    from ss_flow.tasks.gaussians.render import render

    row_of = cameras.row_of()
    boxes: dict[int, list[tuple[float, float, float]]] = defaultdict(list)
    whole, bands = [], []
    for done, ids in enumerate(truth):
        frame = frames[row_of[ids.name]]
        valid, photo = decode_valid(frame), decode_rgb(frame)
        if not valid.any():  # nothing to compare, and a mean of nothing is no number
            continue
        camera = camera_of(cameras, row_of[ids.name]).scaled(frame.width, frame.height)
        image = to_8bit(render(scene, camera).rgb)
        differences = None if perception is None else perceived(image, photo, valid, perception)
        whole.append(_compared(image, photo, valid, differences))
        band = border_band(ids.ids) & valid
        if band.any():
            bands.append(_compared(image, photo, band, differences))
        for instance in np.unique(ids.ids[valid & (ids.ids > 0)]).tolist():
            inside = _box(ids.ids == instance) & valid
            boxes[instance].append(_compared(image, photo, inside, differences))
        progress(done + 1, len(truth), ids.name)
    if not boxes:
        raise InputError("The annotated views show no instance; at least one is needed to compare objects.")
    means = np.array([np.mean(boxes[i], axis=0) for i in sorted(boxes)])
    return ObjectViews(
        np.array(sorted(boxes), np.int32),
        np.array([len(boxes[i]) for i in sorted(boxes)], np.int32),
        means[:, 0],
        means[:, 1],
        means[:, 2],
        *np.mean(whole, axis=0).tolist(),
        *np.mean(bands or [(np.nan, np.nan, np.nan)], axis=0).tolist(),
    )


@task(name="evaluate.removals", resources=Resources(cores=1, gpus=0.1), environment=backend_identity)
def removals(cameras: Cameras, scene: Gaussians, maps: Sequence[LabelMap]) -> Removals:
    """Take each instance out and compare the renderings with and without it, outside its mask.

    maps: the ids that the finished scene shows in each view. Of each instance those four views count that show most of
    it.
    """
    area = np.array([np.bincount(one.ids.ravel(), minlength=1 << 16) for one in maps], np.int64)
    ids = [i for i in np.unique(scene.instance_id).tolist() if i > 0 and area[:, i].any()]
    residual = []
    for done, instance in enumerate(ids):
        most = np.argsort(-area[:, instance], kind="stable")[:_REMOVED_IN]
        shown = [int(view) for view in most if area[view, instance]]
        changes = [
            change_elsewhere(scene, instance, camera_of(cameras, view), maps[view].ids == instance) for view in shown
        ]
        residual.append(float(np.mean(changes)))
        progress(done + 1, len(ids), f"instance {instance}")
    return Removals(np.array(ids, np.int32), np.array(residual, np.float64))


def border_band(ids: np.ndarray) -> Bool:
    """[H, W] the pixels within 5 of a border between two ids, one of which may be 0."""
    return near_border(ids, _BAND)


def _compared(
    image: UInt8, photo: UInt8, inside: Bool, differences: tuple[Float32, ...] | None
) -> tuple[float, float, float]:
    """PSNR, SSIM and LPIPS of the pixels inside."""
    perceptual = float("nan") if differences is None else distance(differences, inside)
    return psnr(image, photo, inside), ssim(image, photo, inside), perceptual


def _box(mask: Bool) -> Bool:
    """The smallest box that holds a mask, as a mask."""
    inside = np.zeros_like(mask)
    x0, y0, x1, y1 = bounds(mask)
    inside[y0:y1, x0:x1] = True
    return inside
