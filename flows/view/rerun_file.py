"""A finished run as a recording of Rerun: photos, masks and depth in their cameras, points, Gaussians as points.

The recording goes straight into a file: no viewer is started, and no connection opened. Rerun's statistics of use are
those of its viewer and its `rerun` command, which this does not call.
"""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from ss_flow.cache.files import hidden
from ss_flow.errors import InputError
from ss_flow.flows.results import FinishedRun
from ss_flow.flows.view.drawing import agreement_colors, label_colors, spacing_of
from ss_flow.tasks.artifacts import Gaussians
from ss_flow.tasks.deliver.export.content import base_colors
from ss_flow.tasks.deliver.palette import instance_colors
from ss_flow.tasks.geometry.cameras import Camera, camera_of
from ss_flow.tasks.geometry.images import suffix_of

SHOWN = ("ingest", "cameras")
"""The results of a run that its recording cannot do without; the others are recorded where they are there."""
_MEDIA = {"jpg": "image/jpeg", "png": "image/png"}
_SOLID = 0.5
"""Opacity from which on a Gaussian counts as surface; fainter ones would stand as solid points before it."""


def write_recording(file: Path, run: FinishedRun) -> None:
    """Write the recording (.rrd) of a run, whole or not at all: views on the time line "view", the rest at all times.

    Raises InputError when Rerun is not installed.
    """
    if find_spec("rerun") is None:
        raise InputError("a recording needs a package that is not installed; run `pip install 'ss-flow[rerun]'`.")
    import rerun as rr

    filling = file.with_name(f"{hidden(file.name)}.part")
    stream = rr.RecordingStream("ss-flow")
    try:
        stream.save(filling)
        stream.log("world", rr.ViewCoordinates.RIGHT_HAND_Y_DOWN, static=True)
        _log_views(stream, run)
        _log_points(stream, run)
        stream.flush()
        stream.disconnect()
        filling.replace(file)
    finally:
        filling.unlink(missing_ok=True)


def _log_views(stream: Any, run: FinishedRun) -> None:
    import rerun as rr

    results = run.results
    frames, cameras = results.all("ingest"), results.one("cameras")
    several = {name: results.all(name) for name in ("depth", "masks_split", "masks") if not results.missing([name])}
    highest = max(
        (int(one.ids.max(initial=0)) for n in ("masks_split", "masks") for one in several.get(n, ())), default=0
    )
    names = {int(i): name for i, name in run.names.items()}
    classes = [(i, names.get(i, ""), tuple(color)) for i, color in enumerate(instance_colors(highest + 1).tolist())]
    stream.log("world", rr.AnnotationContext(classes), static=True)
    for view, frame in enumerate(frames):
        camera = camera_of(cameras, view)
        place = f"world/views/{frame.name}"
        stream.set_time("view", sequence=view)
        pose = camera.world_to_camera
        stream.log(place, rr.Transform3D(translation=camera.center, mat3x3=pose[:3, :3].T))
        stream.log(
            f"{place}/photo",
            _pinhole(camera),
            rr.EncodedImage(contents=frame.encoded.tobytes(), media_type=_MEDIA[suffix_of(frame)]),
        )
        for name, one in several.items():
            if name == "depth":
                pixels = camera.scaled(*one[view].depth.shape[::-1])
                stream.log(f"{place}/depth", _pinhole(pixels), rr.DepthImage(one[view].depth, meter=1.0))
            else:
                stream.log(f"{place}/photo/{name}", rr.SegmentationImage(one[view].ids))


def _pinhole(camera: Camera) -> Any:
    import rerun as rr

    return rr.Pinhole(
        focal_length=(camera.fx, camera.fy),
        principal_point=(camera.cx, camera.cy),
        resolution=(camera.width, camera.height),
        camera_xyz=rr.ViewCoordinates.RDF,
    )


def _log_points(stream: Any, run: FinishedRun) -> None:
    import rerun as rr

    results = run.results

    def points(name: str, positions: np.ndarray, colors: np.ndarray, radii: Any, ids: np.ndarray | None = None) -> None:
        stream.log(f"world/{name}", rr.Points3D(positions, colors=colors, radii=radii, class_ids=ids), static=True)

    sparse = results.one("cameras").sparse_points
    if len(sparse):
        points("sparse", sparse, np.full((len(sparse), 3), 90, np.uint8), spacing_of(sparse) / 4)
    if not results.missing(["dense"]):
        dense = results.one("dense")
        points("dense/photo", dense.points, dense.colors, dense.spacing_of() / 2)
        if not results.missing(["propagate"]):
            agreement = agreement_colors(results.one("propagate").confidence)
            points("dense/agreement", dense.points, agreement, dense.spacing_of() / 2)
        if not results.missing(["cut"]):
            label = results.one("cut").label
            points("dense/labels", dense.points, label_colors(label), dense.spacing_of() / 2, label.astype(np.uint16))
    if not results.missing(["scene"]):
        scene: Gaussians = results.one("scene")
        solid = scene.opacities >= _SOLID
        colors = np.rint(255 * base_colors(scene)[solid].clip(0, 1)).astype(np.uint8)
        radii = np.exp(scene.log_scales[solid].astype(np.float64)).mean(axis=1)
        ids = scene.instance_id[solid].astype(np.uint16)
        points("gaussians", scene.means[solid], colors, radii, ids)
