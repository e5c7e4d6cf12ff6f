"""A splat that was trained elsewhere, beside its capture: read, compared with the photos, and the depth it shows."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ss_flow.errors import InputError
from ss_flow.running import progress, warn
from ss_flow.task import FileRef, Resources, task
from ss_flow.tasks.artifacts import Cameras, DepthMap, Frame, Gaussians
from ss_flow.tasks.gaussians.native_pass import PARAMETERS
from ss_flow.tasks.gaussians.rasterize import backend_identity
from ss_flow.tasks.gaussians.read_ply import read_gaussians
from ss_flow.tasks.gaussians.render import render
from ss_flow.tasks.geometry.cameras import Camera, camera_of
from ss_flow.tasks.geometry.images import averaged_valid, decode_rgb, decode_valid, size_within
from ss_flow.tasks.ranges import Count, Fraction

_COMPARED_SIDE = 160
"""Longest side of the pictures that are compared with the photos, pixels: a wrong frame shows at any size."""
_LEAST_SEEN = 0.01
"""Share of a picture that the scene must cover for the view to be compared."""


@dataclass(frozen=True)
class GivenSceneParams:
    """How a scene that was trained elsewhere is looked at."""

    tau_likeness: Fraction = 0.8
    """Correlation of its renderings with the photos, median over the views, below which the run warns."""
    max_side: Count = 640
    """Longer side of the depth maps, in pixels."""
    min_alpha: Fraction = 0.5
    """Alpha from which a pixel has a depth."""


@task(name="capture.given_scene", resources=Resources(cores=1, memory_mb=2000, gpus=0.1), environment=backend_identity)
def given_scene(
    frames: tuple[Frame, ...], cameras: Cameras, *, file: FileRef, params: GivenSceneParams = GivenSceneParams()
) -> Gaussians:
    """The Gaussians of a PLY file, to the bit and without labels, once it is known that the cameras see them.

    Warns where its renderings are unlike the photos, as they are where it lies in another frame than the cameras.
    Raises InputError when the file holds no Gaussians that can be drawn, or no camera sees any.
    """
    scene = _unlabelled(_checked(read_gaussians(file.path), file.path.name))
    likeness = []
    for view, frame in enumerate(frames):
        found = _likeness(scene, frame, camera_of(cameras, view))
        if found is not None:
            likeness.append(found)
        progress(view + 1, len(frames), frame.name)
    if not likeness:
        raise InputError(
            f"none of the {len(frames)} cameras sees the scene of {file.path.name}; it must lie in the frame of the "
            "capture's poses: train it with these poses, or give the run the poses that it was trained with."
        )
    middle = float(np.median(likeness))
    if middle < params.tau_likeness:
        warn(
            f"The scene of {file.path.name} hardly looks like the photos: the correlation of its renderings with them "
            f"is {middle:.2f} (median of {len(likeness)} views), where scenes in the frame of their cameras reach 0.9 "
            "and more; it may lie in another frame than the capture's poses."
        )
    return scene


@task(
    name="capture.rendered_depth", resources=Resources(cores=1, memory_mb=1000, gpus=0.1), environment=backend_identity
)
def rendered_depth(
    scene: Gaussians, frame: Frame, camera: Camera, *, params: GivenSceneParams = GivenSceneParams()
) -> DepthMap:
    """The depth that a scene shows in a view: the mean of its Gaussians' depths by their weights in each pixel, unknown
    where the scene is not opaque.

    At outlines the mean lies between two surfaces, so it needs the other views' word (`agree`). camera: of this view.
    """
    plain = replace(scene, sh=scene.sh[:, :1])  # colours have no say
    drawn = render(plain, camera.scaled(*size_within(params.max_side, frame.width, frame.height)))
    solid = drawn.alpha >= max(params.min_alpha, 1e-3)
    depth = np.where(solid, drawn.depth / np.maximum(drawn.alpha, 1e-3), 0)
    return DepthMap(frame.name, depth.astype(np.float32), "rendered")


def _checked(scene: Gaussians, name: str) -> Gaussians:
    """Raises InputError unless there are Gaussians, and all of them can be drawn."""
    if not len(scene):
        raise InputError(f"{name} holds no Gaussians; give the PLY file of a trained scene.")
    numbers = np.concatenate([getattr(scene, key).reshape(len(scene), -1) for key in PARAMETERS], axis=1)
    wrong = ~np.isfinite(numbers).all(axis=1)
    wrong |= ~scene.quaternions.any(axis=1)
    if wrong.any():
        raise InputError(
            f"{name} holds {int(wrong.sum())} Gaussians, the first in row {int(wrong.argmax())}, with numbers that are "
            f"not finite or a rotation of length 0; write it without them (`splat-transform {name} --filter-nan "
            "clean.ply`)."
        )
    return scene


def _unlabelled(scene: Gaussians) -> Gaussians:
    n = len(scene)
    none = np.zeros(n, np.int32)
    return replace(scene, instance_id=none, instance_conf=np.zeros(n, np.float32), part_id=none)


def _likeness(scene: Gaussians, frame: Frame, camera: Camera) -> float | None:
    """Correlation of a rendering with the photo, -1..1, in the pixels that the scene covers; None where it hardly
    covers any. Exposure and contrast do not matter."""
    import cv2

    size = size_within(_COMPARED_SIDE, frame.width, frame.height)
    drawn = render(scene, camera.scaled(*size))
    photo = cv2.resize(decode_rgb(frame), size, interpolation=cv2.INTER_AREA)
    valid = averaged_valid(decode_valid(frame), *size)
    covered = valid & (drawn.alpha >= 0.5)
    if covered.sum() <= _LEAST_SEEN * covered.size:
        return None
    a, b = (image[covered].mean(axis=1, dtype=np.float64) for image in (drawn.rgb, photo))
    a, b = a - a.mean(), b - b.mean()
    return float((a * b).sum() / max(np.sqrt((a * a).sum() * (b * b).sum()), 1e-12))
