"""The first part of the DAG: any layout of files -> frames, cameras, depth."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ss_flow.errors import InputError
from ss_flow.flows.params import CaptureParams
from ss_flow.flows.poses import poses, refined_poses
from ss_flow.graph import INDEX, each, expand, pick
from ss_flow.task import FileRef
from ss_flow.tasks.artifacts import (
    Cameras,
    CaptureChecks,
    Clicks,
    ColourTransform,
    DepthMap,
    Frame,
    LabelMap,
    MaskSet,
    Registration,
    SceneUnit,
)
from ss_flow.tasks.capture import depth as depth_steps
from ss_flow.tasks.capture import ingest, recordings, sensor_depth, views
from ss_flow.tasks.capture.checks import checks
from ss_flow.tasks.capture.coco_masks import coco_masks
from ss_flow.tasks.capture.colours import colours
from ss_flow.tasks.capture.hints import clicks
from ss_flow.tasks.capture.id_images import ground_truth, ready_masks
from ss_flow.tasks.capture.mono import mono
from ss_flow.tasks.capture.neighbors import Neighbors, neighbors
from ss_flow.tasks.capture.registration import calibrated, registration
from ss_flow.tasks.capture.scene_files import SceneFiles
from ss_flow.tasks.capture.sfm import registered
from ss_flow.tasks.capture.stereo import stereo
from ss_flow.tasks.geometry.cameras import Camera
from ss_flow.tasks.models.catalogue import Model

Reference = Callable[[Path], FileRef]


@dataclass(frozen=True)
class Capture:
    """Nodes of a capture, by the artifacts that they stand for: what every later step starts from."""

    frames: tuple[Frame, ...]
    cameras: Cameras
    by_view: tuple[Camera, ...]
    """The cameras one by one."""
    depths: tuple[DepthMap, ...]
    presumed: tuple[DepthMap, ...]
    """The same; where views were compared, with what one view alone found. Split finds and sees points by it."""
    unit: SceneUnit
    masks: tuple[MaskSet, ...] | None
    """Where the capture brought its own masks."""
    truth: tuple[LabelMap, ...] | None
    """Where it is annotated."""
    names: tuple[str, ...] | None
    """Names of the views where they are known beforehand."""
    clicks: tuple[Clicks, ...] | None = None
    """Where its user pointed at objects."""
    objects: tuple[str, ...] = ()
    """What the user calls these objects."""
    registration: Registration | None = None
    """Of a sensor's depth."""
    colours: tuple[ColourTransform, ...] = ()
    """One a view; none where photos are trained on as they are."""
    checks: CaptureChecks | None = None
    """Whether the views fit together."""


def capture(scene: SceneFiles, reference: Reference, params: CaptureParams, monodepth: Model | None) -> Capture:
    """Add the nodes that read a capture.

    reference: turns a path into a file reference (digests are remembered outside the flow).
    Raises InputError when the depth that the parameters ask for cannot be had.
    """
    frames = _frames(scene, reference, params)
    if scene.poses is not None and scene.lenses is not None:
        cameras = ingest.cameras(
            frames,
            names=scene.names,
            lenses=scene.lenses,
            poses=scene.poses,
            metric=scene.metric,
            sparse=reference(scene.sparse) if scene.sparse else None,
        )
        if params.refine_poses:
            cameras = refined_poses(frames, cameras, params)
    elif params.refine_poses:
        raise InputError(f"{scene.root} has no poses that could be refined; leave --refine-poses out.")
    else:
        cameras = poses(frames, params.sfm, scene.names or None)
        frames = registered(frames, cameras)
    names = _known_names(scene)
    known: dict[str, Any] = {"names": scene.names, "lenses": scene.lenses}
    masks = truth = pointed = None
    if scene.ready_masks is not None:
        masks = ready_masks(frames, cameras, files=_all(reference, scene.ready_masks), **known)
    elif scene.coco_masks is not None:
        masks = coco_masks(frames, cameras, file=reference(scene.coco_masks), **known)
    elif scene.hints is not None:
        pointed = clicks(frames, cameras, hints=scene.hints, **known)
    if scene.ground_truth is not None:
        truth = ground_truth(frames, cameras, files=_all(reference, scene.ground_truth), **known)
    source = params.depth
    if source == "auto":
        source = "sensor" if scene.depths is not None or scene.kind == "sens" else "mvs"
    depths, presumed = _depths(source, scene, reference, params, monodepth, frames, cameras)
    placing = None
    if source == "sensor":
        calibrates = params.calibrate == "depth"
        placing = registration(frames, cameras, depths, advise=not calibrates, params=params.registration)
        if calibrates:
            depths = presumed = calibrated(frames, cameras, depths, placing)
    elif params.calibrate == "depth":
        raise InputError(
            f"{scene.root} is to be run with depth that no sensor measured (capture.depth={source}), and only a "
            "sensor's can be calibrated; leave --calibrate depth out."
        )
    objects = scene.hints.objects if scene.hints is not None else ()
    by_view, length = views.by_view(cameras), views.unit(cameras, depths)
    evened: tuple[ColourTransform, ...] = ()
    if params.colours.transform != "none":
        evened = colours(frames, cameras, depths, length, params=params.colours)
    fitting = checks(frames, cameras, depths, params=params.checks)
    return Capture(
        frames, cameras, by_view, depths, presumed, length, masks, truth, names, pointed, objects, placing, evened,
        fitting,
    )


