"""The ground truth of a ScanNet scene: its mesh's vertices and the instance of each (spec 2.1)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ss_flow.cache.plain_json import read_json
from ss_flow.errors import InputError
from ss_flow.running import warn
from ss_flow.task import FileRef, task
from ss_flow.tasks.artifacts import Bool, Float32, Int32
from ss_flow.tasks.evaluate.points import TruePoints
from ss_flow.tasks.geometry.ply_elements import read_elements

_STUFF_CLASSES = (1, 2, 22)
"""NYU40's wall, floor and ceiling, which the labels of the vertices name."""
_STUFF_NAMES = frozenset({"wall", "floor", "ceiling"})


@task(name="evaluate.scannet_truth")
def scannet_truth(
    *,
    mesh: FileRef,
    segments: FileRef,
    aggregation: FileRef,
    other: FileRef | None = None,
    labels: FileRef | None = None,
) -> TruePoints:
    """The vertices of a scan, each with the position of its group in the aggregation file.

    mesh: NAME_vh_clean_2.ply. segments: its segIndices. aggregation: its segGroups; a later group takes the segments
    that it shares with an earlier one, and vertices in no group are not annotated. other: the aggregation of the finer
    mesh, which some scripts read instead; a warning says on how many vertices the two disagree. labels:
    NAME_vh_clean_2.labels.ply, the NYU40 class of each vertex; an instance is stuff where most of its vertices are
    wall, floor or ceiling, or without that file where its group is called so.
    Raises InputError when a file is damaged or they do not belong together.
    """
    points = vertices(mesh.path)
    of_vertex = np.asarray(_list(segments.path, "segIndices"), np.int64)
    if of_vertex.shape != points.shape[:1]:
        raise InputError(
            f"{segments.path} has {len(of_vertex)} segment indices and {mesh.path} {len(points)} vertices; the two "
            "must be of one scan."
        )
    groups = _list(aggregation.path, "segGroups")
    instance = _instances(of_vertex, groups)
    if other is not None:
        differs = float((instance != _instances(of_vertex, _list(other.path, "segGroups"))).mean())
        if differs:
            warn(
                f"{aggregation.path.name} and {other.path.name} disagree on {differs:.1%} of the vertices; "
                f"{aggregation.path.name} counts."
            )
    names = tuple(str(group.get("label", "")) for group in groups)
    if labels is None:
        stuff = [number for number, name in enumerate(names) if name in _STUFF_NAMES]
    else:
        is_stuff = np.isin(_classes(labels.path, len(points)), _STUFF_CLASSES)
        stuff = [number for number in range(len(groups)) if _mostly(is_stuff[instance == number])]
    return TruePoints(points, instance, names, np.array(stuff, np.int32))


def vertices(mesh: Path) -> Float32:
    """[N, 3] the vertices of a mesh. Raises InputError when there is none, or the file is damaged."""
    vertex = read_elements(mesh).get("vertex", {})
    if not {"x", "y", "z"} <= vertex.keys() or not len(vertex["x"]):
        raise InputError(f"{mesh} holds no vertices; the annotated mesh of a scan is needed.")
    return np.stack([vertex[axis] for axis in "xyz"], axis=1).astype(np.float32)


def _classes(labels: Path, count: int) -> Int32:
    vertex = read_elements(labels).get("vertex", {})
    if "label" not in vertex or len(vertex["label"]) != count:
        raise InputError(f"{labels} does not label the {count} vertices of the mesh; they must be of one scan.")
    return vertex["label"].astype(np.int32)


def _mostly(of_instance: Bool) -> bool:
    return bool(2 * of_instance.sum() > len(of_instance))


def _instances(of_vertex: np.ndarray, groups: list[dict[str, Any]]) -> Int32:
    """[N] the last group that holds the segment of each vertex, -1 = none."""
    group_of = np.full(int(of_vertex.max(initial=-1)) + 1, -1, np.int32)
    for number, group in enumerate(groups):
        held = np.asarray(group["segments"], np.int64)
        group_of[held[(held >= 0) & (held < len(group_of))]] = number
    return group_of[of_vertex]


def _list(file: Path, name: str) -> list[Any]:
    try:
        return list(read_json(file.read_text(encoding="utf-8"))[name])
    except (OSError, ValueError, TypeError, KeyError) as error:
        raise InputError(f"{file} cannot be read ({type(error).__name__}: {error}); {name} is expected.") from None
