"""Frames of a depth sensor without poses -> cameras: each is placed by the points that others measured."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ss_flow.errors import InputError
from ss_flow.running import warn
from ss_flow.task import task
from ss_flow.tasks.artifacts import Cameras, DepthMap
from ss_flow.tasks.capture.features import Features
from ss_flow.tasks.capture.matches import Matches
from ss_flow.tasks.capture.placing import places
from ss_flow.tasks.capture.refine_poses import RefinePosesParams, Unrefinable, adjusted


@task(name="capture.placed_by_depth", isolate=True)
def placed_by_depth(
    photos: Sequence[Features],
    unposed: Cameras,
    depths: Sequence[DepthMap],
    matches: tuple[Matches, ...],
    *,
    min_matches: int,
    min_registered: float,
    params: RefinePosesParams = RefinePosesParams(),
) -> Cameras:
    """Cameras of the photos that find their place, in the photos' order, in the sensor's unit of length.

    They are placed one after the other (`places`); then all are adjusted together, as given poses are that do not fit.
    The world is the frame of the first camera, the one that has most in common with others.
    unposed: the photos' lenses; its poses are not looked at. min_matches: so many points must confirm a pose.
    Photos without a place are missing from the result. Raises InputError when fewer than `min_registered` of all, or
    fewer than 3, find theirs.
    """
    light = [photo.light() for photo in photos]
    poses = places(light, depths, unposed, matches, min_matches=min_matches)
    if len(poses) < max(3, min_registered * len(photos)):
        raise InputError(
            f"only {len(poses)} of {len(photos)} frames found their place by what the depth sensor measured; frames "
            "that overlap by two thirds, sharp, of a scene with texture help, or give poses."
        )
    rows = sorted(poses)
    placed = replace(
        unposed,
        names=tuple(unposed.names[row] for row in rows),
        sizes=unposed.sizes[rows],
        intrinsics=unposed.intrinsics[rows],
        world_to_camera=np.stack([poses[row] for row in rows]),
    )
    try:
        return adjusted([light[row] for row in rows], placed, matches, params).cameras
    except Unrefinable as error:
        warn(f"Poses stay as the depth sensor gave them, without an adjustment of all together: {error}.")
        return placed
