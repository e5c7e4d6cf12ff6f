"""The ground truth of a Replica scene: its mesh's vertices and the object of each (Straub et al., 2019)."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ss_flow.cache.plain_json import read_json
from ss_flow.errors import InputError
from ss_flow.task import FileRef, task
from ss_flow.tasks.evaluate.points import TruePoints, most_frequent
from ss_flow.tasks.evaluate.scannet import vertices
from ss_flow.tasks.geometry.ply_elements import read_elements

_STUFF = frozenset({"wall", "floor", "ceiling"})


@task(name="evaluate.replica_truth")
def replica_truth(*, mesh: FileRef, info: FileRef) -> TruePoints:
    """The vertices of a scan, each with the object that most of its faces belong to, the lowest of equals.

    mesh: habitat/mesh_semantic.ply, whose faces have an object_id. info: habitat/info_semantic.json, the objects with
    their class; objects that it does not list, or gives no class, are not annotated.
    Raises InputError when a file is damaged or they do not belong together.
    """
    points = vertices(mesh.path)
    faces = read_elements(mesh.path).get("face", {})
    if not {"vertex_indices", "object_id"} <= faces.keys():
        raise InputError(f"{mesh.path} has no faces with an object_id; Replica's habitat/mesh_semantic.ply is needed.")
    corners, objects = faces["vertex_indices"].astype(np.int64), faces["object_id"].astype(np.int64)
    if corners.size and not 0 <= corners.min() <= corners.max() < len(points):
        raise InputError(f"{mesh.path} has faces of vertices that it does not hold; it is damaged.")
    names = _names(info.path)
    listed = np.isin(objects, list(names))
    votes = np.stack([corners[listed].ravel(), np.repeat(objects[listed], corners.shape[1])], axis=1)
    instance = most_frequent(votes, len(points))
    by_id = tuple(names.get(i, "") for i in range(max(names, default=-1) + 1))
    stuff = [i for i, name in names.items() if name in _STUFF]
    return TruePoints(points, instance, by_id, np.array(sorted(stuff), np.int32))


def _names(info: Path) -> dict[int, str]:
    """The class of each annotated object by id."""
    try:
        objects = read_json(info.read_text(encoding="utf-8"))["objects"]
        return {int(one["id"]): str(one["class_name"]) for one in objects if int(one["class_id"]) >= 0}
    except (OSError, ValueError, TypeError, KeyError) as error:
        raise InputError(f"{info} cannot be read ({type(error).__name__}: {error}); objects are expected.") from None
