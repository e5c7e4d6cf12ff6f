"""COLMAP's mapper of photos whose poses are known: the points that they have in common."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ss_flow.running import progress
from ss_flow.tasks.artifacts import Float64
from ss_flow.tasks.capture.colmap import SEED, load_pycolmap
from ss_flow.tasks.capture.colmap_database import fill_database
from ss_flow.tasks.capture.features import Features
from ss_flow.tasks.capture.matches import Matches


def opened(
    photos: Sequence[Features], intrinsics: Float64, matches: Sequence[Matches], poses: Float64
) -> tuple[Any, Any]:
    """A mapper, and its model, in which photo i is image and frame i + 1.

    intrinsics: [N, 4] of the photos. matches: those with other photos do not count. poses: [K, 4, 4] world-to-camera
    of the first K photos; the others have none yet.
    """
    pycolmap = load_pycolmap()

    def lens(photo: Features, row: int) -> tuple[tuple[float, ...], Any]:
        numbers = intrinsics[row].tolist()
        camera = pycolmap.Camera(model="PINHOLE", width=photo.width, height=photo.height, params=numbers)
        return (photo.width, photo.height, *numbers), camera

    database, _ = fill_database(photos, matches, lens)
    cache = pycolmap.DatabaseCache.create(database, pycolmap.DatabaseCacheOptions())
    model = pycolmap.Reconstruction()
    model.load(cache)
    for row, pose in enumerate(poses):
        if model.exists_frame(row + 1):
            model.frame(row + 1).rig_from_world = pycolmap.Rigid3d(pose[:3])
            model.register_frame(row + 1)
    mapper = pycolmap.IncrementalMapper(cache)
    mapper.begin_reconstruction(model)
    return mapper, model


def triangulate(mapper: Any, model: Any, error: float, focal: float) -> Any:
    """Find the points that the photos with poses have in common, seen at most so far off their place, in pixels.

    focal: focal length of the photos, in pixels. Returns what COLMAP filters points by.
    """
    filtering, triangulating = _limits(error, focal)
    numbers = sorted(model.reg_image_ids())
    for i, number in enumerate(numbers):
        mapper.triangulate_image(triangulating, number)
        progress(i, len(numbers), f"points within {error:g} pixels")
    mapper.complete_and_merge_tracks(triangulating)
    mapper.filter_points(filtering)
    return filtering


def _limits(error: float, focal: float) -> tuple[Any, Any]:
    """What COLMAP filters and triangulates by when points may be seen so far off, in pixels."""
    pycolmap = load_pycolmap()
    filtering = pycolmap.IncrementalMapperOptions()
    filtering.num_threads = 1
    filtering.random_seed = SEED
    filtering.filter_max_reproj_error = error
    triangulating = pycolmap.IncrementalTriangulatorOptions()
    triangulating.random_seed = SEED
    triangulating.create_max_angle_error = triangulating.continue_max_angle_error = float(np.degrees(error / focal))
    triangulating.complete_max_reproj_error = triangulating.merge_max_reproj_error = error
    return filtering, triangulating
