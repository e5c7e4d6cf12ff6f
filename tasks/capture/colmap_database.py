"""Features and matches in a database of COLMAP's, which stays in memory: nothing is left behind, however a run ends."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from typing import Any

import numpy as np

from ss_flow.tasks.capture.colmap import load_pycolmap
from ss_flow.tasks.capture.features import Features
from ss_flow.tasks.capture.matches import Matches

Lenses = Callable[[Features, int], tuple[Hashable, Any]]
"""Of a photo and its row: what it shares a camera by, and that camera (its number is set here)."""


def fill_database(photos: Sequence[Features], matches: Sequence[Matches], lens: Lenses) -> tuple[Any, list[Features]]:
    """The database, in which photo i is image and frame i + 1; and the photos without their descriptors.

    matches: of pairs that stand here twice the last counts; those with other photos do not count.
    """
    pycolmap = load_pycolmap()
    database = pycolmap.Database.open(":memory:")
    kept, cameras = [], dict[Hashable, int]()
    with pycolmap.DatabaseTransaction(database):
        for row in range(len(photos)):
            photo = photos[row]
            kept.append(photo.light())
            shared, camera = lens(photo, row)
            if shared not in cameras:
                cameras[shared] = len(cameras) + 1
                _write_camera(pycolmap, database, camera, cameras[shared])
            _write_photo(pycolmap, database, photo, row + 1, cameras[shared])
        for a, b, geometry in _geometries(pycolmap, matches, {photo.name: row for row, photo in enumerate(kept)}):
            database.write_two_view_geometry(a + 1, b + 1, geometry)
    return database, kept


def _write_camera(pycolmap: Any, database: Any, camera: Any, number: int) -> None:
    """A camera, and the rig of its own that COLMAP wants around it."""
    camera.camera_id = number
    database.write_camera(camera, use_camera_id=True)
    rig = pycolmap.Rig(rig_id=number)
    rig.add_ref_sensor(pycolmap.sensor_t(pycolmap.SensorType.CAMERA, number))
    database.write_rig(rig, use_rig_id=True)


def _write_photo(pycolmap: Any, database: Any, photo: Features, number: int, camera: int) -> None:
    database.write_image(pycolmap.Image(name=photo.name, camera_id=camera, image_id=number), use_image_id=True)
    frame = pycolmap.Frame(frame_id=number, rig_id=camera)
    frame.add_data_id(pycolmap.data_t(pycolmap.sensor_t(pycolmap.SensorType.CAMERA, camera), number))
    database.write_frame(frame, use_frame_id=True)
    database.write_keypoints(number, photo.points)


def _geometries(pycolmap: Any, matches: Sequence[Matches], rows: dict[str, int]) -> list[tuple[int, int, Any]]:
    """Each pair of photos with its geometry, in the photos' order."""
    found = {}
    for own in matches:
        for i, other in enumerate(own.others):
            if own.name not in rows or other not in rows:
                continue
            geometry = pycolmap.TwoViewGeometry(
                config=int(own.configuration[i]),
                F=own.fundamental[i],
                inlier_matches=own.pairs_with(i).astype(np.uint32),
            )
            a, b = rows[own.name], rows[other]
            found[min(a, b), max(a, b)] = (a, b, geometry)
    return [found[pair] for pair in sorted(found)]
