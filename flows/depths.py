"""Depth of every view of a capture: measured, seen by several views together, predicted, or that of a given scene."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ss_flow.errors import InputError
from ss_flow.flows.params import CaptureParams
from ss_flow.graph import INDEX, each, expand, pick
from ss_flow.task import FileRef, Reference
from ss_flow.tasks.artifacts import Cameras, DepthMap, Frame, Gaussians, Registration
from ss_flow.tasks.capture import depth as steps
from ss_flow.tasks.capture import recordings, sensor_depth, views
from ss_flow.tasks.capture.completion import Gaps, completed, gaps, sized
from ss_flow.tasks.capture.depth_scale import DepthScale, depth_scale, rescaled
from ss_flow.tasks.capture.given_scene import rendered_depth
from ss_flow.tasks.capture.mono import mono
from ss_flow.tasks.capture.neighbors import Neighbors, neighbors
from ss_flow.tasks.capture.planes import planes
from ss_flow.tasks.capture.registration import calibrated
from ss_flow.tasks.capture.scene_files import SceneFiles
from ss_flow.tasks.capture.stereo import stereo
from ss_flow.tasks.geometry.cameras import Camera
from ss_flow.tasks.models.catalogue import Model

Depths = tuple[DepthMap, ...]
OfView = Callable[[int, Neighbors], DepthMap]
"""Makes a view's depth, by its place and who its neighbours are."""


def depth_source(scene: SceneFiles, params: CaptureParams) -> str:
    """Where the depth of a capture comes from: "sensor", "mvs", "mono" or "rendered"."""
    if params.depth != "auto":
        return params.depth
    if scene.depths is not None or scene.kind == "sens":
        return "sensor"
    return "mvs" if scene.given_scene is None else "rendered"


def measured(scene: SceneFiles, reference: Reference, frames: tuple[Frame, ...]) -> Depths:
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
        files=all_of(reference, scene.depths),
        confidences=all_of(reference, scene.confidences),
        scale=scene.depth_scale,
        metric=scene.metric,
        lenses=scene.lenses,
        depth_lens=scene.depth_lens,
    )


def fitting_depth(
    frames: tuple[Frame, ...], cameras: Cameras, depths: Depths, placing: Registration, params: CaptureParams
) -> Depths:
    """The sensor's depth, moved to where its photos show it, as far as the parameters say."""
    if params.calibrate == "none":
        return depths
    if params.calibrate == "depth":
        return calibrated(frames, cameras, depths, placing)
    least = params.registration.tau_clear
    return expand(
        placing,
        lambda found: calibrated(frames, cameras, depths, placing) if found.moves and found.gain >= least else depths,
    )


def scaled_depth(cameras: Cameras, depths: Depths, names: tuple[str, ...] | None, params: CaptureParams) -> Depths:
    """The sensor's depth in the unit of the poses, where that is clearly another one."""
    if params.calibrate == "none":
        return depths

    def scaling(found: DepthScale) -> Depths:
        factor = found.factor  # alone: a photo more changes how well it fits, and seldom the factor
        return each(depths, names=names, build=lambda depth: rescaled(depth, factor=factor)) if found.counts else depths

    return expand(depth_scale(cameras, depths), scaling)


