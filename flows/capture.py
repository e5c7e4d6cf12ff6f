"""The first part of the DAG: any layout of files -> frames, cameras, depth."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

from ss_flow.errors import InputError
from ss_flow.flows.depths import (
    Beside,
    all_of,
    completed_depth,
    depth_source,
    fitting_depth,
    measured,
    presumed_depth,
    scaled_depth,
    without_sensor,
)
from ss_flow.flows.params import CaptureParams
from ss_flow.flows.poses import Placed, fitting_cameras, kept_back, poses, poses_by_depth, refined_poses
from ss_flow.graph import INDEX, each, expand, pick
from ss_flow.task import Reference
from ss_flow.tasks.artifacts import (
    Cameras,
    CaptureChecks,
    Clicks,
    ColourTransform,
    DepthMap,
    Frame,
    Gaussians,
    LabelMap,
    MaskSet,
    Registration,
    SceneUnit,
)
from ss_flow.tasks.capture import ingest, recordings, video, views
from ss_flow.tasks.capture.checks import checks
from ss_flow.tasks.capture.coco_masks import coco_masks
from ss_flow.tasks.capture.colmap import has_pycolmap
from ss_flow.tasks.capture.colours import colours
from ss_flow.tasks.capture.given_scene import given_scene
from ss_flow.tasks.capture.hints import clicks
from ss_flow.tasks.capture.id_images import ground_truth, ready_masks
from ss_flow.tasks.capture.registration import registration
from ss_flow.tasks.capture.scene_files import NO_POSE, SceneFiles
from ss_flow.tasks.capture.sfm import registered
from ss_flow.tasks.capture.transients import Transients, transients, without_transients
from ss_flow.tasks.gaussians.views import Views
from ss_flow.tasks.geometry.cameras import Camera
from ss_flow.tasks.geometry.lying import quarter_turns
from ss_flow.tasks.models.catalogue import Model


@dataclass(frozen=True, kw_only=True)
class Capture:
    """Nodes of a capture, by the artifacts that they stand for: what every later step starts from."""

    frames: tuple[Frame, ...]
    cameras: Cameras
    still: tuple[Frame, ...]
    """The frames, of which no pixel counts where something moves: what Splat learns from."""
    placed: Placed
    """Frames and cameras, and what tells how exact the cameras are that came with the capture."""
    by_view: tuple[Camera, ...]
    """The cameras one by one."""
    depths: tuple[DepthMap, ...]
    presumed: tuple[DepthMap, ...]
    """The same; where views were compared, with what goes on flat from there. Split has its points from it."""
    completed: bool
    """Whether it is a sensor's, whose gaps are closed by comparing views."""
    unit: SceneUnit
    masks: tuple[MaskSet, ...] | None
    """Where the capture brought its own masks."""
    truth: tuple[LabelMap, ...] | None
    """Where it is annotated."""
    names: tuple[str, ...] | None
    """Names of the views where they are known beforehand."""
    clicks: tuple[Clicks, ...] | None = None
    """Where its user pointed at objects."""
    corrections: tuple[Clicks, ...] | None = None
    """Where its user pointed at what Split is to join or to part."""
    things: tuple[str, ...] = ()
    """What the user calls the things of the corrections."""
    objects: tuple[str, ...] = ()
    """What the user calls the objects of the clicks."""
    registration: Registration | None = None
    """Of a sensor's depth."""
    colours: tuple[ColourTransform, ...] = ()
    """One a view; none where photos are trained on as they are."""
    checks: CaptureChecks | None = None
    """Whether the views fit together."""
    given: Gaussians | None = None
    """The scene that is to be labelled, where one was trained elsewhere."""
    turns: int = 0
    """Quarter turns, counterclockwise, by which networks are to see the photos turned."""

    @property
    def views(self) -> Views:
        """What every step of Splat looks at."""
        return Views(self.still, self.by_view, self.depths, self.unit, self.colours)


