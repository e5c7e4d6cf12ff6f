"""The ground truth of a ScanNet scene: its mesh's vertices and the instance of each (spec 2.1)."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from ss_flow.errors import InputError
from ss_flow.running import warn
from ss_flow.task import FileRef, task
from ss_flow.tasks.artifacts import Int32
from ss_flow.tasks.evaluate.points import TruePoints
from ss_flow.tasks.geometry.open3d import load_open3d


@task(name="evaluate.scannet_truth")
def scannet_truth(*, mesh: FileRef, segments: FileRef, aggregation: FileRef, other: FileRef | None) -> TruePoints:
    """The vertices of a scan, each with the position of its group in the aggregation file.

    mesh: NAME_vh_clean_2.ply. segments: its segIndices. aggregation: its segGroups; a later group takes the segments
    that it shares with an earlier one, and vertices in no group are not annotated. other: the aggregation of the finer
    mesh, which some scripts read instead; a warning says on how many vertices the two disagree.
    Raises InputError when a file is damaged or they do not belong together.
    """
    points = np.asarray(load_open3d().io.read_point_cloud(str(mesh.path)).points, np.float32)
    if not len(points):
        raise InputError(f"{mesh.path} holds no vertices; the mesh NAME_vh_clean_2.ply of the scan is needed.")
    of_vertex = np.asarray(_list(segments.path, "segIndices"), np.int64)
    if of_vertex.shape != points.shape[:1]:
        raise InputError(
            f"{segments.path} has {len(of_vertex)} segment indices and {mesh.path} {len(points)} vertices; the two "
            "must be of one scan."
        )
    instance = _instances(of_vertex, aggregation.path)
    if other is not None:
        differs = float((instance != _instances(of_vertex, other.path)).mean())
        if differs:
            warn(
                f"{aggregation.path.name} and {other.path.name} disagree on {differs:.1%} of the vertices; "
                f"{aggregation.path.name} counts."
            )
    return TruePoints(points, instance)


def _instances(of_vertex: np.ndarray, aggregation: Path) -> Int32:
    """[N] the last group that holds the segment of each vertex, -1 = none."""
    group_of = np.full(int(of_vertex.max(initial=-1)) + 1, -1, np.int32)
    for number, group in enumerate(_list(aggregation, "segGroups")):
        held = np.asarray(group["segments"], np.int64)
        group_of[held[(held >= 0) & (held < len(group_of))]] = number
    return group_of[of_vertex]


def _list(file: Path, name: str) -> list[Any]:
    try:
        return list(json.loads(file.read_text(encoding="utf-8"))[name])
    except (OSError, ValueError, TypeError, KeyError) as error:
        raise InputError(f"{file} cannot be read ({type(error).__name__}: {error}); {name} is expected.") from None