@dataclass(frozen=True)
class Beside:
    """Views beside their neighbours: the depth of a view depends on these alone."""

    frames: tuple[Frame, ...]
    cameras: tuple[Camera, ...]
    neighbors: Neighbors
    names: tuple[str, ...] | None
    """Of the views, where they are known beforehand."""
    params: CaptureParams

    @classmethod
    def of(
        cls,
        frames: tuple[Frame, ...],
        cameras: Cameras,
        names: tuple[str, ...] | None,
        params: CaptureParams,
        sensed: Depths = (),
    ) -> Beside:
        """sensed: a sensor's depth, where there is one."""
        beside = neighbors(cameras, sensed, params=params.neighbors)
        return cls(frames, views.by_view(cameras), beside, names, params)

    def compared(self) -> Depths:
        """The depth that several views agree on."""
        return self._agreed(self._each)

    def completed(self, sensor: Depths, gaps: Sequence[int]) -> Depths:
        """A sensor's depth, and what several views agree on where it has none.

        gaps: the views, by their places, of which that is to be found.
        """
        small = each(
            sensor,
            self.cameras,
            names=self.names,
            build=lambda depth, camera: sized(depth, camera, max_side=self.params.stereo.max_side),
        )

        def with_sensor(step: OfView, known: Depths = small) -> Depths:
            def held(view: int, near: Neighbors) -> DepthMap:
                return completed(known[view], step(view, near)) if view in gaps else known[view]

            return self._each(held)

        agreed = self._agreed(with_sensor)
        return with_sensor(lambda view, _: agreed[view], sensor)

    def rendered(self, scene: Gaussians) -> Depths:
        """The depth that a scene shows, where neighbours confirm it: at outlines it lies between two surfaces."""
        shown = each(
            self.frames,
            self.cameras,
            names=self.names,
            build=lambda frame, camera: rendered_depth(scene, frame, camera, params=self.params.given),
        )
        return self._each(self._agreeing(shown))

    def predicted(self, agreed: Depths, cameras: Cameras, network: FileRef) -> Depths:
        """A monocular network's depth, which takes its scale from what several views agree on."""
        return each(
            self.frames,
            names=self.names,
            build=lambda frame: mono(frame, cameras, agreed, model=network, params=self.params.mono),
        )

    def _agreed(self, each_view: Callable[[OfView], Depths]) -> Depths:
        """What several views agree on of what each view's photo is found to show beside its neighbours'.

        each_view: applies a step to all views.
        """
        found = each_view(self._swept)
        agreed = each_view(self._agreeing(found))
        for _ in range(self.params.stereo.rounds):
            found = each_view(functools.partial(self._refined, found, agreed))
            agreed = each_view(self._agreeing(found))
        return agreed

    def _each(self, build: OfView) -> Depths:
        return each(
            self.frames,
            INDEX,
            names=self.names,
            build=lambda _, view: expand(self.neighbors, functools.partial(build, view)),
        )

    def _swept(self, view: int, near: Neighbors) -> DepthMap:
        around = near.around(view)
        return steps.sweep(
            pick(self.frames, around), pick(self.cameras, around), span=near.span_of(view), params=self.params.sweep
        )

    def _refined(self, found: Depths, agreed: Depths, view: int, near: Neighbors) -> DepthMap:
        around = near.around(view)
        return stereo(
            pick(self.frames, around),
            pick(self.cameras, around),
            found[view],
            pick(agreed, around),
            params=self.params.stereo,
        )

    def _agreeing(self, found: Depths) -> OfView:
        def agreeing(view: int, near: Neighbors) -> DepthMap:
            around = near.around(view)
            return steps.agree(pick(found, around), pick(self.cameras, around), params=self.params.agreement)

        return agreeing


def completed_depth(
    frames: tuple[Frame, ...],
    cameras: Cameras,
    depths: Depths,
    names: tuple[str, ...] | None,
    params: CaptureParams,
) -> Depths:
    """A sensor's depth, completed by comparing photos in the views of which it knows little."""
    if not params.completion.below:
        return depths

    def completing(found: Gaps) -> Depths:
        lacking = found.view.tolist()
        return Beside.of(frames, cameras, names, params, depths).completed(depths, lacking) if lacking else depths

    return expand(gaps(frames, depths, params=params.completion), completing)


def without_sensor(
    source: str, beside: Beside, cameras: Cameras, given: Gaussians | None, monodepth: Model | None
) -> Depths:
    """What several views show together ("mvs"), what a network ("mono") or a given scene ("rendered") says.
    Raises InputError when there is no such network or scene."""
    if source == "rendered":
        if given is None:
            raise InputError(
                "capture.depth=rendered takes depth from a trained scene, and there is none; give it --scene."
            )
        return beside.rendered(given)
    if source == "mono" and monodepth is None:
        raise InputError("capture.depth=mono needs a monocular depth network; `ss-flow models list` names some.")
    agreed = beside.compared()
    if source == "mvs" or monodepth is None:
        return agreed
    return beside.predicted(agreed, cameras, monodepth.file("network"))


def presumed_depth(
    frames: tuple[Frame, ...], depths: Depths, names: tuple[str, ...] | None, params: CaptureParams
) -> Depths:
    """What several views show together, and what is taken to go on flat from there."""
    if not params.planes.flat:
        return depths
    return each(frames, depths, names=names, build=lambda frame, depth: planes(frame, depth, params=params.planes))


def all_of(reference: Reference, paths: Sequence[Path | None]) -> tuple[Any, ...]:
    """References to files, None where a view has none."""
    return tuple(reference(path) if path else None for path in paths)