def capture(
    scene: SceneFiles,
    reference: Reference,
    params: CaptureParams,
    monodepth: Model | None,
    trained: Placed | None = None,
) -> Capture:
    """Add the nodes that read a capture.

    reference: turns a path into a file reference (digests are remembered outside the flow). trained: the photos that
    are trained on, where those of this capture are kept back; with the fit of a lens that is theirs, too.
    Raises InputError when the depth that the parameters ask for cannot be had.
    """
    source = depth_source(scene, params)
    placed = _placed(scene, reference, params, with_sensor=source == "sensor", trained=trained)
    frames, cameras, sensed = placed.frames, placed.cameras, placed.sensed
    names = scene.names if scene.poses is not None else None  # else a photo may still drop out for want of a pose
    known: dict[str, Any] = {"names": scene.names, "lenses": scene.lenses}
    masks = pointed = corrected = truth = None
    if scene.ready_masks is not None:
        masks = ready_masks(frames, cameras, files=all_of(reference, scene.ready_masks), **known)
    elif scene.coco_masks is not None:
        masks = coco_masks(frames, cameras, file=reference(scene.coco_masks), **known)
    elif scene.hints is not None:
        pointed = clicks(frames, cameras, hints=scene.hints, **known)
    if scene.corrections is not None:
        corrected = clicks(frames, cameras, hints=scene.corrections, **known)
    if scene.ground_truth is not None:
        truth = ground_truth(frames, cameras, files=all_of(reference, scene.ground_truth), **known)

    given: Gaussians | None = None
    if scene.given_scene is not None:
        given = given_scene(frames, cameras, file=reference(scene.given_scene), params=params.given)
    placing, still = None, frames
    if sensed is not None:
        advise = params.calibrate == "none"
        compared = params.registration.in_use(advise=advise)
        placing = registration(frames, cameras, sensed, advise=advise, params=compared)
        fitting = fitting_depth(frames, cameras, sensed, placing, params)
        scaled = scaled_depth(cameras, fitting, names, params)
        still = _without_transients(frames, cameras, scaled, names, params)
        depths = completed_depth(frames, cameras, scaled, names, params)
    elif params.calibrate == "depth":
        raise InputError(
            f"{scene.root} is to be run with depth that no sensor measured (capture.depth={source}), and only a "
            "sensor's can be calibrated; leave --calibrate depth out."
        )
    else:
        beside = Beside.of(frames, cameras, names, params)
        depths = without_sensor(source, beside, cameras, given, monodepth)

    by_view, unit = views.by_view(cameras), views.unit(cameras, depths)
    evened: tuple[ColourTransform, ...] = ()
    if params.colours.transform != "none" and given is None:  # whose Gaussians keep the colours they have
        evened = colours(frames, cameras, depths, unit, params=params.colours)
    return Capture(
        frames=frames,
        cameras=cameras,
        still=still,
        placed=placed,
        by_view=by_view,
        depths=depths,
        presumed=presumed_depth(frames, depths, names, params) if source == "mvs" else depths,
        completed=sensed is not None and params.completion.below > 0,
        unit=unit,
        masks=masks,
        truth=truth,
        names=names,
        clicks=pointed,
        corrections=corrected,
        things=scene.corrections.objects if scene.corrections is not None else (),
        objects=scene.hints.objects if scene.hints is not None else (),
        registration=placing,
        colours=evened,
        checks=checks(frames, cameras, depths, params=params.checks),
        given=given,
        turns=turned(scene, params).turns or 0,
    )


def _without_transients(
    frames: tuple[Frame, ...],
    cameras: Cameras,
    depths: tuple[DepthMap, ...],
    names: tuple[str, ...] | None,
    params: CaptureParams,
) -> tuple[Frame, ...]:
    """The frames, of which no pixel counts where something moves; depths: a sensor's."""
    if not params.transients.views:
        return frames
    moving = transients(cameras, depths, params=params.transients)

    def ignoring(found: Transients) -> tuple[Frame, ...]:
        some = set(found.view.tolist())

        def still(frame: Frame, view: int) -> Frame:
            return without_transients(frame, moving, view=view) if view in some else frame

        return each(frames, INDEX, names=names, build=still) if some else frames

    return expand(moving, ignoring)