def _known_names(scene: SceneFiles) -> tuple[str, ...] | None:
    """Names of the views, where no photo can still drop out for want of a pose."""
    return scene.names if scene.poses is not None else None


def _frames(scene: SceneFiles, reference: Reference, params: CaptureParams) -> tuple[Frame, ...]:
    if scene.kind == "video":
        assert scene.recording is not None
        return recordings.video_frames(video=reference(scene.recording), params=params.video)
    if scene.kind == "sens":
        assert scene.recording is not None
        return recordings.sens_frames(
            recording=reference(scene.recording),
            names=scene.names,
            entries=scene.entries,
            skipped=scene.skipped,
            params=params.ingest,
        )
    return ingest.frames(
        names=scene.names,
        photos=_all(reference, scene.photos),
        valid=_all(reference, scene.valid),
        lenses=scene.lenses,
        skipped=scene.skipped,
        params=params.ingest,
    )


def _depths(
    source: str,
    scene: SceneFiles,
    reference: Reference,
    params: CaptureParams,
    monodepth: Model | None,
    frames: tuple[Frame, ...],
    cameras: Cameras,
) -> tuple[tuple[DepthMap, ...], tuple[DepthMap, ...]]:
    """The sensor's depth, what several views show together ("mvs"), or a network's ("mono"); and what is presumed."""
    names = _known_names(scene)
    if source == "sensor":
        measured = _measured(scene, reference, frames)
        return measured, measured
    if source == "mono" and monodepth is None:
        raise InputError("capture.depth=mono needs a monocular depth network; `ss-flow models list` names some.")
    agreed, presumed = _compared(frames, cameras, names, params)
    if source == "mvs" or monodepth is None:
        return agreed, presumed
    # What several views agree on gives the network's depth its scale.
    network = monodepth.file("network")
    predicted = each(
        frames, names=names, build=lambda frame: mono(frame, cameras, agreed, model=network, params=params.mono)
    )
    return predicted, predicted


def _measured(scene: SceneFiles, reference: Reference, frames: tuple[Frame, ...]) -> tuple[DepthMap, ...]:
    """The sensor's depth. Raises InputError when there is none."""
    if scene.kind == "sens" and scene.recording is not None:
        return recordings.sens_depth(
            frames, recording=reference(scene.recording), names=scene.names, entries=scene.entries
        )
    if scene.depths is None:
        raise InputError(f"{scene.root} has no depth files; set capture.depth to mvs or mono.")
    return sensor_depth.depth(
        frames,
        names=scene.names,
        files=_all(reference, scene.depths),
        scale=scene.depth_scale,
        metric=scene.metric,
        lenses=scene.lenses,
        depth_lens=scene.depth_lens,
    )


def _compared(
    frames: tuple[Frame, ...], cameras: Cameras, names: tuple[str, ...] | None, params: CaptureParams
) -> tuple[tuple[DepthMap, ...], tuple[DepthMap, ...]]:
    """The depth that several views agree on, and what is presumed; each view's depends on its neighbours alone."""
    beside, by_view = neighbors(cameras, params=params.neighbors), views.by_view(cameras)

    def of_each(build: Callable[[int, Neighbors], DepthMap]) -> tuple[DepthMap, ...]:
        return each(frames, INDEX, names=names, build=lambda _, view: expand(beside, functools.partial(build, view)))

    def swept(view: int, near: Neighbors) -> DepthMap:
        around = near.around(view)
        return depth_steps.sweep(
            pick(frames, around), pick(by_view, around), span=near.span_of(view), params=params.sweep
        )

    def refined(found: tuple[DepthMap, ...], agreed: tuple[DepthMap, ...], view: int, near: Neighbors) -> DepthMap:
        around = near.around(view)
        return stereo(
            pick(frames, around), pick(by_view, around), found[view], pick(agreed, around), params=params.stereo
        )

    def confirmed(found: tuple[DepthMap, ...], view: int, near: Neighbors) -> DepthMap:
        around = near.around(view)
        return depth_steps.agree(pick(found, around), pick(by_view, around), params=params.agreement)

    found = of_each(swept)
    agreed = of_each(functools.partial(confirmed, found))
    for _ in range(params.stereo.rounds):
        found = of_each(functools.partial(refined, found, agreed))
        agreed = of_each(functools.partial(confirmed, found))
    if not params.presume:
        return agreed, agreed
    return agreed, each(agreed, found, names=names, build=depth_steps.presume)


def _all(reference: Reference, paths: Sequence[Path | None]) -> tuple[Any, ...]:
    return tuple(reference(path) if path else None for path in paths)
