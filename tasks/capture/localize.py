"""Photos that are kept back find their place among those whose poses were refined.

Their own poses are as little exact as the others were, and what is rendered from there lies beside the photo.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ss_flow.running import progress, warn
from ss_flow.task import task
from ss_flow.tasks.artifacts import Cameras
from ss_flow.tasks.capture.colmap import SEED, load_pycolmap
from ss_flow.tasks.capture.features import Features
from ss_flow.tasks.capture.mapping import opened, triangulate
from ss_flow.tasks.capture.matches import Matches
from ss_flow.tasks.capture.refine_poses import RefinePosesParams
from ss_flow.tasks.geometry.cameras import centers_of
from ss_flow.tasks.words import first_of

_KEPT_BACK = "kept back: "
"""Before the names of photos that are kept back, which may be those of others."""


@task(name="capture.localized", isolate=True)
def localized(
    kept: Cameras,
    kept_photos: Sequence[Features],
    kept_matches: Sequence[Matches],
    refined: Cameras,
    photos: Sequence[Features],
    matches: tuple[Matches, ...],
    *,
    params: RefinePosesParams = RefinePosesParams(),
) -> Cameras:
    """The cameras of photos that are kept back, placed by the points of the others (perspective n points).

    The refined cameras and their points stay as they are: photos that are kept back have no say in what is trained.
    kept_photos, kept_matches: of each of `kept`, the latter with `photos`. photos, matches: of each of `refined`. A
    photo that sees too few points keeps its pose. Says how far the others moved.
    """
    pycolmap = load_pycolmap()
    named = [replace(photo.light(), name=_KEPT_BACK + photo.name) for photo in kept_photos]
    found = [replace(own, name=_KEPT_BACK + own.name) for own in kept_matches]
    intrinsics = np.concatenate([refined.intrinsics, kept.intrinsics])
    mapper, model = opened(
        [*(photo.light() for photo in photos), *named], intrinsics, (*matches, *found), refined.world_to_camera
    )
    triangulate(mapper, model, params.last_error, float(np.median(refined.intrinsics[:, 0])))
    options = pycolmap.IncrementalMapperOptions()
    options.abs_pose_refine_focal_length = options.abs_pose_refine_extra_params = False
    options.abs_pose_min_num_inliers = params.min_points
    options.num_threads, options.random_seed = 1, SEED
    poses = kept.world_to_camera.copy()
    placed = []
    for row, name in enumerate(kept.names):
        number = len(refined) + row + 1
        if model.exists_image(number) and mapper.register_next_image(options, number):
            placed.append(row)
            poses[row, :3] = model.image(number).cam_from_world().matrix()
        progress(row + 1, len(kept), name)
    mapper.end_reconstruction(True)
    result = replace(kept, world_to_camera=poses)
    _tell(kept, result, placed)
    return result


def _tell(given: Cameras, found: Cameras, placed: list[int]) -> None:
    others = first_of([name for row, name in enumerate(given.names) if row not in placed])
    if not placed:
        warn(
            f"None of {len(given)} views that were kept back finds its place among the others, whose poses were "
            "refined: they have too little in common with them, and stand as they came."
        )
        return
    moved = np.linalg.norm(centers_of(found.world_to_camera) - centers_of(given.world_to_camera), axis=1)[placed]
    keep = f" Those with too little in common with others keep their poses: {others}." if others else ""
    warn(
        f"{len(placed)} of {len(given)} views that were kept back moved by {np.median(moved):.3g} "
        f"{'m' if given.metric else 'units'} (median; at most {moved.max():.3g}), to where the refined poses of the "
        f"others have them.{keep}"
    )