def turned(scene: SceneFiles, params: CaptureParams) -> CaptureParams:
    """With the turns that the poses tell. Photos without poses stand upright, as their EXIF turns them."""
    if params.turns is not None:
        return params
    known = scene.world_to_camera
    return replace(params, turns=0 if known is None else quarter_turns(known))


def _placed(
    scene: SceneFiles, reference: Reference, params: CaptureParams, with_sensor: bool, trained: Placed | None
) -> Placed:
    """trained: as of `capture`."""
    frames = _frames(scene, reference, params)
    sensed = measured(scene, reference, frames) if with_sensor else None
    distortion_stated = any(not lens.pinhole for lens in scene.lenses or ())
    if scene.poses is None:
        if params.refine_poses == "always":
            raise InputError(f"{scene.root} has no poses that could be refined; leave --refine-poses out.")
        if scene.lenses is None or sensed is None:
            cameras = poses(frames, params.sfm.straight() if distortion_stated else params.sfm, scene.names or None)
            return Placed(registered(frames, cameras), cameras, sensed)
        unposed = replace(scene, poses=(NO_POSE,) * len(scene.names))
        cameras = poses_by_depth(frames, _given_cameras(unposed, reference, frames), sensed, params, scene.names)
        depths = sensed
        rows = {name: row for row, name in enumerate(scene.names)}
        sensed = expand(cameras, lambda placed: pick(depths, [rows[name] for name in placed.names]))
        return Placed(registered(frames, cameras), cameras, sensed)
    cameras = _given_cameras(scene, reference, frames)
    if params.refine_poses == "always":
        return Placed(frames, refined_poses(frames, cameras, sensed, params), sensed, cameras)
    if compares_poses(scene, params) and has_pycolmap():
        return fitting_cameras(frames, cameras, sensed, params, "focal" if distortion_stated else "all")
    placed = Placed(frames, cameras, sensed)
    return placed if trained is None else kept_back(placed, trained, params)


def compares_poses(scene: SceneFiles, params: CaptureParams) -> bool:
    """Whether the poses of a capture are to be compared with its photos; a given scene lies where they have it."""
    return scene.poses is not None and params.refine_poses == "auto" and scene.given_scene is None


def _given_cameras(scene: SceneFiles, reference: Reference, frames: tuple[Frame, ...]) -> Cameras:
    """The cameras that came with a capture, for its frames."""
    assert scene.lenses is not None and scene.poses is not None
    return ingest.cameras(
        frames,
        names=scene.names,
        lenses=scene.lenses,
        poses=scene.poses,
        metric=scene.metric,
        sparse=reference(scene.sparse) if scene.sparse else None,
    )


def _frames(scene: SceneFiles, reference: Reference, params: CaptureParams) -> tuple[Frame, ...]:
    """The photos of a capture, or those that are taken out of its recording."""
    if scene.kind == "video":
        assert scene.recording is not None
        return video.video_frames(video=reference(scene.recording), params=params.video.every(params.stride))
    if scene.kind == "stray":
        assert scene.recording is not None and scene.lenses is not None
        return recordings.recorded_frames(
            recording=reference(scene.recording),
            names=scene.names,
            entries=scene.entries,
            lenses=scene.lenses,
            valid=all_of(reference, scene.valid),
            skipped=scene.skipped,
            params=params.ingest,
        )
    if scene.kind == "sens":
        assert scene.recording is not None
        return recordings.sens_frames(
            recording=reference(scene.recording),
            names=scene.names,
            entries=scene.entries,
            valid=all_of(reference, scene.valid),
            skipped=scene.skipped,
            params=params.ingest,
        )
    return ingest.frames(
        names=scene.names,
        photos=all_of(reference, scene.photos),
        valid=all_of(reference, scene.valid),
        lenses=scene.lenses,
        skipped=scene.skipped,
        why_skipped=scene.why_skipped if scene.skipped else "",
        black_borders=scene.black_borders,
        params=params.ingest,
    )
